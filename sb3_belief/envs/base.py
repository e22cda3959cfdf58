"""Base classes and checks that the PettingZoo environments and adapters of this package share."""

from collections.abc import Sequence
from typing import Any, Generic, TypeAlias, TypeVar

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

Obs = TypeVar("Obs")
Act = TypeVar("Act")
Infos: TypeAlias = dict[str, dict[str, Any]]
# Observations and infos by agent, as PettingZoo's reset() returns them
ResetResult: TypeAlias = tuple[dict[str, np.ndarray], Infos]
# Observations, rewards, terminations, truncations and infos by agent, as PettingZoo's step() returns them
StepResult: TypeAlias = tuple[dict[str, np.ndarray], dict[str, float], dict[str, bool], dict[str, bool], Infos]


class TeamGame(ParallelEnv[str, Obs, Act], Generic[Obs, Act]):
    """
    Base class of a ``ParallelEnv`` that keeps its spaces in two dictionaries by agent.

    A subclass fills ``observation_spaces``, ``action_spaces`` and ``render_mode`` in its constructor.
    """

    observation_spaces: dict[str, spaces.Space]
    action_spaces: dict[str, spaces.Space]
    render_mode: str | None

    def observation_space(self, agent: str) -> spaces.Space:
        """
        Return the observation space of an agent.

        :param agent: Name of the agent
        :return: The same object at every call, as PettingZoo requires
        """
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space:
        """
        Return the action space of an agent.

        :param agent: Name of the agent
        :return: The same object at every call, as PettingZoo requires
        """
        return self.action_spaces[agent]

    def _require_episode(self) -> None:
        """
        Check that an episode is under way.

        :raises ValueError: Before the first ``reset`` and after the end of an episode
        """
        if not self.agents:
            raise ValueError("No episode is under way: call reset() before the first step and after an episode's end.")


class BattleGame(TeamGame[Obs, int], Generic[Obs]):
    """
    Base class of the StarCraft-like battles (SMAC, SMACv2, SMAX).

    All agents share one reward and have ``Discrete`` actions. Dead agents stay in ``agents`` until the battle ends, so every
    agent needs an action at each step.
    """

    def team_reward(self, rewards: dict[str, float]) -> float:
        """
        Return the reward that all agents share.

        :param rewards: Rewards by agent, as ``step`` returned them
        :return: The reward of any one of them
        """
        return rewards[self.possible_agents[0]]

    def _checked_action(self, agent: str, actions: dict[str, int]) -> int:
        """
        Return the action of an agent as a plain integer.

        :param agent: Name of the agent
        :param actions: Actions of all agents
        :return: The agent's action
        :raises ValueError: If the action is missing or outside the agent's action space
        """
        if agent not in actions:
            raise ValueError(f"No action for {agent!r}: every agent needs one at each step, including a dead one.")
        action, space = actions[agent], self.action_spaces[agent]
        if not space.contains(action):
            n_actions = space.n  # type: ignore[attr-defined]
            raise ValueError(f"The action of {agent!r} is {action!r}; allowed are the integers from 0 to {n_actions - 1}.")
        return int(action)


def check_render_mode(render_mode: str | None, modes: Sequence[str]) -> str | None:
    """
    Check that a render mode exists.

    :param render_mode: The mode that the user asked for, or None
    :param modes: The modes of the environment
    :return: ``render_mode``, unchanged
    :raises ValueError: If the environment has no such mode
    """
    if render_mode is not None and render_mode not in modes:
        raise ValueError(f"render_mode={render_mode!r} is not one of None, {', '.join(map(repr, modes))}.")
    return render_mode


def require_render_mode(render_mode: str | None, modes: Sequence[str]) -> str:
    """
    Check that an environment was made with a render mode.

    :param render_mode: The mode that the environment was made with
    :param modes: The modes of the environment, for the message
    :return: ``render_mode``, unchanged
    :raises ValueError: If it is None
    """
    if render_mode is None:
        raise ValueError(f"This environment was made without a render mode: pass render_mode, one of {tuple(modes)}.")
    return render_mode


def check_same_arguments(saved: object, own: object) -> None:
    """
    Check that a state comes from an environment of the same arguments.

    :param saved: Those of the state
    :param own: Those of the environment that is to go on from it
    :raises ValueError: If they differ
    """
    if saved != own:
        raise ValueError(
            f"The state is of an environment with {saved}, this one has {own}: a state can only be restored in an environment"
            " with the same arguments."
        )
