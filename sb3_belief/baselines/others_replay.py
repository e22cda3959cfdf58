"""Masked replay buffers that also hold what the agent saw the others do."""

from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_belief.baselines.masked_replay import MaskedReplayMixin
from sb3_belief.belief_ppo.buffers import attach


class OthersMinibatch(NamedTuple):
    """
    What a minibatch holds of the others; ``B`` rows, in the order of the observations to which it is attached.

    :param actions: Their actions of the same step, encoded side by side, float32 ``[B, W]``, zero where not visible
    :param visible: Whose action was visible, bool ``[B, n_others]``
    """

    actions: th.Tensor
    visible: th.Tensor


class OthersReplayMixin(MaskedReplayMixin):
    """
    Makes a masked replay buffer one that also holds what the agent saw the others do.

    :param args: As of SB3's buffer
    :param others_width: ``W``, the width of the others' encoded actions
    :param n_others: Number of the others
    :param kwargs: As of SB3's buffer
    """

    def __init__(self, *args: Any, others_width: int = 0, n_others: int = 0, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        rows = self.buffer_size, self.n_envs
        #: The others' actions of the same step, zero where not visible, float32 ``[buffer_size, n_envs, W]``
        self.others_actions = np.zeros((*rows, others_width), dtype=np.float32)
        #: Whose action was visible, bool ``[buffer_size, n_envs, n_others]``
        self.others_visible = np.zeros((*rows, n_others), dtype=bool)

    def stage_others(self, actions: np.ndarray, visible: np.ndarray) -> None:
        """
        Set what the next row holds of the others; to be called before ``add``.

        :param actions: Their actions, float32 ``[n_envs, W]``
        :param visible: Whose action was visible, bool ``[n_envs, n_others]``
        """
        self.others_actions[self.pos], self.others_visible[self.pos] = actions, visible

    def samples_of(self, rows: np.ndarray, copies: np.ndarray, env: VecNormalize | None = None) -> ReplayBufferSamples:
        samples = super().samples_of(rows, copies, env)
        others = OthersMinibatch(*(self.to_torch(part[rows, copies]) for part in (self.others_actions, self.others_visible)))
        return samples._replace(observations=attach(samples.observations, others))


class OthersReplayBuffer(OthersReplayMixin, ReplayBuffer):
    """SB3's replay buffer with masks and the others' actions, see :class:`OthersReplayMixin`."""


class OthersDictReplayBuffer(OthersReplayMixin, DictReplayBuffer):
    """SB3's replay buffer for Dict observations with masks and the others' actions, see :class:`OthersReplayMixin`."""
