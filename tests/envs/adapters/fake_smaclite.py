"""A fake of SMAClite's ``SMACliteEnv``: what the adapter uses, with the package's faults, without its simulation."""

from types import SimpleNamespace

import gymnasium as gym
import numpy as np
from gymnasium import spaces

SIGHT, TARGET_RANGE = 9, 6
# Members beyond Gymnasium's interface that the adapter reads. A test compares their types with those of the package
USED = ("n_agents", "n_enemies", "agents", "enemies", "enemy_feat_size", "ally_feat_size", "get_avail_actions")


class FakeSMAClite(gym.Env):
    """
    Battle of units on a line, with the peculiarities of the package.

    The first unit is a healer, which has fewer actions than the rows of ``get_avail_actions()`` have entries. Like the
    package, the fake

    - takes plain Python integers only, takes nothing but 0 from dead units, and refuses actions that are not available,
    - has no time limit, and reports every end as a termination,
    - gives the same reward to all units, and zeros as the observation of a dead one,
    - opens a window by default.

    :param n_agents: Number of units in the team
    :param n_enemies: Number of enemies
    :param deadly: Probability that a unit dies in a step, per enemy that is alive
    :param render_mode: The package's argument
    :param use_cpp_rvo2: The package's argument
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 60}  # noqa: RUF012

    def __init__(self, n_agents=4, n_enemies=5, deadly=0.05, render_mode="human", use_cpp_rvo2=False):
        self.render_mode, self.use_cpp_rvo2, self.deadly = render_mode, use_cpp_rvo2, deadly
        self.n_agents, self.n_enemies = n_agents, n_enemies
        self.n_actions = 6 + n_enemies
        self.enemy_feat_size, self.ally_feat_size = 5, 6
        self.obs_size = 4 + n_enemies * self.enemy_feat_size + (n_agents - 1) * self.ally_feat_size + 1
        sizes = [6 + n_agents - 1] + [self.n_actions] * (n_agents - 1)
        self.action_space = spaces.Tuple(spaces.Discrete(size) for size in sizes)
        self.observation_space = spaces.Tuple(spaces.Box(-1, 1, (self.obs_size,), np.float32) for _ in range(n_agents))
        self.seed(np.random.randint(2**31 - 1))

    def seed(self, seed=None):
        if seed is not None:
            self.generator = np.random.default_rng(seed)

    def reset(self, seed=None, options=None):
        self.seed(seed)
        self.agents = {i: SimpleNamespace(pos=float(p)) for i, p in enumerate(self.generator.uniform(0, 15, self.n_agents))}
        self.enemies = {i: SimpleNamespace(pos=float(p)) for i, p in enumerate(self.generator.uniform(10, 25, self.n_enemies))}
        return self._get_obs(), {"battle_won": False}

    def step(self, actions):
        assert len(actions) == self.n_agents
        assert all(type(action) == int for action in actions)  # noqa: E721
        available = self.get_avail_actions()
        reward = 0.0
        for i, action in enumerate(actions):
            if i not in self.agents:
                assert action == 0
                continue
            if not available[i][action]:
                raise ValueError(f"Invalid action for agent {i}: {action}")
            if action in (4, 5):
                self.agents[i].pos += 2 * (action == 4) - 2 * (action == 5)
            elif action >= 6 and i > 0 and self.generator.random() < 0.3:
                reward += 1.0 if self.enemies.pop(action - 6, None) else 0.0
        for i in list(self.agents):
            if self.generator.random() < self.deadly * len(self.enemies):
                del self.agents[i]
        ended = not self.enemies or not self.agents
        return self._get_obs(), reward, ended, False, {"battle_won": not self.enemies}

    def get_state(self):
        own = [self.agents[i].pos if i in self.agents else 0.0 for i in range(self.n_agents)]
        return np.array(own + [self.enemies[k].pos if k in self.enemies else 0.0 for k in range(self.n_enemies)])

    def get_avail_actions(self):
        rows = []
        for i in range(self.n_agents):
            row = np.zeros(self.n_actions)
            if i not in self.agents:
                row[0] = 1
            else:
                targets = {k: v for k, v in self.agents.items() if k > 0} if i == 0 else self.enemies
                row[1:6] = 1
                for k, target in targets.items():
                    row[6 + k] = abs(target.pos - self.agents[i].pos) <= TARGET_RANGE
            rows.append(row)
        return rows

    def _get_obs(self):
        observations = [np.zeros(self.obs_size, dtype=np.float32) for _ in range(self.n_agents)]
        for i, unit in self.agents.items():
            obs = observations[i]
            obs[:4], obs[-1] = 1, 1
            for j, other in self.agents.items():
                distance = (other.pos - unit.pos) / SIGHT
                if j != i and abs(distance) <= 1:
                    base = 4 + self.n_enemies * self.enemy_feat_size + (j - (j > i)) * self.ally_feat_size
                    obs[base : base + 3] = 1, abs(distance), distance
        return tuple(observations)
