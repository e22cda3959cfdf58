"""Environments that cost almost nothing, so that what is measured is the learning in them."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_belief.team import TeamVecEnv
from sb3_belief.vec_env.team_vec_env import TeamObs, TeamStep

#: As wide as an observation of simple_spread's three agents, and as many actions
WIDTH, N_ACTIONS, EPISODE = 18, 5, 25


class ToyTeamEnv(TeamVecEnv):
    """
    All copies at once: random observations of a fixed width, rewards of zero, episodes of equal length, all see each other.

    :param num_envs: number of copies
    :param n_agents: number of agents that learn
    :param n_scripted: number of others that do not
    """

    def __init__(self, num_envs: int, n_agents: int, n_scripted: int = 0) -> None:
        agents = [f"agent_{i}" for i in range(n_agents)]
        super().__init__(
            num_envs,
            agents,
            {agent: spaces.Box(-np.inf, np.inf, (WIDTH,), np.float32) for agent in agents},
            {agent: spaces.Discrete(N_ACTIONS) for agent in agents},
            scripted_action_spaces={f"scripted_{i}": spaces.Discrete(N_ACTIONS) for i in range(n_scripted)},
        )
        self._generator = np.random.default_rng(0)
        self._time = 0
        self._scripted = np.tile(np.eye(N_ACTIONS, dtype=np.float32)[0], n_scripted)
        self._visible = np.ones((n_agents, n_agents - 1 + n_scripted), dtype=bool)
        self._rewards = np.zeros(n_agents, dtype=np.float32)
        self._always, self._never = np.ones(n_agents, dtype=bool), np.zeros(n_agents, dtype=bool)

    def _reset_joint(self) -> TeamObs:
        self._time = 0
        return self._observe()

    def _step_joint(self, actions: TeamObs) -> TeamStep:
        self._time += 1
        obs, over = self._observe(), self._time == EPISODE
        infos: list[dict[str, Any]] = []
        for i in range(self.num_envs):
            info: dict[str, Any] = dict(agent_rewards=self._rewards, visible=self._visible, active=self._always)
            info.update(life_end=self._never, truncated=self._always if over else self._never)
            if len(self._scripted):
                info["scripted_actions"] = self._scripted
            if over:
                info["TimeLimit.truncated"] = True
                info["terminal_observation"] = {agent: values[i] for agent, values in obs.items()}
            infos.append(info)
        if over:
            obs = self._reset_joint()
        return obs, np.zeros(self.num_envs, dtype=np.float32), np.full(self.num_envs, over), infos

    def _observe(self) -> TeamObs:
        drawn = self._generator.standard_normal((len(self.possible_agents), self.num_envs, WIDTH), dtype=np.float32)
        return dict(zip(self.possible_agents, drawn, strict=True))


class ToyAgentEnv(gym.Env):
    """
    The same for a single agent: a plain Gymnasium environment that tells its learner of others.

    :param n_others: whose actions the agent sees
    """

    def __init__(self, n_others: int) -> None:
        self.observation_space = spaces.Box(-np.inf, np.inf, (WIDTH,), np.float32)
        self.action_space = spaces.Discrete(N_ACTIONS)
        self.others_action_spaces = {f"other_{i}": spaces.Discrete(N_ACTIONS) for i in range(n_others)}
        self._info = {
            "others_actions": np.tile(np.eye(N_ACTIONS, dtype=np.float32)[0], n_others),
            "others_visible": np.ones(n_others, dtype=bool),
        }
        self._generator = np.random.default_rng(0)
        self._time = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        self._time = 0
        return self._observe(), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self._time += 1
        return self._observe(), 0.0, False, self._time == EPISODE, dict(self._info)

    def _observe(self) -> np.ndarray:
        return self._generator.standard_normal(WIDTH, dtype=np.float32)
