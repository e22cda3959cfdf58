"""
A team of stock PPO agents learns in an environment of your own, which is a PettingZoo ``ParallelEnv``.

    python examples/own_environment.py
"""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from pettingzoo import ParallelEnv
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_belief import Team, envs, make_team_env


class Meeting(ParallelEnv):
    """Two agents move on a line of five cells for ten steps and earn 1 at each step after which they share a cell."""

    def __init__(self) -> None:
        self.possible_agents, self.rng = ["left", "right"], np.random.default_rng()
        # The same object at each call, as PettingZoo asks for
        self._sees: dict[str, spaces.Space] = {agent: spaces.MultiDiscrete([5, 5]) for agent in self.possible_agents}
        self._moves: dict[str, spaces.Space] = {agent: spaces.Discrete(3) for agent in self.possible_agents}

    def observation_space(self, agent: str) -> spaces.Space:
        return self._sees[agent]  # the cells of both agents

    def action_space(self, agent: str) -> spaces.Space:
        return self._moves[agent]  # one cell to the left, stay, one cell to the right

    def reset(self, seed: int | None = None, options: dict | None = None) -> Any:
        if seed is not None:  # without a seed the generator continues
            self.rng = np.random.default_rng(seed)
        self.agents, self.time, self.cells = list(self.possible_agents), 0, self.rng.integers(5, size=2)
        return dict.fromkeys(self.agents, self.cells), {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, int]) -> Any:
        acted, self.time = self.agents, self.time + 1
        self.cells = np.clip(self.cells + [actions[agent] - 1 for agent in acted], 0, 4)
        rewards = dict.fromkeys(acted, float(self.cells[0] == self.cells[1]))
        terminations = dict.fromkeys(acted, False)  # the end is a time limit, at which SB3 bootstraps
        truncations = dict.fromkeys(acted, self.time == 10)
        self.agents = acted if self.time < 10 else []  # an agent whose episode is over leaves
        return dict.fromkeys(acted, self.cells), rewards, terminations, truncations, {agent: {} for agent in acted}


def main(total_timesteps: int = 20_000) -> dict[str, Any]:
    """Check the environment, train a team in it, and return the numbers that are printed."""
    report = envs.check_team_env(Meeting)
    print(report)
    if report.failures:
        raise SystemExit(1)

    env, eval_env = make_team_env(Meeting, n_envs=8, seed=0), make_team_env(Meeting, n_envs=8, seed=1000)
    team: Any = Team(PPO, "MlpPolicy", env, seed=0, n_steps=64, batch_size=128, n_epochs=5, learning_rate=1e-3, gamma=0.9)
    before, _ = evaluate_policy(team, eval_env, n_eval_episodes=200)  # SB3's evaluation takes a team as it is
    team.learn(total_timesteps)
    after, _ = evaluate_policy(team, eval_env, n_eval_episodes=200)
    print(f"Steps in the same cell, of 10: {before:.1f} before training, {after:.1f} after.")
    return {"before": before, "after": after}


if __name__ == "__main__":
    th.set_num_threads(1)
    main()
