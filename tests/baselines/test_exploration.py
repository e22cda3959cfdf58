"""How IQL explores: which random actions it takes, and how often in which part of the training."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback

from sb3_belief.baselines import IQL
from tests.baselines.helpers import Q_KWARGS
from tests.baselines.test_iql import Choices, played
from tests.team.helpers import Team, make_team_env
from tests.team.toy_envs import ToyEnv


def test_random_actions_are_uniform_over_the_possible_ones():
    model = played(make_team_env(Choices, n_envs=2, seed=0), exploration_initial_eps=1.0)
    model.exploration_rate = 1.0
    masks = np.tile([[True, False, True], [True, True, True]], (3000, 1))
    actions, _ = model.predict(np.zeros((6000, 2), dtype=np.float32), action_masks=masks)
    shares = [np.bincount(actions[k::2], minlength=3) / 3000 for k in range(2)]
    assert shares[0] == pytest.approx([0.5, 0, 0.5], abs=0.04) and shares[1] == pytest.approx([1 / 3] * 3, abs=0.04)


def test_a_coin_for_each_copy():
    model = played(make_team_env(ToyEnv, n_envs=2, seed=0))
    model.exploration_rate, obs = 0.3, np.zeros((2000, 2), dtype=np.float32)
    greedy = model.predict(obs, deterministic=True)[0][0]
    # SB3's DQN: either all are greedy or none
    shares = [(model.predict(obs)[0] != greedy).mean() for _ in range(5)]
    assert shares == pytest.approx([0.2] * 5, abs=0.05)
    assert (model.predict(obs, deterministic=True)[0] == greedy).all()


@pytest.mark.parametrize("total", [120, 240])
def test_epsilon_falls_in_as_many_steps_however_long_the_training_is(total):
    rates = {}

    class Watch(BaseCallback):
        def _on_step(self) -> bool:
            model: Any = self.model
            rates[self.num_timesteps] = model.exploration_rate
            return True

    kwargs = {**Q_KWARGS, "exploration_fraction": 0.1, "exploration_steps": 100}
    eps = {"exploration_initial_eps": 0.8, "exploration_final_eps": 0.2}
    team = Team(IQL, "MlpPolicy", make_team_env(ToyEnv, n_envs=2, seed=0), seed=0, **kwargs, **eps)
    team.learn(0).learn(60, agent_callbacks={"agent_0": Watch()})
    team.learn(total - 60, agent_callbacks={"agent_0": Watch()}, reset_num_timesteps=False)
    team.learn(0, reset_num_timesteps=False)
    # The rate with which a step is made is that of the steps before it
    expected = {step: max(0.2, 0.8 - 0.6 * (step - 2) / 100) for step in range(4, total + 1, 2)}
    assert {step: rate for step, rate in rates.items() if step > 2} == pytest.approx(expected)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"exploration_steps": 0}, "exploration_steps=0 must be an integer >= 1"),
        ({"exploration_steps": 1e4}, "exploration_steps=10000.0 must be an integer"),
        ({"exploration_steps": 10, "exploration_fraction": 0.2}, "leave one of them out"),
    ],
)
def test_wrong_lengths_of_exploration(kwargs, message):
    with pytest.raises(ValueError, match=message):
        IQL("MlpPolicy", gym.make("CartPole-v1"), **kwargs)
