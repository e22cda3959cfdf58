"""Policies without training that show what a task of changing teammates allows, and their evaluation."""

from typing import Any

import numpy as np

from sb3_belief.vec_env.team_vec_env import TeamObs, TeamVecEnv


class ReferencePolicy:
    """Policy of all learners of a vectorised environment, which may remember what each copy has shown."""

    def act(self, obs: TeamObs, partners: list[str]) -> TeamObs:
        """
        Choose the next actions.

        :param obs: Observations [n_envs, ...] by agent
        :param partners: Name of the partner in each copy, for policies that are told
        :return: Actions [n_envs, ...] by agent
        """
        raise NotImplementedError

    def watch(self, obs: TeamObs, rewards: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]) -> None:
        """
        Take note of a step.

        :param obs: The observations before it, [n_envs, ...] by agent
        :param rewards: The team's rewards, [n_envs]
        :param dones: Where the step has ended an episode, bool [n_envs]
        :param infos: Infos of the step
        """


def reference_returns(policy: ReferencePolicy, env: TeamVecEnv, episodes: int, seed: int = 0) -> np.ndarray:
    """
    Let a policy play.

    :param policy: The policy
    :param env: The environment, which is seeded and reset
    :param episodes: Number of episodes that each copy plays, >= 1
    :param seed: Copy i is seeded with ``seed + i``
    :return: Returns of the episodes in the order of each copy, float64 [n_envs, episodes]
    :raises ValueError: If ``episodes`` is not positive
    """
    if episodes < 1:
        raise ValueError(f"episodes={episodes} must be at least 1.")
    returns: list[list[float]] = [[] for _ in range(env.num_envs)]
    env.seed(seed)
    obs = env.reset()
    while min(map(len, returns)) < episodes:
        next_obs, rewards, dones, infos = env.step(policy.act(obs, env.get_attr("partner")))
        policy.watch(obs, rewards, dones, infos)
        obs = next_obs
        for copy in np.flatnonzero(dones):
            returns[copy].append(infos[copy]["episode"]["r"])
    return np.array([each[:episodes] for each in returns])
