"""Value normalisation, Huber and clipped value loss, layer norm, action gain and active masks: off they change nothing."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import MaskablePPO
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.utils import explained_variance
from torch import nn

from sb3_belief.belief_ppo import BeliefActorCriticPolicy, BeliefPPO, MaskableBeliefPPO
from sb3_belief.belief_ppo.value_loss import NormalizedValue, ValueOptions, ValueTargets, value_loss
from sb3_belief.zoo.config import load_config
from tests.belief_ppo.helpers import ALGORITHMS, ROLLOUT, SMALL, make_model, observations_of, same_parameters
from tests.belief_ppo.toy_envs import AmongOthers

OFF: dict[str, Any] = dict(value_norm=False, huber_delta=None, value_clip=None, active_masks=True)
ON: dict[str, Any] = dict(value_norm=True, huber_delta=10.0, value_clip=0.2)
STOCK = {BeliefPPO: PPO, MaskableBeliefPPO: MaskablePPO}
BELIEFS = ["dynamic", "none"]


class FarReturns(gym.Env):
    """One step: the return is ``mean + scale * observation``, whatever the agent does."""

    def __init__(self, mean=0.0, scale=1.0):
        self.observation_space, self.action_space = spaces.Box(-1, 1, (1,), np.float32), spaces.Discrete(2)
        self.mean, self.scale = mean, scale

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = self.np_random.uniform(-1, 1)
        return np.array([self.x], dtype=np.float32), {}

    def step(self, action):
        reward = self.mean + self.scale * self.x
        return np.zeros(1, dtype=np.float32), reward, True, False, {}


def far_model(mean, scale, **kwargs) -> Any:
    env = make_vec_env(FarReturns, n_envs=8, seed=0, env_kwargs=dict(mean=mean, scale=scale))
    settings: dict[str, Any] = dict(
        n_steps=16, batch_size=32, n_epochs=10, learning_rate=3e-3, gamma=0.0, seed=0, device="cpu"
    )
    return BeliefPPO("MlpPolicy", env, belief="none", **{**settings, **kwargs})


# -- off ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("belief", BELIEFS)
def test_off_they_change_nothing(algorithm, belief):
    kwargs: dict[str, Any] = dict(algorithm=algorithm, belief=belief)
    off = dict(OFF, policy_kwargs=dict(obs_layer_norm=False, action_gain=0.01))
    models = [make_model(env_kwargs=dict(inactive=3), **kwargs, **more).learn(2 * ROLLOUT) for more in ({}, off)]
    assert same_parameters(*models)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_off_without_a_belief_it_is_sb3s_own(algorithm):
    ours = make_model(algorithm=algorithm, belief="none", **OFF).learn(2 * ROLLOUT)
    kwargs = {key: value for key, value in SMALL.items() if key not in ("history_length", "keep_ratio")}
    stock = STOCK[algorithm]("MlpPolicy", make_vec_env(type(ours.env.envs[0].unwrapped), 3, seed=0), **kwargs).learn(
        2 * ROLLOUT
    )
    for a, b in zip(ours.policy.parameters(), stock.policy.parameters(), strict=True):
        # Fused Adam makes the same step to the last bits
        th.testing.assert_close(a, b, atol=1e-6, rtol=1e-5)


# -- value normalisation -----------------------------------------------------------------------------------------------


def test_statistics_of_the_first_batch():
    head = NormalizedValue(nn.Linear(3, 1))
    assert [float(x) for x in head.statistics()] == [0.0, 1.0]
    head.update(th.tensor([1.0, 3.0]))
    assert [float(x) for x in head.statistics()] == pytest.approx([2.0, 1.0], abs=1e-4)


def test_statistics_of_more_batches_are_weighted_as_defined():
    head, b = NormalizedValue(nn.Linear(3, 1)), 0.99999
    m: Any = 0.0
    q: Any = 0.0
    d: Any = 0.0
    for batch in ([1.0, 3.0], [10.0, 10.0], [-4.0, 0.5]):
        head.update(th.tensor(batch))
        m, q, d = (b * total + (1 - b) * new for total, new in ((m, np.mean(batch)), (q, np.mean(np.square(batch))), (d, 1.0)))
    mean, std = head.statistics()
    assert float(mean) == pytest.approx(m / d, rel=1e-6)
    assert float(std) == pytest.approx(np.sqrt(q / d - (m / d) ** 2), rel=1e-6)


def test_the_variance_is_at_least_a_hundredth():
    head = NormalizedValue(nn.Linear(3, 1))
    head.update(th.full((5,), 1e4))
    assert [float(x) for x in head.statistics()] == pytest.approx([1e4, 0.1], rel=1e-6)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("belief", BELIEFS)
def test_an_update_takes_in_the_returns_of_its_active_steps(algorithm, belief):
    model = make_model(env_kwargs=dict(inactive=3), algorithm=algorithm, belief=belief, value_norm=True).learn(ROLLOUT)
    buffer = model.rollout_buffer
    returns = buffer.returns[buffer.active]
    assert len(returns) < buffer.returns.size
    mean, std = model.policy.value_net.statistics()
    assert float(mean) == pytest.approx(returns.mean(), rel=1e-5)
    assert float(std) == pytest.approx(max(returns.std(), 0.1), rel=1e-4)


def test_the_head_predicts_normalised_values_and_everyone_else_sees_them_as_they_are():
    model = far_model(1000.0, 10.0, value_norm=True).learn(1280)
    obs = th.rand(9, 1) * 2 - 1
    mean, std = model.policy.value_net.statistics()
    with th.no_grad():
        latents = model.policy.mlp_extractor.forward_critic(model.policy.extract_features(obs))
        normalised = model.policy.value_net.head(latents)
        values = model.policy.predict_values(obs)
        th.testing.assert_close(values, normalised * std + mean)
        th.testing.assert_close(model.policy(obs)[1], values)
        th.testing.assert_close(model.policy.evaluate_actions(obs, th.zeros(9))[0], values)
    assert normalised.abs().max() < 5
    assert (values - 1000).abs().max() < 50


def test_it_learns_returns_far_from_zero_which_the_plain_value_does_not():
    def fit(model):
        obs = th.linspace(-1, 1, 41)[:, None]
        with th.no_grad():
            values = model.policy.predict_values(obs).flatten().numpy()
        true = 1000.0 + 10.0 * obs.flatten().numpy()
        return explained_variance(values, true), np.abs(values - true).max()

    settings: dict[str, Any] = dict(batch_size=128, learning_rate=1e-2)
    explained, error = fit(far_model(1000.0, 10.0, value_norm=True, **settings).learn(2_560))
    assert explained > 0.9
    assert error < 10
    assert fit(far_model(1000.0, 10.0, **settings).learn(2_560))[1] > 100


def test_statistics_are_saved_and_loaded_with_the_policy(tmp_path):
    model = far_model(50.0, 3.0, value_norm=True).learn(256)
    model.save(tmp_path / "model.zip")
    loaded = BeliefPPO.load(tmp_path / "model.zip", env=model.get_env())
    assert same_parameters(model, loaded)
    obs = th.rand(5, 1)
    assert th.equal(model.policy.predict_values(obs), loaded.policy.predict_values(obs))
    loaded.learn(128)
    sums: Any = [each.policy.value_net.weight_sum for each in (loaded, model)]
    assert sums[0] > sums[1]


# -- the loss ----------------------------------------------------------------------------------------------------------


def loss_of(returns, values, old, std=1.0, **options):
    targets = ValueTargets(th.tensor(returns), th.tensor(old))
    return float(value_loss(th.tensor(values), targets, std, ValueOptions(**options)))


def test_huber_turns_linear_at_its_delta():
    assert loss_of([20.0, 1.0, -5.0], [0.0, 0.0, 0.0], [0.0] * 3, huber_delta=10.0) == pytest.approx((150 + 0.5 + 12.5) / 3)
    # In deviations of the returns
    assert loss_of([20.0], [0.0], [0.0], std=2.0, huber_delta=10.0) == pytest.approx(50.0)
    assert loss_of([20.0], [0.0], [0.0]) == pytest.approx(400.0)


def test_the_clipped_loss_is_the_larger_one():
    # It moved towards the return by more than 0.2: what counts is that of the value that stopped, which has no gradient
    values = th.tensor([1.0], requires_grad=True)
    loss = value_loss(values, ValueTargets(th.tensor([2.0]), th.tensor([0.0])), 1.0, ValueOptions(value_clip=0.2))
    assert loss.item() == pytest.approx(1.8**2)
    assert th.autograd.grad(loss, values)[0].item() == 0.0
    # It moved away: its own, which draws it back
    values = th.tensor([1.0], requires_grad=True)
    loss = value_loss(values, ValueTargets(th.tensor([-1.0]), th.tensor([0.0])), 1.0, ValueOptions(value_clip=0.2))
    assert loss.item() == pytest.approx(4.0)
    assert th.autograd.grad(loss, values)[0].item() == pytest.approx(4.0)
    # In deviations of the returns
    assert loss_of([20.0], [10.0], [0.0], std=10.0, value_clip=0.2) == pytest.approx(1.8**2)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("belief", BELIEFS)
def test_the_added_loss_has_the_gradient_of_sb3s_own(algorithm, belief):
    # With a clip that nothing reaches the loss is SB3's, only that it joins by another way
    models = [
        make_model(algorithm=algorithm, belief=belief, vf_coef=0.7, value_clip=clip).learn(ROLLOUT) for clip in (None, 1e9)
    ]
    for (name, a), b in zip(models[0].policy.named_parameters(), models[1].policy.parameters(), strict=True):
        th.testing.assert_close(a, b, atol=1e-6, rtol=1e-5, msg=name)
    assert models[1].vf_coef == 0.7
    assert models[1].logger.name_to_value["train/value_loss"] > 0


@pytest.mark.parametrize("option", [dict(value_norm=True), dict(huber_delta=0.1), dict(value_clip=0.001)])
@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("belief", BELIEFS)
def test_each_option_changes_what_is_learned(algorithm, belief, option):
    off: dict[str, Any] = {}
    models = [make_model(algorithm=algorithm, belief=belief, **more).learn(2 * ROLLOUT) for more in (off, option)]
    critics = [model.policy.mlp_extractor.state_dict() for model in models]
    assert any(not th.allclose(critics[0][name], critics[1][name]) for name in critics[0])


def test_the_values_weight_is_that_of_the_loss():
    models = [make_model(belief="none", vf_coef=coef, **ON).learn(ROLLOUT) for coef in (0.5, 0.0)]
    untouched = make_model(belief="none", **ON)
    heads = [model.policy.value_net.head.weight for model in (*models, untouched)]
    assert not th.equal(heads[0], heads[2])
    assert th.equal(heads[1], heads[2])


def test_a_huber_loss_is_not_carried_away_by_an_outlier():
    def step(**kwargs):
        model = far_model(0.0, 1e4, n_epochs=1, batch_size=128, max_grad_norm=1e9, policy_kwargs=dict(net_arch=[8]), **kwargs)
        gradients: list[th.Tensor] = []
        optimize = model.policy.optimizer.step
        weight = model.policy.value_net.weight

        def watched(*args):
            gradients.append(weight.grad.clone())
            return optimize(*args)

        model.policy.optimizer.step = watched
        model.learn(128)
        return float(gradients[0].abs().max())

    assert step(huber_delta=10.0) < 10 < step()


# -- networks ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("belief", BELIEFS)
def test_a_layer_norm_makes_scale_and_offset_of_observations_indifferent(algorithm, belief):
    outputs = []
    for layer_norm in (True, False):
        kwargs = dict(obs_layer_norm=layer_norm, action_gain=1.0)
        model = make_model(algorithm=algorithm, belief=belief, detach_belief=False, policy_kwargs=kwargs)
        policy, obs = model.policy, th.as_tensor(observations_of(model, 6))
        assert sum(isinstance(module, nn.LayerNorm) for module in policy.modules()) == 2 * layer_norm

        def networks(features, policy=policy):
            networks = getattr(policy.mlp_extractor, "base", policy.mlp_extractor)
            return th.cat(networks(features), dim=1)

        outputs.append([networks(obs), networks(100 * obs + 7)])
    th.testing.assert_close(*outputs[0], atol=1e-3, rtol=1e-3)
    assert (outputs[1][0] - outputs[1][1]).abs().max() > 0.1


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("belief", BELIEFS)
def test_a_layer_norm_learns_and_is_loaded(algorithm, belief, tmp_path):
    model = make_model(algorithm=algorithm, belief=belief, policy_kwargs=dict(obs_layer_norm=True), **ON)
    before = [p.clone() for module in model.policy.modules() if isinstance(module, nn.LayerNorm) for p in module.parameters()]
    model.learn(ROLLOUT)
    after = [p for module in model.policy.modules() if isinstance(module, nn.LayerNorm) for p in module.parameters()]
    assert all(not th.equal(a, b) for a, b in zip(before, after, strict=True))
    model.save(tmp_path / "model.zip")
    assert same_parameters(model, algorithm.load(tmp_path / "model.zip"))


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("belief", BELIEFS)
def test_the_gain_is_that_of_the_action_layer_alone(algorithm, belief):
    small, large = (
        make_model(algorithm=algorithm, belief=belief, policy_kwargs=dict(action_gain=gain)).policy.state_dict()
        for gain in (0.01, 1.0)
    )
    th.testing.assert_close(100 * small["action_net.weight"], large["action_net.weight"], rtol=1e-4, atol=1e-6)
    assert all(th.equal(small[name], large[name]) for name in small if name != "action_net.weight")


# -- active masks ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_without_active_masks_it_trains_on_what_sb3_would(algorithm):
    env_kwargs = dict(inactive=3)
    on, off = (
        make_model(env_kwargs=env_kwargs, algorithm=algorithm, belief="none", active_masks=masks).learn(2 * ROLLOUT)
        for masks in (True, False)
    )
    kwargs = {key: value for key, value in SMALL.items() if key not in ("history_length", "keep_ratio")}
    env = make_vec_env(type(off.env.envs[0].unwrapped), 3, seed=0, env_kwargs=env_kwargs)
    stock = STOCK[algorithm]("MlpPolicy", env, **kwargs).learn(2 * ROLLOUT)
    pairs = list(zip(on.policy.parameters(), off.policy.parameters(), stock.policy.parameters(), strict=True))
    for _, b, c in pairs:
        # Fused Adam, and one pass for all bootstrapped values: the same to the last bits
        th.testing.assert_close(b, c, atol=1e-6, rtol=1e-5)
    assert any((a - c).abs().max() > 1e-4 for a, _, c in pairs)


# -- arguments ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "kwargs, message",
    [
        (dict(value_norm=1), "value_norm is 1; it must be True or False"),
        (dict(huber_delta=0), "huber_delta is 0; it must be a number above 0"),
        (dict(value_clip=-0.2), "value_clip is -0.2; it must be a number above 0"),
        (dict(active_masks="no"), "active_masks is 'no'; it must be True or False"),
        (dict(value_norm=True, clip_range_vf=0.2), "clip_range_vf is of SB3's own loss"),
        (dict(policy_kwargs=dict(obs_layer_norm="yes")), "obs_layer_norm is 'yes'; it must be True or False"),
        (dict(policy_kwargs=dict(action_gain=0)), "action_gain is 0; it must be a number above 0"),
        (dict(policy_kwargs=dict(action_gain=1.0, ortho_init=False)), "which ortho_init=False leaves out"),
    ],
)
def test_what_makes_no_sense_is_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make_model(belief="none", **kwargs)


def test_sb3s_own_policy_has_no_place_for_them():
    with pytest.raises(ValueError, match="need a policy derived from BeliefActorCriticPolicy"):
        BeliefPPO(PPO.policy_aliases["MlpPolicy"], make_vec_env(AmongOthers, 1), belief="none", value_norm=True)  # type: ignore


class OwnNetworks(nn.Module):
    latent_dim_pi = latent_dim_vf = 5

    def forward(self, features):
        return features, features


class OwnPolicy(BeliefActorCriticPolicy):
    def _build_mlp_extractor(self):
        self.mlp_extractor = OwnNetworks()  # type: ignore[assignment]


def test_networks_of_ones_own_have_no_place_for_a_layer_norm():
    with pytest.raises(ValueError, match="a OwnNetworks of its own"):
        BeliefPPO(OwnPolicy, make_vec_env(AmongOthers, 1), belief="none", policy_kwargs=dict(obs_layer_norm=True))


def test_a_layer_norm_of_a_single_number_is_refused():
    with pytest.raises(ValueError, match="would make an observation of one number zero"):
        far_model(0.0, 1.0, policy_kwargs=dict(obs_layer_norm=True))


def test_yaml_has_them_all():
    given = ["value_norm:true", "huber_delta:10", "value_clip:0.2", "active_masks:false"]
    given.append("policy_kwargs:{obs_layer_norm: true, action_gain: 1.0}")
    for algo in ("ippo", "belief_ppo", "maskable_belief_ppo", "ippo_shared"):
        config = load_config(algo, "traffic-junction-easy", params=given)
        assert config.algo_kwargs["huber_delta"] == 10.0
        assert config.algo_kwargs["policy_kwargs"]["obs_layer_norm"] is True


def test_what_the_clip_stops_does_not_depend_on_where_returns_lie():
    """The unit of the values is another one after the first rollout, which is no movement of the head."""
    moved = []
    for mean in (0.0, 100.0):
        model = far_model(mean, 3.0, value_norm=True, value_clip=0.2, huber_delta=10.0)
        before = [weight.clone() for weight in model.policy.value_net.head.parameters()]
        model.learn(8 * 16)
        moved.append(
            [after.detach() - old for after, old in zip(model.policy.value_net.head.parameters(), before, strict=True)]
        )
    for near, far in zip(*moved, strict=True):
        th.testing.assert_close(near, far, atol=2e-3, rtol=0.05)
    assert moved[1][0].abs().max() > 0.01
