"""What a model has become in a worker comes back as it is there, or the worker says that it cannot."""

import os
from typing import Any

import pytest
import torch as th
from stable_baselines3 import PPO

from sb3_belief import BeliefPPO
from tests.team.helpers import parameters
from tests.team.parallel.test_jobs import (
    EASY,
    PPO_SMALL,
    everything,
    notes,
    toy_team,
)
from tests.team.toy_envs import ToyEnv


class GrowsALayer(PPO):
    """Its policy has one more layer after the first update."""

    def train(self):
        super().train()
        self.policy.more = th.nn.Linear(1, 1)


class Freezes(PPO):
    """It replaces one parameter and freezes another in its first update."""

    def train(self):
        super().train()
        if self._n_updates == self.n_epochs:
            layer: Any = self.policy.action_net
            layer.bias = th.nn.Parameter(layer.bias + 0.1)
            self.policy.value_net.weight.requires_grad_(False)


def test_replaced_and_frozen_parameters_come_back_as_such():
    results = []
    for jobs in (1, 2):
        team = toy_team(Freezes, jobs, **PPO_SMALL)
        first, held = team.agents["agent_0"], team.agents["agent_0"].policy.action_net.bias
        for _ in range(3):
            team.learn(16, reset_num_timesteps=False)
        assert first.policy.action_net.bias is not held
        assert not first.policy.value_net.weight.requires_grad
        results.append(everything(team, {}))
    assert results[0] == results[1]


def test_a_history_that_is_held_stays_as_it_was():
    for jobs in (1, 2):
        kwargs = {"n_steps": 8, "batch_size": 16, "n_epochs": 1, "policy": "BeliefPolicy", "history_length": 30}
        team = toy_team(BeliefPPO, jobs, env_id=EASY, **kwargs).learn(16)
        held = team.agents["car_0"].policy.history
        before = [part.clone() for part in held]
        for _ in range(2):
            team.learn(16, reset_num_timesteps=False)
        assert all(th.equal(part, old) for part, old in zip(held, before, strict=True))
        assert not th.equal(team.agents["car_0"].policy.history.observations, before[0])


class Grows(PPO):
    """Its policy has one more parameter after the first update."""

    def train(self):
        super().train()
        self.policy.more = th.nn.Parameter(th.zeros(1))


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("algo", [Grows, GrowsALayer])
def test_a_model_that_could_not_come_back_is_found_out_at_its_first_update(algo):
    team = toy_team({"agent_0": algo, "agent_1": PPO}, 2, **PPO_SMALL)
    with pytest.raises(RuntimeError, match=r"adds or removes parameters.* use jobs=1") as caught:
        team.learn(640)
    assert "joint step 8 " in notes(caught.value)


class Opens(PPO):
    """It gets what cannot be sent, but not at its first update."""

    n_trained = 0

    def train(self):
        super().train()
        self.n_trained += 1
        if self.n_trained == 2:
            self.file = open(os.devnull, "w")


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::RuntimeWarning")
def test_a_model_that_cannot_come_back_does_not_keep_others():
    learned = []
    for jobs in (1, 2):
        classes = {"agent_0": Opens, "agent_1": PPO, "agent_2": PPO}
        team = toy_team(classes, jobs, lambda: ToyEnv(3), **PPO_SMALL)
        if jobs == 1:
            team.learn(48)
        else:
            with pytest.raises(Exception, match=r"(?i)pickle"):
                team.learn(48)
        learned.append([parameters(team.agents[agent]) for agent in ("agent_1", "agent_2")])
    assert all(th.equal(one, two) for one, two in zip(*learned, strict=True))
