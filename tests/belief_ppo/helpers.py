"""Helpers that several tests of BeliefPPO share."""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import KVWriter, Logger

from sb3_belief.belief import BeliefOutput
from sb3_belief.belief_ppo import BeliefPPO, MaskableBeliefPPO
from tests.belief_ppo.toy_envs import AmongOthers, MaskedAmongOthers

SMALL: dict[str, Any] = dict(n_steps=14, batch_size=14, n_epochs=2, seed=0, history_length=40, keep_ratio=0.1, device="cpu")
#: Steps of one iteration of a small model with its three environments
ROLLOUT = 42
VARIANTS = ["dynamic", "context", "variational", "static", "wide", "adaptive"]
ALGORITHMS = [BeliefPPO, MaskableBeliefPPO]
#: Every variant without masks, but with masks only the one with all parts and the one with none: the belief's code is the same
EVERY = [*((BeliefPPO, belief) for belief in (*VARIANTS, "none")), (MaskableBeliefPPO, "dynamic"), (MaskableBeliefPPO, "none")]


def make_model(n_envs: Any = 3, env_kwargs: Any = None, algorithm: Any = BeliefPPO, **kwargs: Any) -> Any:
    """Return a small untrained model in a seeded environment."""
    env_class = MaskedAmongOthers if issubclass(algorithm, MaskableBeliefPPO) else AmongOthers
    env = make_vec_env(env_class, n_envs=n_envs, seed=0, env_kwargs=env_kwargs)
    return algorithm("BeliefPolicy", env, **{**SMALL, **kwargs})


def observations_of(model: Any, n: int) -> Any:
    """Return ``n`` sampled observations, batched as by a vectorised environment."""
    samples = [model.observation_space.sample() for _ in range(n)]
    if isinstance(model.observation_space, spaces.Dict):
        return {key: np.stack([sample[key] for sample in samples]) for key in samples[0]}
    return np.stack(samples)


def same_parameters(a: Any, b: Any) -> bool:
    """Return whether all weights and the histories of two models are the same bit for bit."""
    pairs = list(zip(a.policy.state_dict().items(), b.policy.state_dict().items(), strict=True))
    return all(name == other and th.equal(x, y) for (name, x), (other, y) in pairs) and len(pairs) > 5


class Watch(BaseCallback):
    """
    Callback that inspects the model after each rollout, and predicts at each step as an evaluation callback does.

    :param look: Called with the model
    """

    def __init__(self, look: Any) -> None:
        super().__init__()
        self.look = look

    def _on_step(self) -> bool:
        self.model.predict(observations_of(self.model, 5), deterministic=False)
        return True

    def _on_rollout_end(self) -> None:
        self.look(self.model)


class Values(KVWriter):
    """Log writer that keeps all logged values except those under ``time/``."""

    def __init__(self) -> None:
        self.written: list[dict[str, Any]] = []

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        self.written.append({key: value for key, value in key_values.items() if not key.startswith("time/")})


class Trace(BaseCallback):
    """Callback that records a training: rollouts, gradients, weights and history at each optimiser step, and all logs."""

    def __init__(self) -> None:
        super().__init__()
        self.entries: list[tuple[str, np.ndarray]] = []
        self.values = Values()

    def _init_callback(self) -> None:
        policy = self.model.policy
        self.model.set_logger(Logger(None, [self.values]))
        step = policy.optimizer.step

        def traced(*args: Any) -> Any:
            self._note("gradient", {name: p.grad for name, p in policy.named_parameters()})
            result = step(*args)
            self._note("state", policy.state_dict())
            return result

        policy.optimizer.step = traced  # type: ignore[method-assign, assignment]

    def _note(self, what: str, tensors: Any) -> None:
        for name, value in tensors.items():
            if value is not None:
                array = value.detach().numpy() if isinstance(value, th.Tensor) else value
                self.entries.append((f"{what} {name}", np.array(array)))

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        for name, value in vars(self.model.rollout_buffer).items():  # type: ignore[attr-defined]
            if isinstance(value, (np.ndarray, dict)) and not name.startswith("_"):
                self._note("rollout", {name: value} if isinstance(value, np.ndarray) else value)

    def _on_training_end(self) -> None:
        self.model.logger.dump(self.num_timesteps)
        for number, values in enumerate(self.values.written):
            self._note(f"log {number}", values)
        self._note("last state", self.model.policy.state_dict())

    def differences(self, other: "Trace") -> set[str]:
        """Return the names of all recorded values that are not the same bit for bit."""
        assert [name for name, _ in self.entries] == [name for name, _ in other.entries] and len(self.entries) > 50
        pairs = zip(self.entries, other.entries, strict=True)
        return {name for (name, a), (_, b) in pairs if not np.array_equal(a, b, equal_nan=a.dtype.kind == "f")}


def record_beliefs(policy: Any) -> list[BeliefOutput]:
    """
    Record the beliefs that a policy infers from now on.

    :param policy: A policy with a belief
    :return: List to which each forward pass appends its belief
    """
    outputs: list[BeliefOutput] = []
    infer = policy.features_extractor.infer

    def recording(*args: Any, **kwargs: Any) -> BeliefOutput:
        outputs.append(infer(*args, **kwargs))
        return outputs[-1]

    policy.features_extractor.infer = recording
    return outputs
