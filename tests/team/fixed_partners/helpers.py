"""Environments and partners that the tests of fixed partners share."""

from functools import partial
from typing import Any

import sb3_belief
from tests.team.toy_envs import ToyEnv

AgentEnv: Any = sb3_belief.AgentEnv


def zero(obs):
    return 0


def one(obs):
    return 1


def toy(n_agents=3):
    return partial(ToyEnv, n_agents=n_agents)
