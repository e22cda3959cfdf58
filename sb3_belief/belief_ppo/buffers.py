"""
Rollout buffers that also hold what a belief is trained on.

The belief's data reaches SB3's methods as an argument, although SB3 knows nothing of it:
:func:`attach` puts it on an object that SB3 only passes on. In a rollout these are the values,
from the policy to ``RolloutBuffer.add``; in an update the observations of a minibatch, from ``RolloutBuffer.get`` to
``evaluate_actions``. What the environment says of a step comes by way of ``_update_info_buffer``, which SB3 calls once a step
just before ``add``: see :meth:`BeliefBufferMixin.stage_others`.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer

from sb3_belief.belief import ActionLayout
from sb3_belief.belief_ppo.active_steps import ActiveStepsBufferMixin
from sb3_belief.belief_ppo.later_steps import seen_later
from sb3_belief.belief_ppo.value_loss import ValueTargets

Carrier = TypeVar("Carrier")


class _CarrierDict(dict):
    """A dict that takes attributes."""


class _CarrierArray(np.ndarray):
    """An array that takes attributes."""


def attach(carrier: Carrier, data: Any) -> Carrier:
    """
    Attach data to an object that SB3 passes on untouched.

    :param carrier: A tensor, an array or a dict of them
    :param data: What to attach
    :return: The same values in a new object, which shares their memory; the carrier itself stays as it is
    """
    result: Any
    if isinstance(carrier, th.Tensor):
        result = carrier.view_as(carrier)
    elif isinstance(carrier, dict):
        result = _CarrierDict(carrier)
    else:
        result = np.asarray(carrier).view(_CarrierArray)
    result.belief_data = data
    return result


def attached(carrier: Any) -> Any:
    """
    Return what is attached to an object.

    :param carrier: Any object
    :return: The data given to :func:`attach`; None where nothing is attached
    """
    return getattr(carrier, "belief_data", None)


class SampledLatents(NamedTuple):
    """
    What an agent drew and selected for the belief with which it acted; ``B`` rows, one for each copy of the environment.

    :param noise: The noise of eq. 5, ``[B, z]``; of width 0 for a belief that does not sample
    :param selected: The history rows attended to, int32 ``[B, N_h]``; of width 0 for a belief without a history
    """

    noise: th.Tensor
    selected: th.Tensor


class BeliefMinibatch(NamedTuple):
    """
    What a minibatch holds beyond SB3's samples; ``B`` rows, in the same order.

    :param noise: The noise of eq. 5 with which the agent acted, ``[B, z]``; of width 0 for a belief that does not sample
    :param selected: The history rows it attended to, ``[B, N_h]``; of width 0 for a belief without a history
    :param others_actions: The others' flattened actions, ``[B, W]``, zero where not visible
    :param others_visible: Whose action was visible, bool ``[B, n_others]``
    :param stamps: When and where each step was, as of :class:`~sb3_belief.belief.memory.Memory`; None for a belief that is not
        online
    :param later_actions: As ``others_actions``, one, two, ... steps later, ``[B, k, W]``; None where they are not predicted
    :param later_visible: Whose action was visible then, bool ``[B, k, n_others]``; None likewise
    :param seen_at_once: The others' actions and whose was visible, without what was seen of them while the agent waited for
        its next turn, float ``[B, W + n_others]``; None where no baseline sees it
    """

    noise: th.Tensor
    selected: th.Tensor
    others_actions: th.Tensor
    others_visible: th.Tensor
    stamps: th.Tensor | None = None
    later_actions: th.Tensor | None = None
    later_visible: th.Tensor | None = None
    seen_at_once: th.Tensor | None = None


def read_others(infos: Sequence[Mapping[str, Any]], layout: ActionLayout) -> tuple[np.ndarray, np.ndarray]:
    """
    Read what the agent has seen of the others in a step.

    :param infos: The step's `info` of each copy of the environment
    :param layout: Layout of the others' actions
    :return: The others' actions, float32 ``[n_envs, W]``, zero where not visible, and visibility, bool ``[n_envs, n_others]``.
        Invisible actions are zeroed here once more, so that a careless environment cannot leak what the agent did not see
    :raises ValueError: If an info lacks them, or has them in another shape
    """
    actions = _rows("others_actions", layout.width, infos).astype(np.float32, copy=False)
    visible = _rows("others_visible", layout.n_others, infos).astype(bool, copy=False)
    return np.where(visible.take(layout.owners, axis=1), actions, np.float32(0.0)), visible


def _rows(key: str, width: int, infos: Sequence[Mapping[str, Any]]) -> np.ndarray:
    try:
        rows = [np.asarray(info[key]) for info in infos]
    except KeyError:
        raise ValueError(
            f"the environment names others in 'others_action_spaces', but its info lacks {key!r}; every step must bring "
            "'others_actions' and 'others_visible' (a Team provides both)"
        ) from None
    wrong = {row.shape for row in rows} - {(width,)}
    if wrong:
        raise ValueError(
            f"info brings {key} of shape {sorted(wrong)[0]}; the others' action spaces ask for {(width,)}, see "
            "sb3_belief.belief_ppo.others.action_layout (actions) and one truth value for each other (visible)"
        )
    # A third of the time of stack()
    return np.concatenate(rows).reshape(len(rows), width)


# The places of rewards and values among the arguments of add()
_REWARD, _VALUE = 2, 4
_OF_BELIEF = (
    *("noise", "selected", "others_actions", "others_visible"),
    *("stamps", "own_rewards", "attended_actions", "attended_visible", "waited"),
)


class BeliefBufferMixin(ActiveStepsBufferMixin):
    """
    Makes a rollout buffer of SB3's one with a belief's data, which leaves out inactive steps.

    :param noise_dim: ``z``, 0 where no belief is sampled
    :param max_selected: The most history rows that are attended to, ``N_h``, 0 where none are
    :param others_width: ``W``, 0 without a belief
    :param n_others: Number of others, 0 without a belief
    :param is_online: Whether the belief attends to earlier steps of the rollout, so that their stamps and rewards are kept
    :param n_later: How many steps after a row's own are predicted, too
    :param shows_at_once: Whether minibatches show what was seen of the others at once; for a belief that is online
    """

    noise: np.ndarray
    selected: np.ndarray
    others_actions: np.ndarray
    others_visible: np.ndarray

    extras = (*ActiveStepsBufferMixin.extras, *_OF_BELIEF)

    def __init__(
        self,
        *args: Any,
        noise_dim: int = 0,
        max_selected: int = 0,
        others_width: int = 0,
        n_others: int = 0,
        is_online: bool = False,
        n_later: int = 0,
        shows_at_once: bool = False,
        **kwargs: Any,
    ) -> None:
        # Before SB3's constructor, which calls reset()
        self._widths = dict(noise=noise_dim, selected=max_selected, others_actions=others_width, others_visible=n_others)
        self._is_online, self._n_later, self._shows_at_once = is_online, n_later, shows_at_once
        # In each copy, the step with which the present episode began
        self._began: list[int] = []
        #: What the belief is trained on besides, of the past rollouts
        self.replay: list[dict[str, np.ndarray]] = []
        super().__init__(*args, **kwargs)

    def reset(self) -> None:
        super().reset()
        rows = self.buffer_size, self.n_envs
        self.noise = np.zeros((*rows, self._widths["noise"]), dtype=np.float32)
        self.selected = np.zeros((*rows, self._widths["selected"]), dtype=np.int32)
        self.others_actions = np.zeros((*rows, self._widths["others_actions"]), dtype=np.float32)
        self.others_visible = np.zeros((*rows, self._widths["others_visible"]), dtype=bool)
        self.stamps = np.zeros((*rows, 3 if self._is_online else 0), dtype=np.int64)
        self.own_rewards = np.zeros(rows if self._is_online else (*rows, 0), dtype=np.float32)
        # As they are attended to: what is seen of others while the agent waits is a row of its own there
        self.attended_actions = np.zeros((*rows, self._widths["others_actions"] if self._is_online else 0), dtype=np.float32)
        self.attended_visible = np.zeros((*rows, self._widths["others_visible"] if self._is_online else 0), dtype=bool)
        # Where the agent waited, the number of its turn before that, from 1; else 0
        self.waited = np.zeros(rows if self._is_online else (*rows, 0), dtype=np.int32)
        #: What the rewards of the step that is added next have been raised by, which the agent has not got
        self.bootstraps = np.zeros(self.n_envs, dtype=np.float32)
        # Within a rollout all steps attend to equally many rows; the number grows with the history from one to the next
        self._n_selected = 0

    def stage_others(self, others_actions: np.ndarray, others_visible: np.ndarray) -> None:
        """
        Write what the agent has seen of the others in a step into the row that ``add`` fills next.

        :param others_actions: float32 ``[n_envs, W]``, zero where not visible
        :param others_visible: bool ``[n_envs, n_others]``
        """
        self.others_actions[self.pos] = others_actions
        self.others_visible[self.pos] = others_visible

    def watch(self, starts: np.ndarray, owners: np.ndarray) -> None:
        """
        Write what the agent has seen of others while it waited into the row of its last active step. So that row holds what
        each of them did from the agent's turn to its next one: the first action that it saw.

        :param starts: Whether a return starts with the step that was staged, bool ``[n_envs]``
        :param owners: To which other each column of ``others_actions`` belongs, int ``[W]``
        """
        for copy in np.flatnonzero(~self.active[self.pos] & self.others_visible[self.pos].any(axis=1)):
            played = np.flatnonzero(self.active[: self.pos, copy])
            if len(played) == 0 or starts[copy] or self.episode_starts[played[-1] + 1 : self.pos, copy].any():
                continue
            row = played[-1], copy
            new = self.others_visible[self.pos, copy] & ~self.others_visible[row]
            self.others_visible[row] |= new
            self.others_actions[row] += self.others_actions[self.pos, copy] * new[owners]
            if self._is_online:
                self.waited[self.pos, copy] = played[-1] + 1

    def add(self, *args: Any, **kwargs: Any) -> None:
        """
        Add a step as SB3 does, with the :class:`SampledLatents` that the policy has attached to its values.

        :param args: As in SB3 or sb3-contrib; the values are the very object that the policy returned
        :param kwargs: As in SB3 or sb3-contrib
        """
        sampled = attached(kwargs["value"] if "value" in kwargs else args[_VALUE])
        if sampled is not None:
            self._n_selected = sampled.selected.shape[1]
            self.noise[self.pos] = sampled.noise.cpu().numpy()
            self.selected[self.pos, :, : self._n_selected] = sampled.selected.cpu().numpy()
        if self._is_online:
            reward = kwargs["reward"] if "reward" in kwargs else args[_REWARD]
            self.own_rewards[self.pos] = np.asarray(reward) - self.bootstraps
            self.bootstraps[:] = 0.0
            self.attended_actions[self.pos] = self.others_actions[self.pos]
            self.attended_visible[self.pos] = self.others_visible[self.pos]
        super().add(*args, **kwargs)

    def stamp(self, now: int, starts: np.ndarray) -> np.ndarray:
        """
        Return when and where the step is that is added next, and keep it.

        :param now: Its number
        :param starts: Whether an episode starts with it, bool ``[n_envs]``
        :return: As of :class:`~sb3_belief.belief.memory.Memory`, int64 ``[n_envs, 3]``
        """
        self._began = [
            now if is_start else began for is_start, began in zip(starts, self._began or [now] * self.n_envs, strict=True)
        ]
        stamps = np.stack([np.full(self.n_envs, now), np.arange(self.n_envs), self._began], axis=1)
        # After a rollout its last observations are asked for, which are the first of the next
        if self.pos < self.buffer_size:
            self.stamps[self.pos] = stamps
        return stamps

    def recent(self, n_rows: int) -> tuple[np.ndarray | dict[str, np.ndarray], np.ndarray]:
        """
        Return the last active steps of all copies, interleaved by time.

        :param n_rows: The most rows to return
        :return: The observations of these steps and the others' actions, oldest first
        """
        rows = self.rows_of(self.active_steps()[-n_rows:])

        def pick(array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
            # As the environment gives them: SB3 keeps a Discrete observation as an array of one number
            return array[rows].reshape(len(rows[0]), *shape)

        actions = pick(self.others_actions, (self._widths["others_actions"],))
        observations, space = self.observations, self.observation_space
        if isinstance(observations, dict) and isinstance(space, spaces.Dict):
            return {key: pick(part, space[key].shape or ()) for key, part in observations.items()}, actions
        return pick(observations, space.shape or ()), actions

    def _samples(self, rows: np.ndarray) -> Any:
        samples = super()._samples(rows)
        if self._widths["others_visible"] == 0:
            return samples
        return samples._replace(observations=attach(samples.observations, self.belief_minibatch(rows)))

    def belief_minibatch(self, rows: Any) -> BeliefMinibatch:
        """
        Return the belief's part of some rows.

        :param rows: Index into the rows as they are ordered at present
        :return: Their data, on the buffer's device; for a slice it is a part of the buffer itself
        """
        parts = {name: getattr(self, name)[rows] for name in ("noise", "selected", "others_actions", "others_visible")}
        parts["selected"] = parts["selected"][..., : self._n_selected]
        if self._is_online:
            parts["stamps"] = self.stamps[rows]
        if self._n_later:
            parts["later_actions"], parts["later_visible"] = seen_later(self, rows, self._n_later)
        if self._shows_at_once:
            seen = self.attended_actions[rows], self.attended_visible[rows]
            parts["seen_at_once"] = np.concatenate(seen, axis=-1, dtype=np.float32)
        return BeliefMinibatch(**{name: self.to_torch(part, copy=False) for name, part in parts.items()})


class DetailsBufferMixin(ActiveStepsBufferMixin):
    """Lets a rollout buffer attach to the observations of a minibatch what its values are trained on."""

    #: Whether it does
    shows_targets = False

    def _samples(self, rows: np.ndarray) -> Any:
        samples = super()._samples(rows)
        if not self.shows_targets:
            return samples
        observations: Any = attach(samples.observations, attached(samples.observations))
        observations.value_targets = ValueTargets(samples.returns, samples.old_values)
        return samples._replace(observations=observations)


class BeliefRolloutBuffer(DetailsBufferMixin, BeliefBufferMixin, RolloutBuffer):
    """SB3's rollout buffer with the belief's part of each step, see :class:`BeliefBufferMixin`."""


class BeliefDictRolloutBuffer(DetailsBufferMixin, BeliefBufferMixin, DictRolloutBuffer):
    """SB3's rollout buffer for Dict observations with the belief's part of each step, see :class:`BeliefBufferMixin`."""
