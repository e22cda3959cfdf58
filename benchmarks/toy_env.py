"""An environment that costs almost nothing, so that what is measured is the learning in it."""

from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_belief import TeamVecEnv
from sb3_belief.vec_env import TeamObs, TeamStep

#: As wide as an observation in simple_spread with three agents, and as many actions
WIDTH, N_ACTIONS, EPISODE = 18, 5, 25


class ToyTeamEnv(TeamVecEnv):
    """
    Vectorised environment of random observations and zero rewards, whose agents all see each other.

    All episodes end at the same time, by a time limit.

    :param num_envs: Number of copies
    :param n_agents: Number of agents that learn
    :param n_scripted: Number of others that do not learn
    :param action_space: Of the learning agents, by default a few discrete actions
    """

    def __init__(self, num_envs: int, n_agents: int, n_scripted: int = 0, action_space: spaces.Space | None = None) -> None:
        action_space = spaces.Discrete(N_ACTIONS) if action_space is None else action_space
        agents = [f"agent_{i}" for i in range(n_agents)]
        super().__init__(
            num_envs,
            agents,
            {agent: spaces.Box(-np.inf, np.inf, (WIDTH,), np.float32) for agent in agents},
            {agent: action_space for agent in agents},
            scripted_action_spaces={f"scripted_{i}": spaces.Discrete(N_ACTIONS) for i in range(n_scripted)},
        )
        self._rng = np.random.default_rng(0)
        self._time = 0
        always, never = np.ones(n_agents, dtype=bool), np.zeros(n_agents, dtype=bool)
        visible = np.ones((n_agents, n_agents - 1 + n_scripted), dtype=bool)
        rewards = np.zeros(n_agents, dtype=np.float32)
        self._info = dict(agent_rewards=rewards, visible=visible, active=always, life_end=never, truncated=never)
        if n_scripted:
            self._info["scripted_actions"] = np.tile(np.eye(N_ACTIONS, dtype=np.float32)[0], n_scripted)
        self._last_info = {**self._info, "truncated": always, "TimeLimit.truncated": True}

    def _reset_joint(self) -> TeamObs:
        self._time = 0
        return self._observe()

    def _step_joint(self, actions: TeamObs) -> TeamStep:
        self._time += 1
        obs, over = self._observe(), self._time == EPISODE
        infos: list[dict[str, Any]] = [dict(self._last_info if over else self._info) for _ in range(self.num_envs)]
        if over:
            for i, info in enumerate(infos):
                info["terminal_observation"] = {agent: values[i] for agent, values in obs.items()}
            obs = self._reset_joint()
        return obs, np.zeros(self.num_envs, dtype=np.float32), np.full(self.num_envs, over), infos

    def _observe(self) -> TeamObs:
        drawn = self._rng.standard_normal((len(self.possible_agents), self.num_envs, WIDTH), dtype=np.float32)
        return dict(zip(self.possible_agents, drawn, strict=True))
