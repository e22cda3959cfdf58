"""Policies with networks of the user's own, stock policies where there is no belief, and other initialisations."""

from typing import Any

import numpy as np
import pytest
import torch as th
from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_belief import BeliefPPO, MaskableBeliefPPO
from sb3_belief.belief_ppo import BeliefActorCriticPolicy, MaskableBeliefActorCriticPolicy
from tests.belief_ppo.helpers import ALGORITHMS, SMALL, make_model, observations_of


class TwoTowers(th.nn.Module):
    """A network of the kind that SB3's documentation lets a policy build instead of its own."""

    latent_dim_pi = latent_dim_vf = 8

    def __init__(self, features_dim):
        super().__init__()
        self.actor, self.critic = th.nn.Linear(features_dim, 8), th.nn.Linear(features_dim, 8)

    def forward(self, features):
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features):
        return self.actor(features)

    def forward_critic(self, features):
        return self.critic(features)


class OwnTowers(BeliefActorCriticPolicy):
    def _build_mlp_extractor(self):
        self.mlp_extractor: Any = TwoTowers(self.features_dim)


class OwnMaskableTowers(MaskableBeliefActorCriticPolicy):
    def _build_mlp_extractor(self):
        self.mlp_extractor: Any = TwoTowers(self.features_dim)


@pytest.mark.parametrize("belief", ["dynamic", "static", "wide", "none"])
@pytest.mark.parametrize("algorithm, policy", [(BeliefPPO, OwnTowers), (MaskableBeliefPPO, OwnMaskableTowers)])
def test_a_network_of_ones_own_is_given_features_and_belief_side_by_side(algorithm, policy, belief, tmp_path):
    env = make_model(algorithm=algorithm).get_env()
    model = algorithm(policy, env, belief=belief, **SMALL).learn(3 * 42)
    network = model.policy.mlp_extractor
    n_features = 5 + (0 if belief == "none" else model.policy.latent_dim)
    assert isinstance(network, TwoTowers) and network.actor.in_features == n_features
    measured = {name for name in model.logger.name_to_value if name.startswith("belief/")}
    assert bool(measured) == (belief != "none") and "belief/fusion_ratio" not in measured
    if belief != "none":
        # The belief learns through the network, and PPO's ratio starts at one
        assert model.logger.name_to_value["belief/first_log_ratio"] < 1e-5
    model.save(tmp_path / "model")
    loaded, rows = algorithm.load(tmp_path / "model", allow_packages=["tests"]), observations_of(model, 6)
    assert np.array_equal(loaded.predict(rows, deterministic=True)[0], model.predict(rows, deterministic=True)[0])


STOCK = [(BeliefPPO, ActorCriticPolicy), (MaskableBeliefPPO, MaskableActorCriticPolicy)]


@pytest.mark.parametrize("algorithm, policy", STOCK)
def test_sb3s_own_policy_serves_where_there_is_no_belief(algorithm, policy, tmp_path):
    """The same network as ours without a belief, so it learns the same, to the optimiser's last bits."""
    models = []
    for each in (policy, "BeliefPolicy"):
        env = make_model(algorithm=algorithm, env_kwargs=dict(inactive=3)).get_env()
        models.append(algorithm(each, env, belief="none", **SMALL).learn(3 * 42))
    assert type(models[0].policy) is policy
    pairs = list(zip(models[0].policy.parameters(), models[1].policy.parameters(), strict=True))
    assert len(pairs) > 5 and all(th.allclose(a, b, atol=1e-6) for a, b in pairs)
    models[0].save(tmp_path / "model")
    assert type(algorithm.load(tmp_path / "model", allow_packages=["tests"]).policy) is policy


@pytest.mark.parametrize("algorithm, policy", STOCK)
def test_sb3s_own_policy_is_refused_where_there_is_a_belief(algorithm, policy):
    env = make_model(algorithm=algorithm).get_env()
    with pytest.raises(ValueError, match="needs a policy with a belief"):
        algorithm(policy, env, **SMALL)


def first_layers(**kwargs: Any) -> tuple[th.Tensor, th.Tensor]:
    policy = make_model(policy_kwargs=kwargs).policy
    return policy.belief.observation_embedding[0].weight, policy.mlp_extractor.base.policy_net[0].weight


def test_the_belief_starts_with_weights_of_its_own():
    """Without orthogonal initialisation nothing draws the policy's layers anew after the belief's."""
    belief, base = first_layers(ortho_init=False)
    assert belief.shape == base.shape and not th.equal(belief, base)
    again, _ = first_layers(ortho_init=False)
    assert th.equal(belief, again)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_what_is_remembered_in_inference_mode_can_be_trained_on(algorithm):
    model = make_model(algorithm=algorithm)
    with th.inference_mode():
        model.predict(observations_of(model, 4))
        model.policy.remember(observations_of(model, 20), np.zeros((20, 7), dtype=np.float32))
        model.policy.predict_others(observations_of(model, 4))
    assert int(model.policy.history.valid.sum()) == 20
    model.learn(3 * 42)
    assert model.logger.name_to_value["belief/first_log_ratio"] < 1e-5


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_what_is_not_finite_is_not_remembered(number):
    policy = make_model().policy
    observations = np.zeros((3, 5), dtype=np.float32)
    observations[1, 2] = number
    with pytest.raises(ValueError, match="not finite"):
        policy.remember(observations, np.zeros((3, 7), dtype=np.float32))
    assert not policy.history.valid.any()
