"""What a joint step meant for each agent: who was in play, whose return ended and whose was cut off."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from sb3_belief.vec_env.returned import ALL, plain_ends, plain_flag
from sb3_belief.vec_env.validation import place

# What an agent's info says by flags
_SAID = ("active", "next_active", "life_end", "is_success")
_BOOLS = frozenset((bool, np.bool_))


class Flags(NamedTuple):
    """
    What a joint step meant for each agent.

    :param active: Whether it was in play when it acted, bool ``[n]``
    :param life_end: Whether its own return ended (it terminated, or its life ended), bool ``[n]``
    :param truncated: Whether its own return was cut off by a limit, bool ``[n]``; never together with ``life_end``
    """

    active: np.ndarray
    life_end: np.ndarray
    truncated: np.ndarray


class StepRecord(NamedTuple):
    """
    The results of a joint step other than observations and team reward.

    :param agent_rewards: Own rewards of the n agents
    :param flags: What the step meant for each agent
    :param visible: Whose action of this step each agent could observe, bool ``[n, n-1+n_scripted]``
    :param action_masks: Masks of all agents for their next actions, side by side in one row (True for an agent that has none,
        the first action for one that has left); None if the environment has no masks
    :param scripted_actions: Flattened actions of the scripted others, float32 ``[W_scripted]``; None if there are none
    """

    agent_rewards: list[float]
    flags: Flags
    visible: np.ndarray
    action_masks: np.ndarray | None
    scripted_actions: np.ndarray | None


class Events(NamedTuple):
    """
    What happened to the agents in a joint step.

    :param flags: What the step meant for each agent
    :param ended: Whether all agents that acted have terminated or been truncated, and no other is in play now
    :param left: Agents that left in this step
    :param successes: The ``is_success`` of each agent that reported one
    """

    flags: Flags
    ended: bool
    left: list[str]
    successes: dict[str, bool]


def no_flags(n_agents: int) -> Flags:
    """
    Return flags that are all False.

    :param n_agents: Number of agents
    """
    return Flags(np.zeros(n_agents, dtype=bool), np.zeros(n_agents, dtype=bool), np.zeros(n_agents, dtype=bool))


def _are_plain(ends: Mapping[str, Any], agents: Sequence[str]) -> bool:
    """Return whether the ends are flags of known agents."""
    return ends.keys() <= set(agents) and _BOOLS.issuperset(map(type, ends.values()))


def find_events(
    agents: Sequence[str],
    before: Sequence[str],
    after: Sequence[str],
    terminations: Mapping[str, bool],
    truncations: Mapping[str, bool],
    infos: Mapping[str, Any],
    copy: int,
    step: int,
) -> Events:
    """
    Find out what happened to the agents.

    :param agents: All agents
    :param before: Those that acted
    :param after: Those that are in play now
    :param terminations: As the environment returned them
    :param truncations: As the environment returned them
    :param infos: The agents' infos, each a dict or something empty
    :param copy: Number of the environment copy, for error messages
    :param step: Number of the step, for error messages
    :return: What happened
    :raises ValueError: If something is no flag, or terminates or truncates an unknown agent
    """
    over = False
    any_end = any(terminations.values()) or any(truncations.values())
    if any_end and not (_are_plain(terminations, agents) and _are_plain(truncations, agents)):
        said_of_all = terminations.get(ALL, False), truncations.get(ALL, False)
        terminations, truncations = plain_ends(terminations, truncations, agents, before, place(copy, step))
        over = any(map(np.any, said_of_all))
    left, successes = [], {}
    active, life_end, truncated = flags = no_flags(len(agents))
    ended = True
    for i, agent in enumerate(agents):
        if agent not in before:
            # The others of a relay have only just entered
            ended = ended and (over or agent not in after)
            continue
        agent_info = infos.get(agent) or {}
        if agent_info:
            for key in _SAID:
                # An environment may have the entry and not know yet
                if type(agent_info.get(key, False)) not in _BOOLS and not (key == "is_success" and agent_info[key] is None):
                    said = plain_flag(f"infos have {key!r} =", agent_info[key], agent, place(copy, step))
                    agent_info = {**agent_info, key: said}
        terminates, truncates = terminations.get(agent, False), truncations.get(agent, False)
        has_left = agent not in after
        # An agent that leaves for no stated reason has ended its life: there is nothing to bootstrap from
        if terminates or agent_info.get("life_end", False) or (has_left and not truncates):
            life_end[i] = True
        elif truncates:
            truncated[i] = True
        if agent_info.get("active", True):
            active[i] = True
        if has_left:
            left.append(agent)
        if not (terminates or truncates):
            ended = False
        if agent_info.get("is_success") is not None:
            successes[agent] = bool(agent_info["is_success"])
    return Events(flags, ended, left, successes)
