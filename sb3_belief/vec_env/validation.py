"""What environments and actors can get wrong while they run: found where it happens, and said with agent, copy and step."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces


def place(copy: int, step: int) -> str:
    """
    :param copy: number of the environment copy, from 0
    :param step: number of the step in the episode, from 1; 0: its reset
    :return: these in words
    """
    return f"in environment copy {copy} at " + (f"step {step}" if step else "reset")


def check_wrappers(env: Any) -> None:
    """
    :param env: a ``ParallelEnv``, with or without wrappers
    :raises ValueError: for a wrapper that hides what a team has to know
    """
    while env is not None:
        if type(env).__name__ == "black_death_par":
            raise ValueError(
                "supersuit.black_death_v3 is not needed here, and hides which agents are still in play, and whether they"
                " terminated or were cut by a limit. A team does its work: who leaves early stays a member with a zero"
                " observation, and is known to be inactive. Leave it out."
            )
        # "aec_env": below a conversion from AEC
        env = vars(env).get("env") or vars(env).get("aec_env")


def check_names(
    agents: Sequence[str], before: Iterable[str], after: Iterable[str], given: Mapping[str, Mapping[str, Any]], where: str
) -> None:
    """
    :param agents: ``possible_agents`` as they were when the environment was made
    :param before: who acted
    :param after: who is in play now
    :param given: {what the environment returned: its dictionary by agent}
    :param where: copy and step in words
    :raises ValueError: if an unknown agent appears, or one in play was given nothing
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
    :param agent: its name
    :param value: its observation
    :param space: what it should lie in
    :param where: copy and step in words
    :raises ValueError: if shape or numbers are not those of an observation
    """
    array = np.asarray(value)
    if array.shape != space.shape or array.dtype.kind not in "biuf":
        raise ValueError(
            f"The observation of {agent!r} {where} has the shape {array.shape} and type {array.dtype}, but its observation"
            f" space is {space}: return an array of that shape, or correct observation_space({agent!r})."
        )
    if array.dtype.kind == "f" and not _finite(array):
        raise not_finite(f"observation of {agent!r}", array, where)


def not_finite(what: str, values: np.ndarray, where: str) -> ValueError:
    """
    :param what: whose and which numbers
    :param values: with one that is not finite
    :param where: copy and step in words
    :return: the error to raise
    """
    index = tuple(int(i) for i in np.argwhere(~np.isfinite(values))[0])
    at = f" (index {', '.join(map(str, index))})" if index else ""
    return ValueError(
        f"The {what} {where} holds {values[index]}{at}: a network that learns from it is lost. Look for a division by zero, a"
        " root or a logarithm there, or clip what can grow without bound."
    )


class StepChecks:
    """
    Checks of joint steps of all copies at once. They look for a sign that anything is wrong, which costs next to nothing, and
    only then for what it is.

    :param agents: names of the agents
    :param observation_spaces: by agent
    :param action_spaces: by agent
    :param mask_widths: of each agent, in order; 0: it cannot be masked
    """

    def __init__(
        self,
        agents: Sequence[str],
        observation_spaces: Mapping[str, spaces.Space],
        action_spaces: Mapping[str, spaces.Space],
        mask_widths: Sequence[int],
    ):
        self._agents, self._action_spaces = list(agents), action_spaces
        self._floats = [agent for agent in agents if np.issubdtype(observation_spaces[agent].dtype, np.floating)]
        self._bounds = {agent: _bounds(action_spaces[agent]) for agent in agents}
        self._masked = [agent for agent, width in zip(agents, mask_widths, strict=True) if width]
        self._mask_starts = [sum(mask_widths[:i]) for i, width in enumerate(mask_widths) if width]

    def number(self, agent: str, chosen: np.ndarray, steps: np.ndarray) -> list[int]:
        """
        :param agent: one with a ``Discrete`` action space
        :param chosen: its actions [num_envs]
        :param steps: how many steps each copy's episode has had, int [num_envs]
        :return: the actions as plain integers
        :raises ValueError: if one is not in its space
        """
        numbers = chosen.tolist()
        if chosen.dtype.kind not in "iub" or min(numbers) < 0 or max(numbers) > self._bounds[agent][1]:
            self._refuse_action(agent, chosen, steps)
        return numbers

    def vector(self, agent: str, chosen: np.ndarray, steps: np.ndarray) -> np.ndarray:
        """
        :param agent: one with another action space
        :param chosen: its actions [num_envs, ...]
        :param steps: how many steps each copy's episode has had, int [num_envs]
        :return: the actions
        :raises ValueError: if one is not in its space
        """
        low, high = self._bounds[agent]
        if not ((chosen >= low) & (chosen <= high)).all():
            self._refuse_action(agent, chosen, steps)
        return chosen

    def _refuse_action(self, agent: str, chosen: np.ndarray, steps: np.ndarray) -> None:
        low, high = self._bounds[agent]
        fits = ((chosen >= low) & (chosen <= high)).reshape(len(chosen), -1).all(axis=1)
        # Where all do, it is their type
        copy = int(np.argmin(fits))
        raise ValueError(
            f"The action of {agent!r} {place(copy, int(steps[copy]) + 1)} is {chosen[copy].tolist()!r} (type {chosen.dtype}),"
            f" which is not in its action space {self._action_spaces[agent]}. An SB3 model's own actions are; clip or convert"
            " others."
        )

    def numbers(self, obs: Mapping[str, np.ndarray], rewards: np.ndarray, steps: np.ndarray) -> None:
        """
        :param obs: {agent: array [num_envs, ...]}
        :param rewards: of the agents, float32 [num_envs, n]
        :param steps: how many steps each copy's episode has had, int [num_envs]
        :raises ValueError: if one is not finite
        """
        for agent in self._floats:
            if not _finite(obs[agent]):
                copy = int(np.argmin(np.isfinite(obs[agent]).reshape(len(steps), -1).all(axis=1)))
                raise not_finite(f"observation of {agent!r}", obs[agent][copy], place(copy, int(steps[copy]) + 1))
        if not _finite(rewards):
            copy, i = (int(k) for k in np.argwhere(~np.isfinite(rewards))[0])
            raise not_finite(f"reward of {self._agents[i]!r}", rewards[copy, i], place(copy, int(steps[copy]) + 1))

    def masks(self, masks: np.ndarray, steps: np.ndarray) -> None:
        """
        :param masks: of all agents one after the other, bool [num_envs, sum of mask_widths]
        :param steps: how many steps each copy's episode has had, int [num_envs]
        :raises ValueError: if one allows nothing
        """
        if not self._masked:
            return
        possible = np.logical_or.reduceat(masks, self._mask_starts, axis=1)
        if not possible.all():
            copy, i = (int(k) for k in np.argwhere(~possible)[0])
            raise ValueError(
                f"The action mask of {self._masked[i]!r} {place(copy, int(steps[copy]))} allows no action: a model must always"
                " choose one, so allow one that does nothing, also for an agent that is out of play."
            )


def _finite(values: np.ndarray) -> bool:
    # The fastest way to look at all numbers: zero times any number is zero, but not times nan or an infinity
    flat = values.reshape(-1)
    return flat.dot(np.zeros(flat.size, dtype=flat.dtype)) == 0.0


def _bounds(space: spaces.Space) -> tuple[Any, Any]:
    """
    :param space: an action space
    :return: what its actions lie between; for boxes a little more, since rescaling rounds
    """
    if isinstance(space, spaces.Discrete):
        return 0, int(space.n) - 1
    if isinstance(space, spaces.MultiDiscrete):
        return np.zeros_like(space.nvec), space.nvec - 1
    if isinstance(space, spaces.Box):
        low, high = space.low.astype(np.float64), space.high.astype(np.float64)
        slack = np.where(np.isfinite(low) & np.isfinite(high), 1e-4 * (high - low), 0.0)
        return low - slack, high + slack
    return 0, 1
