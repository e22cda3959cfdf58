"""Checks and conversions of what a user gives a ``Team``."""

import math
from collections.abc import Collection, Mapping, Sequence
from numbers import Real
from typing import Any

from pettingzoo import ParallelEnv
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ConvertCallback, ProgressBarCallback
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.vec_env import (
    VecEnv,
    VecEnvWrapper,
    VecExtractDictObs,
    VecFrameStack,
    VecTransposeImage,
    unwrap_vec_normalize,
    unwrap_vec_wrapper,
)

from sb3_belief.vec_env.team_vec_env import TeamVecEnv

# SB3's wrappers that look at observations take the team for a single agent: they know one done and one last observation of a
# copy, while each agent of a team has its own, also in the midst of the team's episode
_REFUSED_WRAPPERS: dict[type[VecEnvWrapper], str] = {
    VecFrameStack: (
        "which knows only the ends of the team's episodes, not those of each agent. Stack frames for each agent:"
        " make_team_env(..., wrapper=partial(supersuit.frame_stack_v2, stack_size=4))."
    ),
    VecTransposeImage: "which is not needed: each agent's model puts the channels of its images first. Leave it out.",
    VecExtractDictObs: "which keeps a single agent's observations: AgentEnv is the environment of a single learner.",
}


def check_team_vec_env(env: Any) -> VecEnv:
    """
    Check the environment of a team.

    :param env: What the user gave
    :return: The same
    :raises TypeError: If it is not a ``TeamVecEnv`` or SB3 wrappers around one
    :raises ValueError: If it has a wrapper that does not do for each agent what it does for one
    """
    if isinstance(env, VecEnv) and isinstance(env.unwrapped, TeamVecEnv):
        if unwrap_vec_normalize(env) is not None:
            raise ValueError(
                "The environment of a Team must not be wrapped in VecNormalize, which would not reach the agents' own rewards:"
                " use Team(..., normalize=True), which gives each agent statistics of its own."
            )
        for wrapper, why in _REFUSED_WRAPPERS.items():
            if unwrap_vec_wrapper(env, wrapper) is not None:
                raise ValueError(f"The environment of a Team must not be wrapped in {wrapper.__name__}, {why}")
        return env
    if isinstance(env, ParallelEnv):
        raise TypeError(
            f"A Team learns in a vectorised environment, not in a {type(env).__name__} itself: pass"
            " make_team_env(lambda: your_env, n_envs=...) with a callable that makes it."
        )
    raise TypeError(f"A Team needs a TeamVecEnv (see make_team_env) or SB3 wrappers of one, got {type(env).__name__}.")


def per_agent(name: str, given: Any, agents: Sequence[str]) -> dict[str, Any]:
    """
    Give each agent its value of an argument.

    :param name: Name of the argument, for messages
    :param given: One value for all agents, or a dict of one for each
    :param agents: Names of the agents
    :return: The value of each agent
    :raises ValueError: If agents are unknown or missing
    """
    if not isinstance(given, Mapping):
        return {agent: given for agent in agents}
    check_agent_keys(name, given, agents)
    missing = [agent for agent in agents if agent not in given]
    if missing:
        raise ValueError(f"{name} has no entry for {missing}; it needs one for each of {list(agents)}, or one value for all.")
    return {agent: given[agent] for agent in agents}


def check_total_timesteps(total_timesteps: Any) -> None:
    """
    Check a number of joint steps.

    :param total_timesteps: What the user gave to ``learn``
    :raises ValueError: If it is no finite number of at least 0: a team would learn nothing, or for ever
    """
    is_number = isinstance(total_timesteps, Real) and not isinstance(total_timesteps, bool)
    if not (is_number and 0 <= float(total_timesteps) < math.inf):
        raise ValueError(f"total_timesteps is {total_timesteps!r}; it must be a number of joint steps of at least 0.")


def check_agent_keys(name: str, given: Mapping[str, Any], agents: Sequence[str]) -> None:
    """
    Check that a dict by agent has no unknown agents.

    :param name: Name of the argument, for messages
    :param given: The dict
    :param agents: Names of the agents
    :raises ValueError: If agents are unknown
    """
    unknown = [agent for agent in given if agent not in agents]
    if unknown:
        raise ValueError(f"{name} has entries for unknown agents {unknown}; the agents are {list(agents)}.")


def partners_hint(scripted: Collection[str], env_agents: Collection[str]) -> str:
    """
    Return what to say where an environment has agents to act for that a team has learned beside.

    :param scripted: Names of the team's scripted others
    :param env_agents: Names of the environment's agents
    :return: A sentence, or nothing
    """
    missing = [name for name in scripted if name in env_agents]
    if not missing:
        return ""
    return (
        f" Partners acted for {missing} when the team learned: give them, PartnersVecEnv(env, partners) or Team.load(path,"
        " env=env, partners=partners)."
    )


def check_learners(partners: Collection[str], **given: Any) -> None:
    """
    Check that no agent that a partner acts for is to learn.

    :param partners: Names of the agents that partners act for
    :param given: Arguments of a team that may be dicts by agent, by their names
    :raises ValueError: If one of them has an entry for such an agent
    """
    for name, by_agent in given.items():
        both = [agent for agent in by_agent if agent in partners] if isinstance(by_agent, Mapping) else []
        if both:
            raise ValueError(f"{name} has entries for {both}, but partners act for them: an agent learns or has a partner.")


def check_same_agents(
    agents: list[str], scripted: dict[str, str], env_agents: list[str], env_scripted: dict[str, str]
) -> None:
    """
    Check that another environment has the agents of a team.

    :param agents: Names of the team's agents
    :param scripted: Action spaces of its scripted others as text, by name and in order
    :param env_agents: Names of the environment's agents
    :param env_scripted: Action spaces of its scripted others
    :raises ValueError: If they differ
    """
    if env_agents != agents:
        hint = partners_hint(scripted, env_agents)
        raise ValueError(f"The team has the agents {agents}, the environment {env_agents}.{hint}")
    if list(env_scripted.items()) != list(scripted.items()):
        raise ValueError(f"The team has learned with the scripted others {scripted}, the environment has {env_scripted}.")


def as_callback(callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
    """
    Convert what SB3's ``learn`` takes as a callback into one callback.

    :param callback: None, a function, a callback or a list of them
    :param progress_bar: Whether to add SB3's progress bar
    :return: One callback
    """
    if isinstance(callback, list):
        callback = CallbackList(callback)
    if not isinstance(callback, BaseCallback):
        callback = ConvertCallback(callback)
    return CallbackList([callback, ProgressBarCallback()]) if progress_bar else callback
