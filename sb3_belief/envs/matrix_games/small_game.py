"""Base class of the matrix games."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from sb3_belief.envs.base import ResetResult, StepResult, TeamGame


class SmallGame(TeamGame[np.ndarray, int]):
    """
    Game of agents that all act at once, each with the same number of actions and the same kind of observation.

    An episode has a fixed number of steps and then terminates, for all agents. Every agent observes the actions of all others.

    :param n_agents: Number of agents, named ``agent_0``, ``agent_1``, ...
    :param n_actions: Number of actions of each agent
    :param observations: Space of an agent's observation
    :param width: Number of entries of the global state
    :param n_steps: Number of steps of an episode, at least 1
    :param reward_scale: What rewards are multiplied by, for learners whose loss is not squared where errors exceed 1
    :raises ValueError: If there is no agent or no step
    """

    metadata: ClassVar[dict[str, Any]] = {"name": "matrix_games", "render_modes": [], "is_parallelizable": True}

    def __init__(
        self,
        n_agents: int,
        n_actions: int,
        observations: spaces.Box,
        width: int,
        n_steps: int = 1,
        reward_scale: float = 1.0,
    ):
        for name, given in (("n_agents", n_agents), ("n_steps", n_steps)):
            if given < 1:
                raise ValueError(f"{name}={given} must be at least 1.")
        self.possible_agents = [f"agent_{i}" for i in range(n_agents)]
        self.agents: list[str] = []
        self.render_mode = None
        self.n_actions, self.n_steps, self.reward_scale, self.t = n_actions, n_steps, reward_scale, 0
        self.observation_spaces = {
            agent: spaces.Box(observations.low, observations.high, dtype=np.float32) for agent in self.possible_agents
        }
        self.action_spaces = {agent: spaces.Discrete(n_actions) for agent in self.possible_agents}
        #: The space of :meth:`state`
        self.state_space = spaces.Box(-np.inf, np.inf, (width,), np.float32)
        self.rng = np.random.default_rng()

    @abstractmethod
    def _observations(self) -> list[np.ndarray]:
        """Return what each agent observes now, float32."""

    @abstractmethod
    def _rewards(self, actions: list[int]) -> list[float]:
        """Play a step, and return the reward of each agent."""

    @abstractmethod
    def state(self) -> np.ndarray:
        """
        Return the global state, for joint learners alone.

        :return: float32 ``[d_s]``
        """

    def _begin(self) -> None:
        """Begin an episode, in a game that draws something for it."""

    def reset(self, seed: int | None = None, options: Mapping[str, Any] | None = None) -> ResetResult:
        """
        Begin an episode.

        :param seed: Seed of what the game draws. With None its random generator continues
        :param options: Not used
        :return: Observations and infos, by agent
        """
        if seed is not None:
            self.rng = np.random.default_rng(seed)
        self.agents, self.t = self.possible_agents[:], 0
        self._begin()
        return self._by_agent(self._observations()), {agent: {} for agent in self.agents}

    def step(self, actions: Mapping[str, int]) -> StepResult:
        """
        Let all agents act.

        :param actions: Actions by agent
        :return: Observations, rewards, terminations, truncations and infos, by agent
        :raises ValueError: If no episode is under way, or an action is missing or outside its space
        """
        self._require_episode()
        chosen = []
        for agent in self.possible_agents:
            action = actions.get(agent)
            if action is None or not 0 <= action < self.n_actions:
                raise ValueError(
                    f"The action of {agent!r} is {action!r}; every agent needs one, from 0 to {self.n_actions - 1}."
                )
            chosen.append(int(action))
        rewards = [self.reward_scale * reward for reward in self._rewards(chosen)]
        self.t += 1
        over = self.t >= self.n_steps
        if over:
            self.agents = []
        return (
            self._by_agent(self._observations()),
            self._by_agent(rewards),
            dict.fromkeys(self.possible_agents, over),
            dict.fromkeys(self.possible_agents, False),
            {agent: {} for agent in self.possible_agents},
        )

    def _by_agent(self, values: Any) -> dict[str, Any]:
        return dict(zip(self.possible_agents, values, strict=True))
