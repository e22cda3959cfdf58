"""Checks of what a team's environment declares and returns, with messages that name agent, copy and step."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces


def place(copy: int, step: int) -> str:
    """
    Return where something happened, in words.

    :param copy: Number of the environment copy, from 0
    :param step: Number of the step in the episode, from 1; 0 for its reset
    """
    return f"in environment copy {copy} at " + (f"step {step}" if step else "reset")


def check_spaces(
    agents: Sequence[str],
    observation_spaces: Mapping[str, spaces.Space],
    action_spaces: Mapping[str, spaces.Space],
    scripted_action_spaces: Mapping[str, spaces.Space],
) -> None:
    """
    Check names and spaces.

    :param agents: Names of the agents
    :param observation_spaces: Observation spaces by agent
    :param action_spaces: Action spaces by agent
    :param scripted_action_spaces: Action spaces of the scripted others
    :raises ValueError: For names or spaces that a team cannot have
    """
    if not agents or len(set(agents)) != len(agents):
        raise ValueError(f"possible_agents must be one or more different names, got {agents}.")
    for name, given in (("observation_spaces", observation_spaces), ("action_spaces", action_spaces)):
        missing, unknown = difference(agents, given)
        if missing or unknown:
            raise ValueError(f"{name} must have a space for each of {agents}: missing {missing}, unknown {unknown}.")
    allowed = (spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary, spaces.Box)
    kinds = ", ".join(kind.__name__ for kind in allowed)
    for agent in agents:
        space = observation_spaces[agent]
        parts = list(space.spaces.values()) if isinstance(space, spaces.Dict) else [space]
        if not parts or not all(isinstance(part, allowed) for part in parts):
            raise ValueError(
                f"The observation space of {agent!r} is {space}; allowed are {kinds}, and a Dict of these. An environment's"
                " own may also be a Tuple or nested, which sb3_belief.envs.to_parallel() converts."
            )
        if any(np.any(getattr(part, "start", 0)) for part in parts):
            raise ValueError(
                f"The observation space of {agent!r} is {space}: SB3 encodes observations from 0, so the environment must"
                " count from 0 too (start=0)."
            )
        actions = action_spaces[agent]
        if isinstance(actions, spaces.Box) and not (np.isfinite(actions.low) & np.isfinite(actions.high)).all():
            raise ValueError(
                f"The action space of {agent!r} is {actions}, without finite bounds, in which no SB3 model can act: give it"
                " bounds, e.g. Box(-1, 1, ...) with actions that the environment scales."
            )
    both = [name for name in scripted_action_spaces if name in agents]
    if both:
        raise ValueError(
            f"scripted_action_spaces has entries for {both}, which are agents: a scripted other does not learn, so its name"
            f" must differ from the agents' {list(agents)}."
        )
    for name, space in {**action_spaces, **scripted_action_spaces}.items():
        if not isinstance(space, allowed):
            raise ValueError(f"The action space of {name!r} is {space}; allowed are {kinds}.")
        if np.any(getattr(space, "start", 0)):
            raise ValueError(
                f"The action space of {name!r} is {space}: SB3 numbers actions from 0, so the environment must too (start=0)."
            )


def difference(expected: Sequence[str], given: Iterable[str]) -> tuple[list[str], list[str]]:
    """
    Compare names.

    :param expected: The names that there should be
    :param given: The names that there are
    :return: The names that are missing, and those that are not expected
    """
    given = list(given)
    return [name for name in expected if name not in given], [name for name in given if name not in expected]


def check_wrappers(env: Any) -> None:
    """
    Check the wrappers of an environment.

    :param env: A ``ParallelEnv``, with or without wrappers
    :raises ValueError: For a wrapper that hides what a team has to know
    """
    while env is not None:
        members = getattr(env, "__dict__", {})
        if type(env).__name__ == "black_death_par":
            raise ValueError(
                "supersuit.black_death_v3 is not needed here, and hides which agents are still in play, and whether they"
                " terminated or were cut by a limit. A team does its work: who leaves early stays a member with a zero"
                " observation, and is known to be inactive. Leave it out."
            )
        # A conversion from AEC holds its environment under "aec_env"
        env = members.get("env") or members.get("aec_env")


def check_names(
    agents: Sequence[str], before: Iterable[str], after: Iterable[str], given: Mapping[str, Mapping[str, Any]], where: str
) -> None:
    """
    Check the names of agents in what an environment returned.

    :param agents: ``possible_agents`` as they were when the environment was made
    :param before: The agents that acted
    :param after: The agents that are in play now
    :param given: What the environment returned: its dicts by agent, each under its own name
    :param where: Copy and step, in words
    :raises ValueError: If an unknown agent appears, or one that is in play got nothing
    """
    found = {"agents": after, **given}
    for name, names in found.items():
        unknown = [agent for agent in names if agent not in agents]
        if unknown:
            raise ValueError(
                f"The environment's {name} have {unknown[0]!r} {where}, which is not among its possible_agents"
                f" {list(agents)}: an agent keeps its name as long as the environment lives. Name all agents that can ever"
                " appear in possible_agents, and only these elsewhere."
            )
    playing = set(after)
    for agent in before:
        for name, part in given.items():
            if agent in playing and agent not in part:
                raise ValueError(
                    f"The environment's {name} lack {agent!r} {where}, who is in play: return an entry for each agent that"
                    " acted, and take who has left out of agents."
                )


def check_observation(agent: str, value: Any, space: spaces.Space, where: str) -> None:
    """
    Check one observation.

    :param agent: Name of the agent
    :param value: Its observation
    :param space: Its observation space
    :param where: Copy and step, in words
    :raises ValueError: If shape or numbers are not those of an observation
    """
    if isinstance(space, spaces.Dict):
        if not (isinstance(value, Mapping) and value.keys() >= space.spaces.keys()):
            given = f"the entries {list(value)}" if isinstance(value, Mapping) else f"the type {type(value).__name__}"
            raise ValueError(
                f"The observation of {agent!r} {where} has {given}, but its observation space is a Dict with the entries"
                f" {list(space.spaces)}: return a dict of these, or correct observation_space({agent!r})."
            )
        for key, part in space.spaces.items():
            _check_part(agent, f"entry {key!r} of the observation of {agent!r}", value[key], part, where)
    else:
        _check_part(agent, f"observation of {agent!r}", value, space, where)


def _check_part(agent: str, what: str, value: Any, space: spaces.Space, where: str) -> None:
    """Check an observation, or an entry of one."""
    try:
        array = np.asarray(value)
    except ValueError:
        # Lists of different lengths
        array = np.asarray(value, dtype=object)
    if array.shape != (space.shape or ()) or array.dtype.kind not in "biuf":
        raise ValueError(
            f"The {what} {where} has the shape {array.shape} and type {array.dtype}, but its observation"
            f" space is {space}: return an array of that shape, or correct observation_space({agent!r})."
        )
    if array.dtype.kind == "f":
        # What is finite in the environment's type may be too large for that of the space
        with np.errstate(over="ignore"):
            array = array.astype(space.dtype if np.issubdtype(space.dtype, np.floating) else array.dtype, copy=False)
        if not np.isfinite(array).all():
            raise not_finite(what, array, where)
    choices = n_choices(space)
    if choices is not None and not ((array >= 0) & (array < choices)).all():
        raise not_a_choice(what, array, agent, space, where)
    if np.issubdtype(space.dtype, np.integer) and array.dtype != space.dtype:
        with np.errstate(invalid="ignore"):
            changed = array.astype(space.dtype) != array
        if changed.any():
            raise ValueError(
                f"The {what} {where} holds {array[changed].flat[0]}, but its observation space is {space}, in whose type it is"
                f" another number: return what lies in it, e.g. a picture of shares as (255 * picture).astype(np.uint8), or"
                f" correct observation_space({agent!r})."
            )


def n_choices(space: spaces.Space) -> Any:
    """
    Return the number of values that an observation of a discrete space can have, each from 0.

    :param space: An observation space
    :return: A number, or an array of one for each dimension; None for a ``Box``
    """
    if isinstance(space, spaces.Discrete):
        return int(space.n)
    if isinstance(space, spaces.MultiDiscrete):
        return space.nvec
    return 2 if isinstance(space, spaces.MultiBinary) else None


def not_a_choice(what: str, value: np.ndarray, agent: str, space: spaces.Space, where: str) -> ValueError:
    """
    Return the error for an observation that is none of a discrete space.

    :param what: What it is, and of which agent
    :param value: The observation, or an entry of it
    :param agent: Name of the agent
    :param space: Its space
    :param where: Copy and step, in words
    """
    return ValueError(
        f"The {what} {where} is {value.tolist()}, which is not in its observation space {space}: return what"
        f" lies in it, or correct observation_space({agent!r})."
    )


def no_last_observation(agent: str, where: str) -> ValueError:
    """
    Return the error for an agent that is truncated without a last observation.

    :param agent: Name of the agent
    :param where: Copy and step, in words
    """
    return ValueError(
        f"The environment truncates {agent!r} {where} without returning a last observation of it. The return of a truncated"
        " agent goes on, as far as learning is concerned, with the value of that observation: return one for each agent that"
        " acted, as PettingZoo asks for (make the dicts of a step before agents is shortened), or report a termination where"
        " nothing would follow."
    )


def forgotten_agents(env: str, were: Sequence[str], are: Sequence[Any], where: str) -> ValueError:
    """
    Return the error for an environment that no longer knows all its agents: one that it forgets never returns.

    :param env: Its class
    :param were: Its agents as they were when it was made
    :param are: Its agents now
    :param where: Copy and step, in words
    """
    return ValueError(
        f"possible_agents of {env} were {list(were)} and are {list(are)} {where}: they must remain the same. If agents and"
        " possible_agents are one list, what is removed from the one is gone from the other: begin episodes with self.agents ="
        " list(self.possible_agents)."
    )


def not_finite(what: str, values: np.ndarray, where: str) -> ValueError:
    """
    Return the error for a number that is not finite.

    :param what: What the numbers are, and of which agent
    :param values: The numbers
    :param where: Copy and step, in words
    """
    index = tuple(int(i) for i in np.argwhere(~np.isfinite(values))[0])
    at = f" (index {', '.join(map(str, index))})" if index else ""
    return ValueError(
        f"The {what} {where} holds {values[index]}{at}: a network that learns from it is lost. Look for a division by zero, a"
        " root or a logarithm there, or clip what can grow without bound."
    )
