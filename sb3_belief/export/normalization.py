"""The normalisation of an agent's observations, as a part of what is exported."""

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn


class Normalization(nn.Module):
    """
    Normalises observations as ``VecNormalize`` does, in double precision as it does.

    :param statistics: Normalises observations; its present statistics are taken over
    """

    def __init__(self, statistics: VecNormalize) -> None:
        super().__init__()
        found: Any = statistics.obs_rms
        # For a Dict only some of the keys may be normalised
        by_key = {key: found[key] for key in statistics.norm_obs_keys or ()} if isinstance(found, dict) else {None: found}
        self._scales = {
            key: (th.as_tensor(rms.mean), th.as_tensor(np.sqrt(rms.var + statistics.epsilon))) for key, rms in by_key.items()
        }
        self._clip = statistics.clip_obs

    def forward(self, observation: Any) -> Any:
        """
        Normalise.

        :param observation: Observations, ``[B, ...]``, or a dict of them
        :return: The same, float32 where they are normalised
        """
        if isinstance(observation, dict):
            return {key: self._scaled(part, key) if key in self._scales else part for key, part in observation.items()}
        return self._scaled(observation, None)

    def _scaled(self, values: th.Tensor, key: str | None) -> th.Tensor:
        mean, deviation = self._scales[key]
        return ((values - mean) / deviation).clamp(-self._clip, self._clip).float()
