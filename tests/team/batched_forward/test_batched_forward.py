"""Agents with equal networks act in one batched pass, and learn, draw and log the same to the bit as when each acts alone."""

import copy
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.utils import polyak_update

from sb3_belief import BeliefPPO, MaskableBeliefPPO
from sb3_belief.belief_ppo import BeliefActorCriticPolicy
from sb3_belief.team.batched_forward import batcher
from sb3_belief.team.batched_forward.batcher import ForwardRequest
from tests.team.helpers import Team, make_team_env
from tests.team.parallel.test_jobs import Draws, OwnNetwork, Pushes, everything
from tests.team.toy_envs import ToyEnv

EASY = "traffic-junction-easy"
PPO_KWARGS: dict[str, Any] = {"n_steps": 8, "batch_size": 32, "n_epochs": 2}


@pytest.fixture
def sizes(monkeypatch):
    """Return a list that collects the number of agents of each batched pass."""
    found: list[int] = []
    call = batcher.StackedNetworks.__call__

    def count(self, flat, noise):
        found.append(len(flat))
        return call(self, flat, noise)

    monkeypatch.setattr(batcher.StackedNetworks, "__call__", count)
    # The passes that only test whether batched and single passes agree are not counted
    monkeypatch.setattr(batcher, "_agrees", Agrees())
    return found


class Agrees(dict):
    """Record of tested signatures that claims that all of them agree."""

    def __contains__(self, key):
        return True

    def __missing__(self, key):
        return True


def learn_both_ways(monkeypatch, sizes, n_rollouts=3, callback=None, **kwargs):
    """
    Train a team without and with batched passes, and assert that the results are equal.

    :return: The number of agents of each batched pass
    """
    results = []
    for alone in (True, False):
        with monkeypatch.context() as patch:
            if alone:
                patch.setattr(batcher, "signature", lambda policy: None)
            sizes.clear()
            team = toy_team(**kwargs)
            n_steps = next(iter(team.agents.values())).n_steps
            team.learn(8 * n_steps * n_rollouts, callback() if callback else None)
            results.append(everything(team, {}))
            assert not alone or not sizes
    assert results[0] == results[1]
    return list(sizes)


def toy_team(algo=PPO, env_id=lambda: ToyEnv(3), policy="MlpPolicy", **kwargs):
    """Return a team in eight copies, by default of three PPO agents in a ``ToyEnv``."""
    if algo is PPO:
        kwargs = {**PPO_KWARGS, **kwargs}
    return Team(algo, policy, make_team_env(env_id, n_envs=8), seed=0, device="cpu", **kwargs)


BELIEF = {"policy": "BeliefPolicy", "env_id": EASY, "n_steps": 20, "batch_size": 40, "n_epochs": 1, "history_length": 100}
SAME: dict[str, dict[str, Any]] = {
    "ppo": {},
    "a2c": {"algo": A2C, "n_steps": 8},
    "leaky": {"policy_kwargs": {"activation_fn": th.nn.LeakyReLU, "net_arch": [32, 64]}},
    "noise of a rollout": {"use_sde": True, "env_id": lambda: Pushes(3)},
    "fused optimiser": {"policy_kwargs": {"optimizer_kwargs": {"fused": True}}},
    "normalised": {"normalize": True},
    "maskable": {"algo": MaskablePPO, "env_id": EASY, **PPO_KWARGS},
    "belief": {"algo": BeliefPPO, **BELIEF},
    "masks and belief": {"algo": MaskableBeliefPPO, **BELIEF},
    "no belief": {"algo": BeliefPPO, **BELIEF, "belief": "none"},
    "static": {"algo": BeliefPPO, **BELIEF, "belief": "static", "policy_latent": "mean"},
    "context": {"algo": BeliefPPO, **BELIEF, "belief": "context", "detach_belief": True, "similarity": "observation"},
    "wide": {"algo": BeliefPPO, **BELIEF, "belief": "wide"},
}


@pytest.mark.parametrize("case", SAME)
def test_the_same_is_learned(case, monkeypatch, sizes):
    found = learn_both_ways(monkeypatch, sizes, **SAME[case])
    n_agents, n_steps = 5 if SAME[case].get("env_id") == EASY else 3, SAME[case].get("n_steps", 8)
    if SAME[case].get("belief", "dynamic") in ("dynamic", "context") and "history_length" in SAME[case]:
        # While their histories grow, agents may hold different numbers of steps, and then are not batched
        assert found[:n_steps] == [n_agents] * n_steps and sum(found[n_steps:]) > 2 * n_agents * n_steps / 2
    else:
        assert found == [n_agents] * n_steps * 3


def test_the_policies_that_act_together_are_the_ones_that_agree(monkeypatch, sizes):
    monkeypatch.setattr(batcher, "_agrees", {})
    found = learn_both_ways(monkeypatch, sizes, policy_kwargs={"net_arch": [64]})
    # One of the 25 passes is the test of whether they agree
    assert found == [3] * 25
    # Where batched products are rounded differently, the test is the only pass
    monkeypatch.setattr(batcher, "_agrees", {})
    monkeypatch.setattr(batcher, "_equal", lambda a, b: False)
    assert learn_both_ways(monkeypatch, sizes, policy_kwargs={"net_arch": [64]}) == [3]


class Hooked(BaseCallback):
    """Callback of the team that adds a hook to an agent's network in the middle of a rollout."""

    model: Any

    def _on_step(self):
        if self.n_calls == 12:
            network = self.model.agents["agent_1"].policy.mlp_extractor
            network.register_forward_hook(lambda module, _, output: (output[0] * 2, output[1]))
        return True


def replace_layers(module):
    """Put copies of linear layers with other weights in their places, in a module."""
    for name, layer in list(module.named_children()):
        if isinstance(layer, th.nn.Linear):
            other = copy.deepcopy(layer)
            other.weight.mul_(0.5)
            setattr(module, name, other)


class Writes(BaseCallback):
    """Callback of the team that changes agents' weights in the middle of rollouts, in every way there is."""

    model: Any

    @th.no_grad()
    def _on_step(self):
        policies = [self.model.agents[f"agent_{i}"].policy for i in range(3)]
        layer = next(module for module in policies[0].mlp_extractor.modules() if isinstance(module, th.nn.Linear))
        if self.n_calls == 3:
            layer.weight.mul_(1.5)
        elif self.n_calls == 6:
            layer.bias = th.nn.Parameter(layer.bias + 0.5)
        elif self.n_calls == 11:
            layer.weight.data = layer.weight + 0.5
        elif self.n_calls == 4:
            layer.weight.data.mul_(0.9)
        elif self.n_calls == 5:
            polyak_update(policies[1].parameters(), policies[2].parameters(), 0.7)
        elif self.n_calls == 7:
            layer.weight.detach().numpy()[0] = 0.1
        elif self.n_calls == 9 and getattr(policies[0], "history", None) is not None:
            policies[0].history.actions.data.zero_()
            policies[1].history.observations.numpy()[:] *= 0.5
        elif self.n_calls == 10:
            # Another layer in its place
            policies[1].mlp_extractor.apply(replace_layers)
        elif self.n_calls == 13:
            policies[1].load_state_dict(policies[2].state_dict())
        elif self.n_calls == 15:
            policies[2].load_from_vector(policies[2].parameters_to_vector() * 1.1)
        return True


@pytest.mark.parametrize("kwargs", [{}, {"algo": BeliefPPO, "policy": "BeliefPolicy", "history_length": 20, **PPO_KWARGS}])
def test_weights_that_are_changed_within_a_rollout_count_at_once(kwargs, monkeypatch, sizes):
    assert learn_both_ways(monkeypatch, sizes, callback=Writes, **kwargs) == [3] * 24


class Perturbs(PPO):
    """An algorithm of the user's own that changes its weights within rollouts."""

    def _update_info_buffer(self, infos, dones=None):
        super()._update_info_buffer(infos, dones)
        for weights in self.policy.mlp_extractor.parameters():
            weights.data.mul_(1.01)


def test_an_algorithm_of_ones_own_may_change_weights_within_a_rollout(monkeypatch, sizes):
    assert learn_both_ways(monkeypatch, sizes, algo=Perturbs, **PPO_KWARGS) == [3] * 24


class MyPolicy(ActorCriticPolicy):
    """A user's own policy class."""


OWN: dict[str, dict[str, Any]] = {
    "own policy": {"policy": MyPolicy},
    "own extractor": {"policy_kwargs": {"features_extractor_class": OwnNetwork}},
    "two extractors": {"policy_kwargs": {"share_features_extractor": False}},
    "another activation": {"policy_kwargs": {"activation_fn": th.nn.SiLU}},
    "recurrent": {"algo": RecurrentPPO, "policy": "MlpLstmPolicy", **PPO_KWARGS},
}


@pytest.mark.parametrize("case", OWN)
def test_who_acts_alone(case, monkeypatch, sizes):
    assert learn_both_ways(monkeypatch, sizes, **OWN[case]) == []


def test_those_of_one_kind_act_together(monkeypatch, sizes):
    shape = {"agent_2": {"policy_kwargs": {"net_arch": [64]}}}
    assert learn_both_ways(monkeypatch, sizes, agent_kwargs=shape) == [2] * 24
    two = {f"agent_{i}": {"policy_kwargs": {"net_arch": [64]}} for i in (1, 3)}
    assert learn_both_ways(monkeypatch, sizes, env_id=lambda: ToyEnv(4), agent_kwargs=two) == [2] * 48
    # The agent acts alone from the step on at which it gets the hook, which changes what it does
    assert learn_both_ways(monkeypatch, sizes, callback=Hooked) == [3] * 12 + [2] * 12


def test_who_has_a_callback_acts_alone(sizes):
    team = toy_team()
    team.learn(8 * 8, agent_callbacks={"agent_1": Draws()})
    assert sizes == [2] * 8
    sizes.clear()
    team.learn(8 * 8, agent_callbacks={"agent_1": Draws(), "agent_2": Draws()})
    assert sizes == []
    assert all({"forward", "mlp_extractor", "extract_features"}.isdisjoint(vars(m.policy)) for m in team.agents.values())


def test_what_a_user_has_replaced_stays(sizes):
    team = toy_team(env_id=lambda: ToyEnv(4))
    models = [team.agents[f"agent_{i}"] for i in range(4)]
    asked, trained = [], []

    def forward(obs):
        asked.append(len(obs))
        return type(models[0].policy).forward(models[0].policy, obs)

    def train():
        trained.append(True)
        PPO.train(models[1])

    models[0].policy.forward, models[1].train = forward, train
    team.learn(8 * 16)
    assert (models[0].policy.forward, models[1].train) == (forward, train)
    assert len(asked) == 16 and len(trained) == 2 and sizes == [3] * 16


def make_policies(n):
    """Return ``n`` belief policies with a history of 60 steps."""
    others = {"other": spaces.Discrete(3)}
    space = spaces.Box(-10, 10, (6,)), spaces.Discrete(5)
    policies = [BeliefActorCriticPolicy(*space, lambda _: 1e-3, others_action_spaces=others) for _ in range(n)]
    for policy in policies:
        policy.remember(th.randn(60, 6).numpy(), np.eye(3, dtype=np.float32)[np.arange(60) % 3])
    return policies


def test_a_policy_unlike_any_of_sb3_acts_by_itself():
    with th.no_grad():
        assert not ForwardRequest(th.nn.Linear(2, 2), watches=False).accepts(th.zeros(1, 2))
        assert ForwardRequest(make_policies(1)[0], watches=False).accepts(th.zeros(1, 6))
    assert not ForwardRequest(make_policies(1)[0], watches=False).accepts(th.zeros(1, 6))
