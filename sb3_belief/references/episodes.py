"""A replay of whole episodes, each of its own length, and the returns of theirs that a value is trained towards."""

from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

# Of the joint observation; whether agents are in play does not enter a factorised value
KEYS = ("obs", "mask", "state")


class EpisodeBatch(NamedTuple):
    """
    Episodes side by side, filled up to the ``T`` steps of the longest one.

    :param obs: Observations, float32 ``[B, T + 1, n, d]``; the last of an episode is that in which it ended
    :param mask: Legal actions, bool ``[B, T + 1, n, U]``; all True where an episode has no row any more
    :param state: Global states, float32 ``[B, T + 1, d_s]``
    :param actions: int64 ``[B, T, n]``
    :param rewards: float32 ``[B, T]``
    :param ends: Whether the team's return ended at this step, rather than being cut off by a limit, float32 ``[B, T]``
    :param exists: Whether the episode has this step, float32 ``[B, T]``
    """

    obs: th.Tensor
    mask: th.Tensor
    state: th.Tensor
    actions: th.Tensor
    rewards: th.Tensor
    ends: th.Tensor
    exists: th.Tensor


class EpisodeReplayBuffer(ReplayBuffer):
    """
    The last ``buffer_size`` episodes of all copies of the environment.

    An episode is there from its end on, if it was recorded from its beginning, which :meth:`begin` says. SB3's own buffers
    count and draw single steps, from which neither a recurrent network nor a return over several steps can be computed.

    :param buffer_size: Number of episodes, at least 1
    :param observation_space: That of a ``JointVecEnv``
    :param action_space: That of a ``JointVecEnv``
    :param device: Device of the batches
    :param n_envs: Number of copies
    :param optimize_memory_usage: As SB3 gives it; False
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
    ):
        # Not ReplayBuffer's: it allocates arrays of single steps
        BaseBuffer.__init__(self, buffer_size, observation_space, action_space, device, n_envs)
        # What SB3 looks for when it loads one; limits are told from ends here
        self.handle_timeout_termination = True
        self.episodes: list[dict[str, np.ndarray]] = []
        # The steps of the episodes under way; None until one begins
        self._open: list[list[dict[str, Any]] | None] = [None] * n_envs

    def size(self) -> int:
        """Return the number of episodes."""
        return len(self.episodes)

    def reset(self) -> None:
        self.episodes, self.pos, self.full = [], 0, False
        self._open = [None] * self.n_envs

    def begin(self, where: np.ndarray) -> None:
        """
        Begin an episode. What there is of the one before is forgotten, if it has not ended.

        :param where: The copies in which it begins, bool ``[n_envs]``
        """
        for i in np.flatnonzero(where):
            self._open[i] = []

    def add(  # type: ignore[override]
        self,
        obs: dict[str, np.ndarray],
        next_obs: dict[str, np.ndarray],
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """
        Add a step of each copy.

        :param obs: Joint observations, ``[n_envs, ...]`` by key
        :param next_obs: Those after the step, of the same episode also where it ended
        :param action: Joint actions ``[n_envs, n]``
        :param reward: Team rewards ``[n_envs]``
        :param done: Whether the episode ended, ``[n_envs]``
        :param infos: Of which ``TimeLimit.truncated`` is read
        """
        for i, steps in enumerate(self._open):
            if steps is None:
                continue
            steps.append(
                {**{key: np.array(obs[key][i]) for key in KEYS}, "actions": np.array(action[i]), "rewards": float(reward[i])}
            )
            if done[i]:
                self._open[i] = None
                last = {key: np.array(next_obs[key][i]) for key in KEYS}
                self._keep(steps, last, infos[i].get("TimeLimit.truncated", False))

    def _keep(self, steps: list[dict[str, Any]], last: dict[str, np.ndarray], truncated: bool) -> None:
        episode = {key: np.stack([*(step[key] for step in steps), last[key]]) for key in KEYS}
        episode["mask"] = episode["mask"].astype(bool)
        episode["actions"] = np.stack([step["actions"] for step in steps]).astype(np.int64)
        episode["rewards"] = np.array([step["rewards"] for step in steps], dtype=np.float32)
        episode["ends"] = np.zeros(len(steps), dtype=np.float32)
        episode["ends"][-1] = not truncated
        if self.full:
            self.episodes[self.pos] = episode
        else:
            self.episodes.append(episode)
        self.pos = (self.pos + 1) % self.buffer_size
        self.full = len(self.episodes) == self.buffer_size

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> EpisodeBatch:  # type: ignore[override]
        """
        Draw different episodes.

        :param batch_size: Number of episodes, at most ``size()``
        :param env: As SB3 gives it; not used
        :return: The episodes
        """
        drawn = np.random.choice(len(self.episodes), batch_size, replace=False)
        return self.batch([self.episodes[i] for i in drawn])

    def batch(self, episodes: list[dict[str, np.ndarray]]) -> EpisodeBatch:
        """
        Put episodes side by side.

        :param episodes: Of ``self.episodes``
        :return: The same, filled up
        """
        n_steps = max(len(episode["rewards"]) for episode in episodes)
        parts = {}
        for key in EpisodeBatch._fields[:-1]:
            first = episodes[0][key]
            length = n_steps + (key in KEYS)
            # Where nothing exists any action is as good, and a maximum over none would be minus infinity
            filled = np.full((len(episodes), length, *first.shape[1:]), key == "mask", dtype=first.dtype)
            for row, episode in zip(filled, episodes, strict=True):
                row[: len(episode[key])] = episode[key]
            parts[key] = self.to_torch(filled, copy=False)
        lengths = th.tensor([len(episode["rewards"]) for episode in episodes], device=self.device)
        exists = (th.arange(n_steps, device=self.device) < lengths[:, None]).float()
        return EpisodeBatch(**parts, exists=exists)


def lambda_returns(
    rewards: th.Tensor,
    ends: th.Tensor,
    exists: th.Tensor,
    next_values: th.Tensor,
    gamma: float,
    td_lambda: float | th.Tensor,
) -> th.Tensor:
    """
    Return TD(lambda) targets, started at each episode's own last step.

    ``G_t = r_t + gamma (1 - end_t) [(1 - lambda) Q_{t+1} + lambda G_{t+1}]``, with ``Q_{t+1}`` itself in place of ``G_{t+1}``
    at the last step. With ``lambda = 0`` they are one-step targets.

    :param rewards: ``[B, T]``
    :param ends: Whether the return ends at this step, ``[B, T]``
    :param exists: Whether the episode has this step, ``[B, T]``
    :param next_values: Value of the observation after this step, ``[B, T]``
    :param gamma: Discount factor, in [0, 1]
    :param td_lambda: In [0, 1]; a number, or one for each step ``[T]``
    :return: ``[B, T]``; where no step exists, any number
    """
    follows = th.cat([exists[:, 1:], th.zeros_like(exists[:, :1])], dim=1)
    is_last = exists > follows
    returns = th.zeros_like(rewards)
    lambdas = th.as_tensor(td_lambda, dtype=rewards.dtype, device=rewards.device).expand(rewards.shape[1])
    after = next_values[:, -1]
    for t in reversed(range(rewards.shape[1])):
        after = th.where(is_last[:, t], next_values[:, t], after)
        mixed = (1 - lambdas[t]) * next_values[:, t] + lambdas[t] * after
        after = returns[:, t] = rewards[:, t] + gamma * (1 - ends[:, t]) * mixed
    return returns
