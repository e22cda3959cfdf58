"""An environment and partners that the tests of fixed partners share."""

from functools import partial
from typing import Any

import sb3_belief
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
