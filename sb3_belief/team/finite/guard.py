"""
Checks of each update of a model, so that what is not finite is found where it arises and goes no further.

``train()`` of SB3 runs as it is. A guard stands before it only from the end of a rollout to the beginning of the update: when
models are saved or sent, nothing of it is to be seen. It draws no random numbers.

Before an update of an on-policy algorithm all is copied, after it all is looked at, and so it is with ``"skip"`` for any. But
off-policy algorithms make small updates at almost every step. With ``"raise"``, only what shows a fault at once is looked at
after each of them (logged values, last layers), and all at every 32nd. So measured, the checks take 2 % of an update of DQN
(64x64), 1 % of SAC (256x256) and 0.4 % of PPO; with ``"skip"`` 12 % of DQN and 6 % of SAC (``benchmarks/finite.py``).
"""

import cmath
import math
import warnings
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_belief.common.exceptions import add_note
from sb3_belief.team.finite.causes import cause_in_rollout, likely_cause
from sb3_belief.team.finite.statistics import KeptStatistics
from sb3_belief.team.finite.tensors import ModelTensors, Snapshot

#: What is done when loss or parameters are not finite
ON_NAN = ("raise", "skip")
#: How often updates of an agent have been taken back
SKIPPED = "train/skipped_updates"
# With "raise", off-policy algorithms have all copied before so many updates
_ALL_EVERY = 32
# What train() may record that is not finite while nothing is wrong: the variance of returns that are all equal is zero
_MAY_BE_NAN = {"train/explained_variance"}
_OF_UPDATE = ("train/", "belief/")
_TOO_LARGE = "what the environment gave was too large for running statistics: scale observations or rewards down there"
# PyTorch's words where a network has returned what no distribution can be made of
_OF_DISTRIBUTIONS = ("found invalid values", "contains either `inf`, `nan`", "returned nan values")


class NonFiniteError(FloatingPointError):
    """
    An update has made loss or parameters of an agent non-finite; the parameters of before have been put back.

    :param message: Says all of it
    :param agent: Name of the agent
    :param n_updates: The model's count of updates when it was found
    :param num_timesteps: The joint step
    :param key: The parameter or logged value
    :param cause: The likely cause
    """

    def __init__(
        self,
        message: str,
        agent: str = "",
        n_updates: int = 0,
        num_timesteps: int = 0,
        key: str = "",
        cause: str = "",
    ):
        super().__init__(message)
        self.agent, self.n_updates, self.num_timesteps, self.key, self.cause = agent, n_updates, num_timesteps, key, cause


def check_on_nan(on_nan: Any) -> str:
    """
    Check what the user wants done when loss or parameters are not finite.

    :param on_nan: What the user gave
    :return: The same
    :raises ValueError: If it is neither ``"raise"`` nor ``"skip"``
    """
    if on_nan not in ON_NAN:
        raise ValueError(
            f"on_nan is {on_nan!r}; it must be 'raise' (an update with a non-finite loss or parameter ends the training) or"
            " 'skip' (it is taken back, and the training goes on)."
        )
    return on_nan


class UpdateGuard:
    """
    Checks the updates of an agent.

    :param agent: Its name
    :param model: Its model, about to learn
    :param on_nan: ``"raise"`` or ``"skip"``
    """

    def __init__(self, agent: str, model: BaseAlgorithm, on_nan: str):
        self._agent, self._model, self._skips = agent, model, on_nan == "skip"
        self._tensors = ModelTensors(model)
        # To take back just one update, everything must be copied before it and looked at after it
        self._every = self._skips or isinstance(model, OnPolicyAlgorithm)
        self._last_layers = self._tensors.last_layers()
        self._finite: Snapshot | None = None
        self._spare = Snapshot()
        self._n_checked = 0
        self._warned = False
        # What was logged by updates that were taken back, and waits to be written
        self._logged: dict[str, Any] = {}
        self._statistics = KeptStatistics(model.get_vec_normalize_env())
        self._statistics.keep()
        self._train: Any = None
        self._own_train: Any = None

    def arm(self) -> None:
        """Have the next ``train()`` of the model checked."""
        attributes = vars(self._model)
        self._own_train, self._train = attributes.get("train"), self._model.train  # type: ignore[attr-defined]
        attributes["train"] = self._checked_train

    def disarm(self) -> None:
        """Leave the model as it was, if it has not trained since."""
        if self._train is not None:
            if self._own_train is None:
                del vars(self._model)["train"]
            else:
                vars(self._model)["train"] = self._own_train
            self._own_train = self._train = None

    def explain(self, error: Exception) -> None:
        """
        Add to what was raised in a rollout why it may have been, and make normalisation finite again.

        :param error: What ended the model's ``learn()``
        """
        if isinstance(error, NonFiniteError):
            return
        bad = self._statistics.put_back()
        if _is_of_a_distribution(error):
            cause = _TOO_LARGE if bad else cause_in_rollout(self._tensors)
            if cause is not None:
                add_note(error, f"Likely cause: {cause}.")

    def _checked_train(self, *args: Any, **kwargs: Any) -> None:
        train = self._train
        self.disarm()
        if self._may_begin():
            self._train_and_look(train, *args, **kwargs)
        if skipped := vars(self._model).get("skipped_updates"):
            self._model.logger.record(SKIPPED, skipped)

    def _may_begin(self) -> bool:
        """Keep a copy of what an update may spoil, and tell whether there is anything to be learned."""
        self._n_checked += 1
        if not self._every and self._n_checked % _ALL_EVERY != 1:
            return True
        if self._spare.take(self._tensors):
            self._finite, self._spare = self._spare, self._finite or Snapshot()
            bad = {f"{name} of its normalisation": "not finite" for name in self._statistics.bad()}
        else:
            # Since the last update, or in what is not looked at after each
            bad = self._spare.bad_tensors()
        if bad:
            self._fault(bad, "", None, found="before")
            return False
        self._statistics.keep()
        return True

    def _train_and_look(self, train: Any, *args: Any, **kwargs: Any) -> None:
        try:
            train(*args, **kwargs)
        except Exception as error:
            bad = self._bad_tensors()
            if not bad and not _is_of_a_distribution(error):
                raise
            self._fault(bad, f"{type(error).__name__} was raised", error)
        else:
            values = self._bad_values()
            if values or not self._seems_finite():
                bad = self._bad_tensors()
                if values or bad:
                    self._fault(bad, values, None)

    def _seems_finite(self) -> bool:
        if self._every:
            return self._spare.take(self._tensors)
        # A gradient that is not finite reaches the last layers, and the next loss shows parameters that are not
        return all([cmath.isfinite(tensor.sum().item()) for tensor in self._last_layers])

    def _bad_tensors(self) -> dict[str, str]:
        now = Snapshot()
        now.take(self._tensors)
        return now.bad_tensors()

    def _bad_values(self) -> str:
        """Return what ``train()`` has logged that is not finite, as text."""
        bad = [
            f"{key} is {float(value)}"
            for key, value in self._model.logger.name_to_value.items()
            if isinstance(value, (float, np.floating))
            and not math.isfinite(value)
            and key.startswith(_OF_UPDATE)
            and key not in _MAY_BE_NAN
            and self._logged.get(key) is not value
        ]
        return ", ".join(bad)

    def _fault(self, bad: dict[str, str], values: str, error: Exception | None, found: str = "after") -> None:
        """Put back the last finite parameters, then raise or warn."""
        n_updates, steps = int(getattr(self._model, "_n_updates", 0)), int(self._model.num_timesteps)
        tensors = [f"{name} ({what})" for name, what in bad.items()]
        more = f" and {len(bad) - 1} more tensors" if len(bad) > 1 else ""
        what = "; ".join(part for part in (values, "".join(tensors[:1]) + more) if part)
        if self._finite is not None:
            self._finite.put_back(self._tensors)
        spoilt = self._statistics.put_back()
        whose = "statistics" if spoilt and not values else "loss or parameters"
        cause = _TOO_LARGE if spoilt else likely_cause(self._tensors, self._finite)
        message = (
            f"Agent {self._agent!r}: {whose} are not finite {found} its update at joint step {steps}"
            f" (n_updates {n_updates}): {what}. Likely cause: {cause}."
        )
        key = values.partition(" is ")[0] if values and error is None else next(iter(bad), type(error).__name__)
        details: dict[str, Any] = dict(agent=self._agent, n_updates=n_updates, num_timesteps=steps, key=key, cause=cause)
        if self._finite is None or self._statistics.bad():
            raise NonFiniteError(f"{message} It was so before it began to learn, and nothing can be put back.", **details)
        back = int(getattr(self._model, "_n_updates", 0))
        if not self._skips:
            raise NonFiniteError(
                f"{message} The parameters of n_updates {back}, the last that are known to be finite, have been put back."
                " on_nan='skip' (--on-nan skip) goes on without such updates.",
                **details,
            ) from error
        self._logged = dict(self._model.logger.name_to_value)
        self._model.skipped_updates = vars(self._model).get("skipped_updates", 0) + 1  # type: ignore[attr-defined]
        if not self._warned:
            self._warned = True
            warnings.warn(f"{message} The update has been taken back; further ones are counted in {SKIPPED}.", RuntimeWarning)


def _is_of_a_distribution(error: Exception) -> bool:
    return isinstance(error, (ValueError, RuntimeError)) and any(words in str(error) for words in _OF_DISTRIBUTIONS)
