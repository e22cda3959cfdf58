"""An environment and partners that the tests of fixed partners share."""

from functools import partial
from typing import Any

import sb3_belief
from tests.team.helpers import Team, make_team_env
from tests.team.toy_envs import ToyEnv

# Typed as Any, since the tests also look at attributes that the public type does not have
AgentEnv: Any = sb3_belief.AgentEnv


def zero(obs):
    """Do action 0, as a partner."""
    return 0


def one(obs):
    """Do action 1, as a partner."""
    return 1


def toy(n_agents=3):
    """Return a function that makes a ``ToyEnv``."""
    return partial(ToyEnv, n_agents=n_agents)


def save_exploring_team(path, algo, n_agents):
    """Save a team of Q-learners that do a random action in every second step."""
    env = make_team_env(toy(n_agents), n_envs=1)
    kwargs: dict[str, Any] = {"learning_starts": 4, "exploration_initial_eps": 0.5, "exploration_final_eps": 0.5}
    kwargs |= {"policy_kwargs": {"net_arch": [8]}, "device": "cpu"}
    Team(algo, "MlpPolicy", env, seed=0, **kwargs).learn(16).save(path)
    return str(path)
