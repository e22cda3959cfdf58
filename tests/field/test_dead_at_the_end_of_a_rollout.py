"""An agent that is dead when a rollout ends has targets as good as those of its other lives, with a critic that learns."""

from typing import Any, ClassVar

import numpy as np
import pytest
from gymnasium import spaces
from pettingzoo import ParallelEnv
from stable_baselines3.common.callbacks import BaseCallback

from sb3_belief import BeliefPPO, Team, make_team_env

LENGTH, GAMMA = 40, 0.99


class Soldiers(ParallelEnv):
    """Each step pays all the same; one soldier falls on the way, and stays listed with a blank observation, as in SMAC."""

    metadata: ClassVar = {"name": "soldiers"}
    render_mode = None

    def __init__(self):
        self.possible_agents = ["falls", "stands"]
        self.rng = np.random.default_rng()

    def observation_space(self, agent):
        return spaces.Box(0, 1, (2,), np.float32)

    def action_space(self, agent):
        return spaces.Discrete(2)

    def _observations(self):
        seen = np.array([self.t / LENGTH, 1], dtype=np.float32)
        return {"falls": seen if self.t < self.falls_at else np.zeros_like(seen), "stands": seen}

    def reset(self, seed=None, options=None):
        if seed is not None:
            self.rng = np.random.default_rng(seed)
        self.t, self.falls_at = 0, int(self.rng.integers(5, 36))
        self.agents = list(self.possible_agents)
        return self._observations(), {agent: {} for agent in self.agents}

    def step(self, actions):
        active = self.t < self.falls_at
        self.t += 1
        over = dict.fromkeys(self.possible_agents, self.t == LENGTH)
        infos = {"falls": {"active": active, "next_active": self.t < self.falls_at}, "stands": {}}
        if self.t == LENGTH:
            self.agents = []
        no, pay = dict.fromkeys(self.possible_agents, False), dict.fromkeys(self.possible_agents, 1.0)
        return self._observations(), pay, over, no, infos


class Errors(BaseCallback):
    """Collects how far the targets are from the true values, of lives that a rollout's end cuts while dead and of others."""

    model: Any

    def __init__(self):
        super().__init__()
        self.cut: list[float] = []
        self.others: list[float] = []

    def _on_step(self):
        return True

    def _on_rollout_end(self):
        buffer = self.model.rollout_buffer
        alive, t = buffer.observations[..., 1] > 0.5, np.rint(buffer.observations[..., 0] * LENGTH)
        error = np.abs(buffer.returns - (1 - GAMMA ** (LENGTH - t)) / (1 - GAMMA))
        # The last life of each copy whose soldier is dead at the end: everything since the episode began
        later_starts = np.flip(np.cumsum(np.flip(buffer.episode_starts, axis=0), axis=0), axis=0) - buffer.episode_starts
        cut = alive & (later_starts == 0) & ~alive[-1]
        if self.num_timesteps > 8 * 30 * 80:
            self.cut += error[cut].tolist()
            self.others += error[alive & ~cut].tolist()


@pytest.mark.slow
def test_lives_that_are_cut_while_dead_have_targets_as_good_as_others():
    errors, env = Errors(), make_team_env(Soldiers, n_envs=8, seed=0)
    settings: dict[str, Any] = dict(n_steps=30, batch_size=240, n_epochs=10, learning_rate=3e-3, gamma=GAMMA, belief="none")
    team = Team(BeliefPPO, "MlpPolicy", env, seed=0, **settings)
    team.learn(8 * 30 * 120, agent_callbacks={"falls": errors})
    # The critic's opinion of blank observations made them 7.5 where others were 2.7
    assert np.mean(errors.cut) < 1.2 * np.mean(errors.others) < 2.4
