"""Values of the observations at which a time limit cut episodes off, for all copies of the environment at once."""

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import PyTorchObs


class TerminalValues:
    """
    SB3 asks the policy for these values one copy after the other, each a pass through the network. In environments whose
    copies end together that is a tenth of a rollout. So they are computed in one pass before, and handed out when asked for.
    """

    def __init__(self) -> None:
        self._waiting: deque[tuple[PyTorchObs, th.Tensor]] = deque()

    def compute(self, policy: ActorCriticPolicy, infos: Sequence[Mapping[str, Any]], dones: np.ndarray) -> None:
        """
        :param policy: Whose values
        :param infos: One step's `info` of each copy
        :param dones: Which copies ended with this step, bool ``[n_envs]``
        """
        self._waiting.clear()
        ended = [info for info, done in zip(infos, dones, strict=False) if done and info.get("TimeLimit.truncated", False)]
        rows = [info["terminal_observation"] for info in ended if info.get("terminal_observation") is not None]
        # There is nothing to be saved by one
        if len(rows) < 2:
            return
        batch = {key: np.stack([row[key] for row in rows]) for key in rows[0]} if isinstance(rows[0], dict) else np.stack(rows)
        observations = policy.obs_to_tensor(batch)[0]
        with th.no_grad():
            values = policy.predict_values(observations)
        for i in range(len(rows)):
            own = slice(i, i + 1)
            row = (
                {key: part[own] for key, part in observations.items()} if isinstance(observations, dict) else observations[own]
            )
            self._waiting.append((row, values[own]))

    def take(self, observation: PyTorchObs) -> th.Tensor | None:
        """
        :param observation: What the policy is asked about
        :return: Its value ``[1, 1]``, if it is the next of those that were computed; None for any other
        """
        if not self._waiting:
            return None
        row, value = self._waiting.popleft()
        if _equal(row, observation):
            return value
        self._waiting.clear()
        return None


def _equal(a: PyTorchObs, b: PyTorchObs) -> bool:
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(th.equal(part, b[key]) for key, part in a.items())
    return isinstance(a, th.Tensor) and isinstance(b, th.Tensor) and th.equal(a, b)
