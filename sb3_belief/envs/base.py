"""What the PettingZoo environments and adapters of this package have in common."""

from collections.abc import Sequence
from typing import Generic, TypeVar

from gymnasium import spaces
from pettingzoo import ParallelEnv

Obs = TypeVar("Obs")
Act = TypeVar("Act")


class TeamGame(ParallelEnv[str, Obs, Act], Generic[Obs, Act]):
    """
    A ``ParallelEnv`` whose spaces lie in ``observation_spaces`` and ``action_spaces``, by agent; a subclass fills them.
    """

    observation_spaces: dict[str, spaces.Space]
    action_spaces: dict[str, spaces.Space]
    render_mode: str | None

    def observation_space(self, agent: str) -> spaces.Space:
        """
        :param agent: its name
        :return: its observation space, always the same object
        """
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space:
        """
        :param agent: its name
        :return: its action space, always the same object
        """
        return self.action_spaces[agent]

    def _require_episode(self) -> None:
        """
        :raises ValueError: before the first ``reset`` and after an episode's end
        """
        if not self.agents:
            raise ValueError("No episode is under way: call reset() before the first step and after an episode's end.")


class UnitsGame(TeamGame[Obs, int], Generic[Obs]):
    """Battles: a common reward, and the dead stay listed, so that every agent acts at each step in ``Discrete`` actions."""

    def team_reward(self, rewards: dict[str, float]) -> float:
        """
        :param rewards: what ``step`` returned
        :return: the reward that all of them have in common
        """
        return rewards[self.possible_agents[0]]

    def _chosen(self, agent: str, actions: dict[str, int]) -> int:
        """
        :param agent: its name
        :param actions: of all agents
        :return: its action
        :raises ValueError: if it is missing or not in its space
        """
        if agent not in actions:
            raise ValueError(f"No action for {agent!r}: every agent needs one at each step, also a dead one.")
        action, space = actions[agent], self.action_spaces[agent]
        if not space.contains(action):
            n_actions = space.n  # type: ignore[attr-defined]
            raise ValueError(f"The action of {agent!r} is {action!r}; allowed are the integers from 0 to {n_actions - 1}.")
        return int(action)


def check_render_mode(render_mode: str | None, modes: Sequence[str]) -> str | None:
    """
    :param render_mode: what the user gave
    :param modes: what there is
    :return: the same
    :raises ValueError: if there is no such mode
    """
    if render_mode is not None and render_mode not in modes:
        raise ValueError(f"render_mode={render_mode!r} is not one of None, {', '.join(map(repr, modes))}.")
    return render_mode


def require_render_mode(render_mode: str | None, modes: Sequence[str]) -> str:
    """
    :param render_mode: with which an environment was made
    :param modes: what there is
    :return: the same
    :raises ValueError: if it was made without one
    """
    if render_mode is None:
        raise ValueError(f"This environment was made without a render mode: pass render_mode, one of {tuple(modes)}.")
    return render_mode
