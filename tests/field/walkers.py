"""The environment that the tests of what environments return change in one way each."""

from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

Parts = tuple[dict, dict, dict, dict, dict]


class Walkers(ParallelEnv):
    """
    Agents whose observation is [step, index, 0]; each gets a reward of 1 + index at each step, and a time limit ends all.

    :param n_agents: Number of agents
    :param limit: Length of an episode
    """

    metadata: ClassVar[dict[str, Any]] = {"name": "walkers", "render_modes": []}
    render_mode = None
    obs_space: spaces.Space = spaces.Box(-1e6, 1e6, (3,), np.float32)
    act_space: spaces.Space = spaces.Discrete(3)

    def __init__(self, n_agents: int = 2, limit: int = 4):
        self.possible_agents: list[Any] = [f"walker_{i}" for i in range(n_agents)]
        self.agents: Any = []
        self.limit, self.t = limit, 0
        # The last actions, as they arrived
        self.actions: dict[Any, Any] = {}

    def observation_space(self, agent):
        return self.obs_space

    def action_space(self, agent):
        return self.act_space

    def observe(self, agent) -> Any:
        return np.array([self.t, self.possible_agents.index(agent), 0], np.float32)

    def reset(self, seed=None, options=None) -> Any:
        self.t = 0
        self.agents = list(self.possible_agents)
        return {agent: self.observe(agent) for agent in self.agents}, {agent: {} for agent in self.agents}

    def step(self, actions) -> Any:
        self.t += 1
        self.actions = dict(actions)
        acted = list(self.agents)
        over = self.t >= self.limit
        if over:
            self.agents = []
        return self.change(
            {agent: self.observe(agent) for agent in acted},
            {agent: 1.0 + self.possible_agents.index(agent) for agent in acted},
            {agent: False for agent in acted},
            {agent: over for agent in acted},
            {agent: {} for agent in acted},
        )

    def change(self, obs: dict, rewards: dict, terminations: dict, truncations: dict, infos: dict) -> Any:
        """What a test changes of a step."""
        return obs, rewards, terminations, truncations, infos


def play(env, n_steps: int) -> list:
    """Reset, and step with the first action of each agent; return what each step returned."""
    env.reset()
    zeros = {agent: np.zeros((env.num_envs, *space.shape), space.dtype) for agent, space in env.action_space.spaces.items()}
    return [env.step(zeros) for _ in range(n_steps)]
