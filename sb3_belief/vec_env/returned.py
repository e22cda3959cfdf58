"""
What a user's environment returned, in the form that PettingZoo describes: dicts by agent of numbers, flags and dicts.

A ``JointEnv`` calls these functions where a cheap look has found something unusual. What is clear is converted, the rest is
refused with agent, copy and step.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from sb3_belief.vec_env.validation import check_names, not_finite

StepParts = tuple[dict[str, Any], dict[str, Any], dict[str, Any], dict[str, Any], dict[str, Any]]
# Under this name RLlib's environments say that all who acted have terminated or been truncated
ALL = "__all__"
_PARTS = ("observations", "rewards", "terminations", "truncations", "infos")


def plain_reset(result: Any, where: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """
    Return observations and infos of a reset.

    :param result: What ``reset()`` returned: both, or, as in old environments, observations alone
    :param where: Copy and step, in words
    :return: Two dicts by agent
    :raises ValueError: If it is neither
    """
    if isinstance(result, Mapping):
        result = result, {}
    if not isinstance(result, (tuple, list)) or len(result) != 2:
        raise ValueError(
            f"reset() returned {_described(result)} {where}: it must return two dicts by agent, (observations, infos)."
        )
    obs, infos = result
    return _as_dict("observations", obs, where), _as_dict("infos", {} if infos is None else infos, where)


def plain_step(result: Any, where: str) -> StepParts:
    """
    Return the five parts of a step.

    :param result: What ``step()`` returned. Of four parts, as in old environments, the third says who is done; as Gymnasium
        reads them, a done is a termination unless the agent's info has ``TimeLimit.truncated``
    :param where: Copy and step, in words
    :return: Observations, rewards, terminations, truncations and infos, dicts by agent
    :raises ValueError: If there are other parts, or one of them is no dict
    """
    # Four parts without infos are not the old ones
    if not isinstance(result, (tuple, list)) or len(result) not in (4, 5) or (len(result) == 4 and not _are_infos(result[3])):
        raise ValueError(
            f"step() returned {_described(result)} {where}: it must return five dicts by agent, ({', '.join(_PARTS)})."
        )
    *parts, infos = result
    infos = _as_dict("infos", {} if infos is None else infos, where)
    if len(parts) == 3:
        dones = _as_dict("dones", parts.pop(), where)
        limits = {agent: bool((infos.get(agent) or {}).get("TimeLimit.truncated", False)) for agent in dones}
        parts += [{agent: bool(done) and not limits[agent] for agent, done in dones.items()}]
        parts += [{agent: bool(done) and limits[agent] for agent, done in dones.items()}]
    obs, rewards, terminations, truncations = (_as_dict(name, part, where) for name, part in zip(_PARTS, parts, strict=False))
    return obs, rewards, terminations, truncations, infos


def plain_rewards(rewards: Mapping[str, Any], where: str) -> dict[str, float]:
    """
    Return rewards as numbers.

    :param rewards: A number, or an array or list of one number, by agent
    :param where: Copy and step, in words
    :raises ValueError: For anything else, e.g. a vector of several rewards
    """
    return {agent: _number(f"reward of {agent!r}", reward, where) for agent, reward in rewards.items()}


def plain_team_reward(given: Any, where: str) -> float:
    """
    Return the team's reward as a number.

    :param given: What ``team_reward()`` returned: a number, or an array or list of one
    :param where: Copy and step, in words
    :raises ValueError: For anything else, or if it is not finite
    """
    reward = _number("team's reward", given, where)
    if not np.isfinite(reward):
        raise not_finite("team's reward", np.asarray(reward), where)
    return reward


def _number(what: str, given: Any, where: str) -> float:
    try:
        array = np.asarray(given)
        if array.size == 1 and array.dtype.kind in "biufO":
            return float(array.item())
    except (TypeError, ValueError):
        pass
    raise ValueError(
        f"The {what} {where} is {given!r}, but a team learns from one number: add up or weigh what it consists of."
    )


def plain_flags(name: str, flags: Mapping[str, Any], agents: Iterable[str], where: str) -> dict[str, bool]:
    """
    Return flags as bools.

    :param name: ``"terminations"`` or ``"truncations"``
    :param flags: Flags by agent
    :param agents: ``possible_agents``
    :param where: Copy and step, in words
    :raises ValueError: If an agent is unknown, or something cannot be read as a flag
    """
    check_names([*agents, ALL], (), (), {name: flags}, where)
    return {agent: plain_flag(f"{name} have", flag, agent, where) for agent, flag in flags.items()}


def plain_flag(what: str, given: Any, agent: str, where: str) -> bool:
    """
    Return a flag as a bool.

    :param what: What has it, with a verb
    :param given: True or False, 1 or 0, or an array or list of one of these
    :param agent: Whom it concerns
    :param where: Copy and step, in words
    :raises ValueError: If it is something else
    """
    try:
        array = np.asarray(given)
    except ValueError:
        # Lists of different lengths
        array = np.zeros(0)
    if array.size != 1 or array.dtype.kind not in "biuf" or array.item() not in (0, 1):
        raise ValueError(f"The {what} {given!r} for {agent!r} {where}: return True or False for each agent.")
    return bool(array.item())


def plain_ends(
    terminations: Mapping[str, Any], truncations: Mapping[str, Any], agents: Iterable[str], before: Iterable[str], where: str
) -> tuple[dict[str, bool], dict[str, bool]]:
    """
    Return who has terminated and who was truncated, also where an environment says it of all at once.

    :param terminations: Flags by agent. As in RLlib, True under ``"__all__"`` holds for all who acted, but not for those who
        are truncated by an entry of their own
    :param truncations: The same
    :param agents: ``possible_agents``
    :param before: The agents that acted
    :param where: Copy and step, in words
    :return: Both, by agent alone
    :raises ValueError: If an agent is unknown, or something cannot be read as a flag
    """
    terminated = plain_flags("terminations", terminations, agents, where)
    truncated = plain_flags("truncations", truncations, agents, where)
    if terminated.pop(ALL, False):
        terminated |= {agent: not truncated.get(agent, False) or terminated.get(agent, False) for agent in before}
    if truncated.pop(ALL, False):
        truncated |= {agent: not terminated.get(agent, False) or truncated.get(agent, False) for agent in before}
    return terminated, truncated


def plain_infos(infos: Mapping[str, Any], agents: Iterable[str], where: str) -> dict[str, dict[str, Any]]:
    """
    Return the agents' infos as dicts.

    :param infos: A dict or None by agent; entries of other names remain as they are
    :param agents: ``possible_agents``
    :param where: Copy and step, in words
    :raises ValueError: If the info of an agent is neither
    """
    plain = dict(infos)
    for agent in agents:
        info = plain.pop(agent, None)
        if info is not None:
            if not isinstance(info, Mapping):
                raise ValueError(f"The info of {agent!r} {where} is {_described(info)}: an agent's info is a dict.")
            plain[agent] = dict(info)
    return plain


def _are_infos(part: Any) -> bool:
    return part is None or (
        isinstance(part, Mapping) and all(info is None or isinstance(info, Mapping) for info in part.values())
    )


def _as_dict(name: str, part: Any, where: str) -> dict[str, Any]:
    if not isinstance(part, Mapping):
        raise ValueError(
            f"The environment's {name} {where} are {_described(part)}: return a dict with an entry for each agent."
        )
    return dict(part)


def _described(given: Any) -> str:
    if isinstance(given, (tuple, list)):
        return f"a {type(given).__name__} of {len(given)}"
    return "None" if given is None else f"a {type(given).__name__}"


def plain_parts(result: Any, agents: Iterable[str], where: str) -> StepParts:
    """
    Convert all that a step returned, or find out what is wrong with it.

    :param result: What ``step`` returned
    :param agents: Names of the agents
    :param where: Copy and step, in words
    :return: Observations, rewards, terminations, truncations and infos, by agent
    :raises ValueError: If it cannot be converted
    """
    obs, rewards, terminations, truncations, infos = plain_step(result, where)
    return (
        obs,
        plain_rewards(rewards, where),
        plain_flags("terminations", terminations, agents, where),
        plain_flags("truncations", truncations, agents, where),
        plain_infos(infos, agents, where),
    )
