"""What an environment's infos hold besides the contract of a team, as it reaches the infos of the team and of its agents."""

from collections.abc import Mapping
from copy import deepcopy
from typing import Any

import numpy as np

# What a team reads from an agent's info
CONTRACT = frozenset(("action_mask", "active", "life_end", "is_success"))
# Keys with a meaning of their own in the infos of a team or an agent, which an environment's entries must not replace
RESERVED = CONTRACT | {
    "TimeLimit.truncated",
    "action_masks",
    "agent_episode_rewards",
    "agent_infos",
    "agent_rewards",
    "episode",
    "joint",
    "others_actions",
    "others_visible",
    "scripted_actions",
    "team_state",
    "terminal_action_masks",
    "terminal_observation",
    "terminal_state",
    "truncated",
    "visible",
}
_NUMBERS = frozenset((int, float, bool, np.bool_, np.float64, np.float32, np.int64, np.int32, np.uint8, np.int8))
_CONSTANTS = _NUMBERS | {str, type(None)}


def own_infos(infos: Mapping[str, Any], agents: Mapping[str, Any]) -> dict[str, Any]:
    """
    Return what the infos of a step hold besides the contract.

    :param infos: What the environment returned: dicts by agent, and what it says of the team under other names
    :param agents: ``possible_agents`` as keys
    :return: Entries of the team's info: ``agent_infos`` {agent: its own entries}; each of their keys, with the mean over the
        agents that report it for a number, otherwise the first agent's; and what stands under names that are no agents. Empty
        if there is nothing
    """
    by_agent: dict[str, dict[str, Any]] = {}
    values: dict[str, list[Any]] = {}
    team: dict[str, Any] = {}
    for name, info in infos.items():
        if name not in agents:
            if name not in RESERVED:
                team[name] = _kept(info)
        elif info and not info.keys() <= CONTRACT:
            own = {
                key: value if type(value) in _CONSTANTS else _kept(value) for key, value in info.items() if key not in RESERVED
            }
            if own:
                if "next_active" in own:
                    # Known to be one flag, perhaps as an array
                    own["next_active"] = bool(np.any(own["next_active"]))
                by_agent[name] = own
                for key, value in own.items():
                    values.setdefault(key, []).append(value)
    if not by_agent:
        return team
    team["agent_infos"] = by_agent
    # It says something of each agent alone
    values.pop("next_active", None)
    for key, reported in values.items():
        if key not in team:
            numbers = _NUMBERS.issuperset(map(type, reported))
            team[key] = float(sum(reported) / len(reported)) if numbers else reported[0]
    return team


def _kept(value: Any) -> Any:
    """Return a value that does not change when the environment goes on; SB3's vectorisers copy infos for the same reason."""
    if isinstance(value, np.ndarray) and value.dtype != object:
        return value.copy()
    try:
        return deepcopy(value)
    except Exception:
        # Locks, generators, open files: what cannot be copied is passed on as it is
        return value
