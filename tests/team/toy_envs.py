"""Tiny ``ParallelEnv``s for tests. Each shows one thing, and what happens at a given step is known in advance."""

import os
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv


class ToyEnv(ParallelEnv):
    """
    Agents that do not influence each other.

    Each of them walks for ``limit`` steps and gets a higher reward the closer it is to the origin. It has a random generator
    of its own, so that its observations and rewards do not depend on the number of teammates.

    :param n_agents: Number of agents
    :param limit: Length of an episode, which ends by truncation
    """

    metadata: ClassVar[dict[str, Any]] = {"name": "toy", "render_modes": ["rgb_array"]}

    def __init__(self, n_agents: int = 2, limit: int = 7, render_mode: str | None = None):
        self.possible_agents = [f"agent_{i}" for i in range(n_agents)]
        self.agents: list[str] = []
        self.limit = limit
        self.render_mode = render_mode
        self.rngs = {agent: np.random.default_rng(i) for i, agent in enumerate(self.possible_agents)}
        self.positions: dict[str, np.ndarray] = {}
        self.t = 0

    def observation_space(self, agent):
        return spaces.Box(-np.inf, np.inf, (2,), np.float32)

    def action_space(self, agent):
        return spaces.Discrete(3)

    def reset(self, seed=None, options=None):
        if seed is not None:
            self.rngs = {agent: np.random.default_rng([seed, i]) for i, agent in enumerate(self.possible_agents)}
        self.agents = self.possible_agents[:]
        self.t = 0
        self.positions = {agent: self.rngs[agent].normal(size=2) for agent in self.agents}
        return self.observations(), self.infos()

    def step(self, actions):
        self.t += 1
        rewards = {}
        for agent in self.agents:
            self.positions[agent] = (
                self.positions[agent] + 0.3 * (int(actions[agent]) - 1) + 0.1 * self.rngs[agent].normal(size=2)
            )
            rewards[agent] = float(-np.abs(self.positions[agent]).sum())
        over = self.t >= self.limit
        result = self.observations(), rewards, self.flags(False), self.flags(over), self.infos()
        if over:
            self.agents = []
        return result

    def observations(self):
        return {agent: self.positions[agent].astype(np.float32) for agent in self.agents}

    def infos(self):
        return {agent: {} for agent in self.agents}

    def flags(self, value):
        return {agent: value for agent in self.agents}

    def render(self):
        return np.full((4, 4, 3), self.t, dtype=np.uint8)


class ToySolo(gym.Env):
    """
    Agent ``index`` of a ``ToyEnv``, alone in a Gymnasium environment with the same observations and rewards.

    :param index: Index of the agent
    :param limit: Length of an episode
    """

    def __init__(self, index: int = 0, limit: int = 7):
        self.team = ToyEnv(index + 1, limit)
        self.agent = f"agent_{index}"
        self.observation_space, self.action_space = self.team.observation_space(self.agent), self.team.action_space(self.agent)

    def reset(self, seed=None, options=None):
        return self.team.reset(seed)[0][self.agent], {}

    def step(self, action):
        obs, rewards, _, truncations, _ = self.team.step({agent: action for agent in self.team.agents})
        return obs[self.agent], rewards[self.agent], False, truncations[self.agent], {}


class ScriptedEnv(ParallelEnv):
    """
    Every kind of end that an agent's return can have, at known steps (counted from 1) of an episode of 8.

    - The life of ``stays`` ends at step 3. It remains in the team and is inactive at steps 4 and 5
    - ``dies`` terminates at step 5 and leaves
    - ``cut`` is truncated at step 6 and leaves
    - ``last`` plays to the end of the episode, which is a time limit

    Observations are [step, 10 * episode]. The reward is 1 + 10 * index of the agent + step / 100, also for agents that have
    left.
    """

    metadata: ClassVar[dict[str, Any]] = {"name": "scripted"}
    render_mode = None

    def __init__(self):
        self.possible_agents = ["stays", "dies", "cut", "last"]
        self.agents: list[str] = []
        self.t, self.episode = 0, 0

    def observation_space(self, agent):
        return spaces.Box(-100, 100, (2,), np.float32)

    def action_space(self, agent):
        return spaces.Discrete(2)

    def reset(self, seed=None, options=None):
        self.agents = self.possible_agents[:]
        self.t = 0
        self.episode += 1
        return self.observations(), {agent: {} for agent in self.agents}

    def step(self, actions):
        assert list(actions) == self.agents
        self.t += 1
        ends = {"dies": 5, "cut": 6, "last": 8, "stays": 8}
        rewards = {agent: 1 + 10 * i + self.t / 100 for i, agent in enumerate(self.possible_agents)}
        terminations = {agent: agent == "dies" and self.t >= 5 for agent in self.agents}
        truncations = {agent: agent != "dies" and self.t >= ends[agent] for agent in self.agents}
        infos: dict[str, dict[str, Any]] = {agent: {} for agent in self.agents}
        infos["stays"] = {"active": self.t not in (4, 5), "life_end": self.t == 3}
        if self.t == 8:
            infos["last"]["is_success"] = self.episode % 2 == 0
        observations = self.observations()
        self.agents = [agent for agent in self.agents if self.t < ends[agent]]
        return observations, rewards, terminations, truncations, infos

    def observations(self):
        return {agent: np.array([self.t, 10 * self.episode], dtype=np.float32) for agent in self.agents}


class MixedEnv(ParallelEnv):
    """
    Agents with spaces of every kind, and a visibility that changes with the step.

    Agent i sees the actions of those agents j for which i + j + step is even.

    :param limit: Length of an episode, which ends by termination
    """

    metadata: ClassVar[dict[str, Any]] = {"name": "mixed"}
    render_mode = None

    def __init__(self, limit: int = 5):
        self.possible_agents = ["zeta", "box", "multi", "binary"]
        self.agents: list[str] = []
        self.limit = limit
        self.t = 0
        self.rng = np.random.default_rng(0)
        self._actions = {
            "zeta": spaces.Discrete(3),
            "box": spaces.Box(-1, 1, (2,), np.float32),
            "multi": spaces.MultiDiscrete([2, 3]),
            "binary": spaces.MultiBinary(2),
        }
        self._observations = {
            "zeta": spaces.Box(-1, 1, (3,), np.float32),
            "box": spaces.Box(-1, 1, (1,), np.float32),
            "multi": spaces.Discrete(4),
            "binary": spaces.Box(-1, 1, (2, 2), np.float32),
        }

    def observation_space(self, agent):
        return self._observations[agent]

    def action_space(self, agent):
        return self._actions[agent]

    def reset(self, seed=None, options=None):
        if seed is not None:
            self.rng = np.random.default_rng(seed)
        self.agents, self.t = self.possible_agents[:], 0
        return self.observations(), {agent: {} for agent in self.agents}

    def step(self, actions):
        assert all(
            self._actions[agent].contains(np.asarray(actions[agent], self._actions[agent].dtype)) for agent in self.agents
        )
        self.t += 1
        over = self.t >= self.limit
        rewards = {agent: float(np.sum(actions[agent])) for agent in self.agents}
        terminations, truncations = {agent: over for agent in self.agents}, {agent: False for agent in self.agents}
        infos: dict[str, dict[str, Any]] = {}
        observations = self.observations()
        if over:
            self.agents = []
        return observations, rewards, terminations, truncations, infos

    def visibility(self):
        n = len(self.possible_agents)
        return {
            agent: np.array([(i + j + self.t) % 2 == 0 for j in range(n) if j != i])
            for i, agent in enumerate(self.possible_agents)
        }

    def observations(self):
        return {
            agent: int(self.rng.integers(4))
            if isinstance(space, spaces.Discrete)
            else self.rng.uniform(-1, 1, space.shape).astype(np.float32)
            for agent, space in self._observations.items()
        }


class MaskedEnv(ToyEnv):
    """A ``ToyEnv`` whose masks allow agent i only action (t + i) % 3 at step t. Others raise. The last agent has no mask."""

    def infos(self):
        infos: dict[str, dict[str, Any]] = {agent: {} for agent in self.agents}
        for i, agent in enumerate(self.agents[:-1]):
            infos[agent] = {"action_mask": np.arange(3) == (self.t + i) % 3}
        return infos

    def step(self, actions):
        for i, agent in enumerate(self.agents[:-1]):
            if actions[agent] != (self.t + i) % 3:
                raise ValueError(f"{agent} did {actions[agent]} at step {self.t}")
        return super().step(actions)


class FaultyEnv(ToyEnv):
    """
    A ``ToyEnv`` that fails at the third step of the second episode.

    :param fault: ``"raise"`` to raise an error, or ``"exit"`` to end the process without any message
    """

    def __init__(self, fault: str, **kwargs):
        super().__init__(**kwargs)
        self.fault = fault
        self.episodes = 0

    def reset(self, seed=None, options=None):
        self.episodes += 1
        return super().reset(seed, options)

    def step(self, actions):
        if self.episodes == 2 and self.t == 2:
            if self.fault == "exit":
                os._exit(3)
            raise ArithmeticError("the toy broke")
        return super().step(actions)


class PartneredEnv(ParallelEnv):
    """
    Two learners and two scripted others, whose actions show at which step they were taken.

    The action of ``wind`` (Box) is [step, -episode]. That of ``leader`` (Discrete) is (step - 1) % 4, which the observation
    before the step holds as a one-hot. The learner ``ball`` leaves after step 3, and the learner ``arrow`` stays until the
    time limit.

    :param limit: Length of an episode, which ends by truncation
    :param ball_leaves: Whether ``ball`` leaves after step 3
    """

    metadata: ClassVar[dict[str, Any]] = {"name": "partnered"}
    render_mode = None

    def __init__(self, limit: int = 6, ball_leaves: bool = True):
        self.possible_agents = ["arrow", "ball"]
        self.agents: list[str] = []
        self.limit, self.ball_leaves = limit, ball_leaves
        self.t = self.episode = 0
        # The order of the others is that of this dict, which is not alphabetical
        self.scripted_action_spaces = {"wind": spaces.Box(-100, 100, (2,), np.float32), "leader": spaces.Discrete(4)}

    def observation_space(self, agent):
        return spaces.Box(0, 1, (4,), np.float32)

    def action_space(self, agent):
        return spaces.Discrete(3) if agent == "arrow" else spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, seed=None, options=None):
        self.agents, self.t = self.possible_agents[:], 0
        self.episode += 1
        return self.observations(), {agent: {} for agent in self.agents}

    def step(self, actions):
        self.t += 1
        over = {agent: self.t >= (3 if agent == "ball" and self.ball_leaves else self.limit) for agent in self.agents}
        infos: dict[str, dict] = {agent: {} for agent in self.agents}
        result = self.observations(), dict.fromkeys(self.agents, 1.0), dict.fromkeys(self.agents, False), over, infos
        self.agents = [agent for agent in self.agents if not over[agent]]
        return result

    def scripted_actions(self):
        return {"leader": (self.t - 1) % 4, "wind": np.array([self.t, -self.episode], np.float32)}

    def observations(self):
        return {agent: np.eye(4, dtype=np.float32)[self.t % 4] for agent in self.agents}


class BlinkingEnv(PartneredEnv):
    """
    A ``PartneredEnv`` whose visibility changes with the step.

    At step t ``arrow`` sees those of [ball, wind, leader] whose bits are set in t. ``ball`` sees those of [arrow, wind,
    leader] whose bits are not set.
    """

    def visibility(self):
        bits = np.array([self.t & 1, self.t & 2, self.t & 4], dtype=bool)
        return {"arrow": bits, "ball": ~bits}
