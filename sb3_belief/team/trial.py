"""A small team that plays and learns for a moment, to see whether one can be trained in an environment."""

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_belief.belief_ppo import BeliefPPO, MaskableBeliefPPO
from sb3_belief.common.action_masks import sample_action
from sb3_belief.envs.env_util import make_team_env
from sb3_belief.team.team import Team

# Enough for two rollouts of two copies, an update, and a belief with a history
_SMALL: dict[str, Any] = {
    "n_steps": 8,
    "batch_size": 16,
    "n_epochs": 1,
    "history_length": 8,
    "policy_kwargs": {"net_arch": [8], "embedding_dim": 8, "latent_dim": 8},
}
_N_ENVS, _N_TIMESTEPS = 2, 32


def try_to_learn(make: Callable[[], Any], n_steps: int, seed: int) -> None:
    """
    Play at random as a team's environment plays, and let a small team of ``BeliefPPO`` learn.

    :param make: Makes a copy of the environment
    :param n_steps: Number of random steps, over all copies
    :param seed: Seed of the team and of the random actions
    :raises Exception: Whatever a training would raise
    """
    env = make_team_env(make, n_envs=_N_ENVS, seed=seed)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            env.reset()
            rng = np.random.default_rng(seed)
            for _ in range(n_steps // _N_ENVS):
                env.step(_random_actions(env, rng))
            masked = env.action_masks() or {}
            classes: dict[str, type[BaseAlgorithm]] = {
                agent: MaskableBeliefPPO if agent in masked else BeliefPPO for agent in env.possible_agents
            }
            Team(classes, "BeliefPolicy", env, seed=seed, device="cpu", **_SMALL).learn(_N_TIMESTEPS)
    finally:
        env.close()


def _random_actions(env: Any, rng: np.random.Generator) -> dict[str, np.ndarray]:
    masks = env.action_masks() or {}
    return {
        agent: np.stack(
            [
                sample_action(env.action_space[agent], masks[agent][copy] if agent in masks else None, rng)
                for copy in range(env.num_envs)
            ]
        )
        for agent in env.possible_agents
    }
