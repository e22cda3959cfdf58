"""Checks of what a user gives a ``Team``."""

from collections.abc import Mapping, Sequence
from typing import Any

from pettingzoo import ParallelEnv
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_belief.vec_env.team_vec_env import TeamVecEnv


def check_env(env: Any) -> VecEnv:
    """
    :param env: what was given as the environment of a team
    :return: the same
    :raises TypeError: if it is not a ``TeamVecEnv`` or SB3 wrappers around one
    :raises ValueError: if it is normalised as a whole
    """
    if isinstance(env, VecEnv) and isinstance(env.unwrapped, TeamVecEnv):
        if unwrap_vec_normalize(env) is not None:
            raise ValueError(
                "The environment of a Team must not be wrapped in VecNormalize, which would not reach the agents' own rewards:"
                " use Team(..., normalize=True), which gives each agent statistics of its own."
            )
        return env
    if isinstance(env, ParallelEnv):
        raise TypeError(
            f"A Team learns in a vectorised environment, not in a {type(env).__name__} itself: pass"
            " make_team_env(lambda: your_env, n_envs=...) with a callable that makes it."
        )
    raise TypeError(f"A Team needs a TeamVecEnv (see make_team_env) or SB3 wrappers of one, got {type(env).__name__}.")


def per_agent(name: str, given: Any, agents: Sequence[str]) -> dict[str, Any]:
    """
    :param name: of the argument, for messages
    :param given: one value for all, or {agent: value}
    :param agents: names of the agents
    :return: {agent: value}
    :raises ValueError: if agents are unknown or missing
    """
    if not isinstance(given, Mapping):
        return {agent: given for agent in agents}
    check_names(name, given, agents)
    missing = [agent for agent in agents if agent not in given]
    if missing:
        raise ValueError(f"{name} has no entry for {missing}; it needs one for each of {list(agents)}, or one value for all.")
    return {agent: given[agent] for agent in agents}


def check_names(name: str, given: Mapping[str, Any], agents: Sequence[str]) -> None:
    """
    :param name: of the argument, for messages
    :param given: {agent: value}
    :param agents: names of the agents
    :raises ValueError: if agents are unknown
    """
    unknown = [agent for agent in given if agent not in agents]
    if unknown:
        raise ValueError(f"{name} has entries for unknown agents {unknown}; the agents are {list(agents)}.")
