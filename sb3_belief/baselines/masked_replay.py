"""
Replay buffers that also hold the masks of the next actions, and of which only those rows are sampled from which there is
something to learn.

The masks reach the target network as an argument, although SB3's ``train()`` knows nothing of them: they are attached to the
next observations of a minibatch, which SB3 only passes on (see :func:`~sb3_belief.belief_ppo.buffers.attach`).
"""

from typing import TYPE_CHECKING, Any

import numpy as np
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_belief.belief_ppo.buffers import attach
from sb3_belief.vec_env.observation_forms import map_parts

if TYPE_CHECKING:
    _Buffer = ReplayBuffer
else:
    _Buffer = object


class MaskedReplayMixin(_Buffer):
    """
    Makes a replay buffer of SB3's one with masks and learnable rows.

    :param args: As of SB3's buffer
    :param kwargs: As of SB3's buffer
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        rows = self.buffer_size, self.n_envs
        #: Which actions are possible at the next observation, bool ``[buffer_size, n_envs, n_actions]``
        self.next_masks = np.ones((*rows, int(self.action_space.n)), dtype=bool)  # type: ignore[attr-defined]
        #: From which rows there is something to learn, bool ``[buffer_size, n_envs]``
        self.learnable = np.ones(rows, dtype=bool)

    def stage(self, next_masks: np.ndarray | None, learnable: np.ndarray) -> None:
        """
        Set what the next row holds besides; to be called before ``add``.

        :param next_masks: Which actions are possible at its next observation, bool ``[n_envs, n_actions]``; None if all are
        :param learnable: Whether there is something to learn from it, bool ``[n_envs]``
        """
        self.next_masks[self.pos] = True if next_masks is None else next_masks
        self.learnable[self.pos] = learnable

    def _get_samples(self, batch_inds: np.ndarray, env: VecNormalize | None = None) -> Any:
        # As SB3 draws them, so that without rows to leave out the same ones are sampled as by SB3's buffer
        copies = np.random.randint(0, high=self.n_envs, size=(len(batch_inds),))
        left_out = ~self.learnable[batch_inds, copies]
        if left_out.any():
            batch_inds = batch_inds.copy()
            batch_inds[left_out], copies[left_out] = self._drawn(int(left_out.sum()))
        return self.samples_of(batch_inds, copies, env)

    def _drawn(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        rows, copies = np.nonzero(self.learnable[: self.size()])
        if not len(rows):
            raise ValueError(
                "There is nothing to learn in the replay buffer: the agent was never in play. Give a larger learning_starts,"
                " or look at what the environment says of it (infos[agent]['active'])."
            )
        chosen = np.random.randint(0, len(rows), size=n)
        return rows[chosen], copies[chosen]

    def samples_of(self, rows: np.ndarray, copies: np.ndarray, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """
        Return some rows as SB3's buffer does, with the masks attached to the next observations.

        :param rows: Number of each row, int ``[B]``
        :param copies: The copy of the environment of each, int ``[B]``
        :param env: Statistics of a normalisation
        :return: The samples
        """
        obs, next_obs = (
            map_parts(self.to_torch, self._normalize_obs(map_parts(lambda part: part[rows, copies], stored), env))
            for stored in (self.observations, self.next_observations)
        )
        # A return that was cut off goes on after the last observation
        ended = self.dones[rows, copies] * (1 - self.timeouts[rows, copies])
        rewards = self._normalize_reward(self.rewards[rows, copies].reshape(-1, 1), env)
        return ReplayBufferSamples(
            observations=obs,
            actions=self.to_torch(self.actions[rows, copies]),
            next_observations=attach(next_obs, self.to_torch(self.next_masks[rows, copies])),
            dones=self.to_torch(ended.reshape(-1, 1)),
            rewards=self.to_torch(rewards),
        )


class MaskedReplayBuffer(MaskedReplayMixin, ReplayBuffer):
    """SB3's replay buffer with masks and learnable rows, see :class:`MaskedReplayMixin`."""


class MaskedDictReplayBuffer(MaskedReplayMixin, DictReplayBuffer):
    """SB3's replay buffer for Dict observations with masks and learnable rows, see :class:`MaskedReplayMixin`."""
