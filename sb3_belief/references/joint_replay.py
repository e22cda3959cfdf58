"""A replay of joint steps that keeps each agent's own reward and end."""

from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize


class JointSamples(NamedTuple):
    """
    Joint steps.

    :param observations: Joint observations, ``[B, ...]`` by key
    :param actions: Joint actions as they were stored, ``[B, ...]``
    :param next_observations: Those after the steps, of the same episode, ``[B, ...]`` by key; of an agent whose own return
        ends there, its last one
    :param rewards: The agents' own rewards, ``[B, n]``
    :param ends: Whether an agent's own return ended, 1 or 0, ``[B, n]``
    :param in_play: Whether an agent was in play when it acted, 1 or 0, ``[B, n]``
    :param return_runs: Whether an agent's own return ran, 1 or 0, ``[B, n]``: that of a dead one does until it ends
    """

    observations: dict[str, th.Tensor]
    actions: th.Tensor
    next_observations: dict[str, th.Tensor]
    rewards: th.Tensor
    ends: th.Tensor
    in_play: th.Tensor
    return_runs: th.Tensor


class JointReplayBuffer(DictReplayBuffer):
    """
    SB3's ``DictReplayBuffer`` of joint steps, with what a ``JointVecEnv`` says of each agent in its infos.

    It takes the arguments of a ``DictReplayBuffer``.
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        agents: Any = self.observation_space["active"]
        shape = (self.buffer_size, self.n_envs, *agents.shape)
        #: The agents' own rewards, ends, whether they were in play and whether their returns ran, float32
        #: ``[buffer_size, n_envs, n]``
        self.own_rewards, self.own_ends, self.in_play, self.return_runs = (np.zeros(shape, dtype=np.float32) for _ in range(4))
        # Whose return has begun and not ended after the last step, bool [n_envs, n]
        self._running = np.zeros(shape[1:], dtype=bool)

    def begin_episodes(self) -> None:
        """Note that all copies are at the beginning of an episode, without an end before it."""
        self._running[:] = False

    def add(
        self, obs: Any, next_obs: Any, action: np.ndarray, reward: np.ndarray, done: np.ndarray, infos: list[dict[str, Any]]
    ) -> None:
        pos = self.pos
        for array, key in ((self.own_rewards, "own_rewards"), (self.own_ends, "own_ends"), (self.in_play, "in_play")):
            array[pos] = [info[key] for info in infos]
        runs = self._running | (self.in_play[pos] > 0)
        self.return_runs[pos] = runs
        self._running = runs & ~np.asarray(done, dtype=bool)[:, None]
        super().add(obs, next_obs, action, reward, done, infos)
        for copy, info in enumerate(infos):
            for agent, row in info.get("last_obs", {}).items():
                # What follows is not of this return any more
                self.next_observations["obs"][pos, copy, agent] = row
                self._running[copy, agent] = False

    def _get_samples(  # type: ignore[override]
        self, batch_inds: np.ndarray, env: VecNormalize | None = None
    ) -> JointSamples:
        at = batch_inds, np.random.randint(self.n_envs, size=len(batch_inds))
        obs, next_obs = (
            {key: self.to_torch(part[at]) for key, part in parts.items()}
            for parts in (self.observations, self.next_observations)
        )
        rows = (self.to_torch(array[at]) for array in (self.own_rewards, self.own_ends, self.in_play, self.return_runs))
        return JointSamples(obs, self.to_torch(self.actions[at]), next_obs, *rows)
