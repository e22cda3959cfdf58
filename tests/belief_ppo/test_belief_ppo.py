"""BeliefPPO as an SB3 algorithm: what it shares with PPO, what its update trains, what reaches it."""

import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.torch_layers import CombinedExtractor
from torch import nn
from torch.nn import functional as F

from sb3_belief.belief import kl_divergence, squared_error
from sb3_belief.belief_ppo import BeliefActorCriticPolicy, BeliefPPO, BeliefRolloutBuffer
from sb3_belief.belief_ppo.auxiliary import add_loss
from sb3_belief.belief_ppo.others import action_layout, read_others
from tests.belief_ppo.toy_envs import AmongOthers

SMALL: dict[str, Any] = dict(n_steps=14, batch_size=14, n_epochs=2, seed=0, history_length=40, keep_ratio=0.1)


def make_model(n_envs=3, env_kwargs=None, **kwargs):
    env = make_vec_env(AmongOthers, n_envs=n_envs, seed=0, env_kwargs=env_kwargs)
    return BeliefPPO("BeliefPolicy", env, **{**SMALL, **kwargs})


def same_parameters(a, b):
    pairs = list(zip(a.policy.state_dict().items(), b.policy.state_dict().items(), strict=True))
    return all(name == other and th.equal(x, y) for (name, x), (other, y) in pairs) and len(pairs) > 5


# -- the same as PPO where there is no belief --------------------------------------------------------------------------


@pytest.mark.parametrize("belief", ["none", "dynamic"])
@pytest.mark.parametrize("env_id", ["CartPole-v1", "Pendulum-v1"])
def test_without_belief_or_others_it_is_ppo(belief, env_id):
    kwargs: dict[str, Any] = dict(n_steps=64, batch_size=32, n_epochs=3, seed=3)
    ppo = PPO("MlpPolicy", env_id, **kwargs).learn(3 * 64)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        ours = BeliefPPO("BeliefPolicy", env_id, belief=belief, **kwargs).learn(3 * 64)
    expected = dict(ppo.policy.named_parameters())
    found = dict(ours.policy.named_parameters())
    assert expected.keys() == found.keys()
    for name, value in expected.items():
        assert (value - found[name]).abs().max() < 1e-6, name
    assert sum("names no other agents" in str(w.message) for w in caught) == (belief == "dynamic")


def test_none_leaves_the_belief_out_though_there_are_others():
    model = make_model(belief="none").learn(42)
    assert model.policy.belief is None and model.policy.history is None
    assert not any("belief" in name for name, _ in model.policy.named_parameters())


def test_the_belief_keeps_its_own_initialisation():
    policy = make_model().policy
    for name, value in policy.belief.named_parameters():
        if name.endswith("weight"):  # PyTorch's default is uniform within 1/sqrt(fan_in); SB3's orthogonal one is not
            assert value.abs().max() <= 1 / np.sqrt(value.shape[1]) + 1e-6, name
    assert th.allclose(policy.action_net.weight @ policy.action_net.weight.T, 0.01**2 * th.eye(3), atol=1e-6)


# -- rollout and update ------------------------------------------------------------------------------------------------


class Watch(BaseCallback):
    """Looks at the buffer after each rollout, and predicts in between, as an evaluation callback does."""

    def __init__(self, look):
        super().__init__()
        self.look = look

    def _on_step(self):
        self.model.predict(np.stack([self.training_env.observation_space.sample()] * 5), deterministic=False)
        return True

    def _on_rollout_end(self):
        self.look(self.model)


@pytest.mark.parametrize("inactive", [0, 3])
def test_first_log_ratio_is_zero(inactive):
    model = make_model(env_kwargs=dict(inactive=inactive), learning_rate=1e-2)
    ratios: list[tuple[int, int, float]] = []
    evaluate, get = model.policy.evaluate_actions, model.rollout_buffer.get
    at_hand: list[Any] = []

    def recorded_get(batch_size):
        for index, samples in enumerate(get(batch_size)):
            at_hand[:] = [model._n_updates, index, samples.old_log_prob]
            yield samples

    def recorded_evaluate(obs, actions):
        values, log_prob, entropy = evaluate(obs, actions)
        if log_prob.requires_grad:  # not the diagnostics before the update
            n_updates, index, old = at_hand
            ratios.append((n_updates, index, float((log_prob.detach() - old).abs().max())))
        return values, log_prob, entropy

    model.rollout_buffer.get, model.policy.evaluate_actions = recorded_get, recorded_evaluate
    model.learn(4 * 42, callback=Watch(lambda model: None))
    first = [ratio for n_updates, index, ratio in ratios if n_updates % 2 == 0 and index == 0]
    later = [ratio for n_updates, index, ratio in ratios if n_updates % 2 == 1]
    assert len(first) == 4 and max(first) < 1e-5
    assert min(later) > 1e-4  # the policy does move, so the zeros above say something


def test_gradient_equals_that_of_the_explicit_sum():
    model = make_model(n_epochs=1, batch_size=42, vf_coef=0.7, ent_coef=0.01, max_grad_norm=1e9, normalize_advantage=False)
    model.learn(42)  # so that the history is filled
    seen = {}

    def explicit(model):
        """PPO's loss plus eq. 8's terms, written out, on the whole rollout in one minibatch."""
        policy, buffer = model.policy, model.rollout_buffer
        obs = th.as_tensor(buffer.observations.reshape(42, -1))
        actions = th.as_tensor(buffer.actions.reshape(-1)).long()
        part = buffer.belief_minibatch(slice(None))
        part = type(part)(*(field.reshape(42, -1) for field in part))
        with policy.features_extractor.conditioned(part.noise, part.kept):
            values, log_prob, entropy = BeliefActorCriticPolicy.evaluate_actions(policy, obs, actions)
        output = policy.features_extractor.output
        advantages, returns = th.as_tensor(buffer.advantages.reshape(-1)), th.as_tensor(buffer.returns.reshape(-1))
        ratio = (log_prob - th.as_tensor(buffer.log_probs.reshape(-1))).exp()
        loss = -th.min(advantages * ratio, advantages * ratio.clamp(0.8, 1.2)).mean()
        loss = loss - 0.01 * entropy.mean() + 0.7 * F.mse_loss(returns, values.flatten())
        loss = loss + 0.5 * squared_error(output.prediction, part.others_actions, part.others_visible, policy.layout)
        loss = loss + 0.005 * kl_divergence(output.mean, output.log_std)
        policy.optimizer.zero_grad()
        loss.backward()
        seen["explicit"] = {name: p.grad.clone() for name, p in policy.named_parameters()}
        policy.optimizer.zero_grad()

    step = model.policy.optimizer.step
    model.policy.optimizer.step = lambda *args: (
        seen.update(trained={name: p.grad.clone() for name, p in model.policy.named_parameters()}) or step(*args)
    )
    model.learn(42, callback=Watch(explicit))
    assert seen["trained"].keys() == seen["explicit"].keys() and len(seen["trained"]) > 20
    for name, gradient in seen["explicit"].items():
        th.testing.assert_close(seen["trained"][name], gradient, atol=1e-6, rtol=1e-5, msg=name)
        assert gradient.abs().max() > 0, name


@pytest.mark.parametrize("vf_coef", [0.0, 0.5])
def test_add_loss_has_weight_one_whatever_the_value_coefficient(vf_coef):
    a, b = th.tensor(2.0, requires_grad=True), th.tensor(3.0, requires_grad=True)
    values = add_loss(a * th.ones(4), b**2)
    (vf_coef * values.square().mean()).backward()
    assert values.tolist() == [2.0] * 4
    assert a.grad is not None and b.grad is not None
    assert a.grad.item() == pytest.approx(vf_coef * 4.0) and b.grad.item() == pytest.approx(6.0)


def test_history_is_the_last_active_steps_of_the_rollout_before():
    model = make_model(env_kwargs=dict(inactive=4))
    rollouts, during = [], []

    def look(model):
        buffer = model.rollout_buffer
        rollouts.append([buffer.observations.copy(), buffer.others_actions.copy(), buffer.active.copy()])
        during.append(model.policy.history)

    class AfterUpdate(BaseCallback):
        def _on_step(self):
            return True

        def _on_rollout_start(self):
            after.append(model.policy.history)

    after = []
    model.learn(4 * 42, callback=[Watch(look), AfterUpdate()])
    after.append(model.policy.history)
    expected_obs, expected_actions = [], []
    assert not after[0].valid.any()
    for (observations, actions, active), before, afterwards, seen in zip(rollouts, after[:-1], after[1:], during, strict=True):
        for old, new in zip(before, seen, strict=True):
            assert th.equal(old, new)  # frozen during the rollout: it cannot hold a row of it
        for step in range(14):
            for env in range(3):
                if active[step, env]:
                    expected_obs.append(observations[step, env])
                    expected_actions.append(actions[step, env])
        n_rows = min(40, len(expected_obs))
        np.testing.assert_array_equal(afterwards.filled().observations.numpy(), np.stack(expected_obs[-n_rows:]))
        np.testing.assert_array_equal(afterwards.filled().actions.numpy(), np.stack(expected_actions[-n_rows:]))
    assert 0 < active.sum() < active.size and n_rows == 40


def test_history_is_frozen_during_the_update():
    model = make_model()
    model.learn(42)
    before, seen = [part.clone() for part in model.policy.history], []
    update = model._update

    def watched_update():
        update()
        seen.append([part.clone() for part in model.policy.history])

    model._update = watched_update
    model.learn(42)
    assert len(seen) == 1 and all(th.equal(a, b) for a, b in zip(before, seen[0], strict=True))
    assert not th.equal(model.policy.history.observations, before[0])


def test_nothing_of_an_invisible_other_reaches_the_agent():
    models = [make_model(env_kwargs=dict(invisible_seed=seed)).learn(4 * 42) for seed in (0, 1)]
    hidden = [model.env.envs[0].unwrapped.invisible.random(4).tolist() for model in models]
    assert hidden[0] != hidden[1]
    assert same_parameters(*models)
    for name in ("others_actions", "others_visible", "noise", "kept", "advantages", "log_probs"):
        first, second = (getattr(model.rollout_buffer, name) for model in models)
        assert np.array_equal(first, second), name
    for a, b in zip(models[0].policy.optimizer.state.values(), models[1].policy.optimizer.state.values(), strict=True):
        assert th.equal(a["exp_avg"], b["exp_avg"])


class Unplayed(AmongOthers):
    """What it shows in the steps in which the agent is out of play depends on ``garbage``, and nothing else does."""

    def __init__(self, garbage, **kwargs):
        super().__init__(inactive=3, **kwargs)
        self.garbage = garbage

    def step(self, action):
        played = (self.steps + 1) % 3 != 0
        obs, reward, terminated, truncated, info = super().step(action if played else 0)
        if (self.steps + 1) % 3 == 0:
            obs = np.full_like(obs, self.garbage)
        return obs, reward, terminated, truncated, info


@pytest.mark.parametrize("belief", ["dynamic", "none"])
def test_inactive_steps_train_nothing(belief):
    models = []
    for garbage in (-1.0, 1.0):
        env = make_vec_env(Unplayed, n_envs=2, seed=0, env_kwargs=dict(garbage=garbage))
        models.append(BeliefPPO("BeliefPolicy", env, belief=belief, **SMALL).learn(4 * 28))
    first, second = (model.rollout_buffer.observations for model in models)
    assert not np.array_equal(first, second)
    assert same_parameters(*models)
    rows = sum(len(samples.actions) for samples in models[0].rollout_buffer.get(16))
    assert rows == models[0].rollout_buffer.active.sum() < 28


def test_advantages_pass_through_inactive_steps():
    buffer = BeliefRolloutBuffer(4, spaces.Box(-1, 1, (1,)), spaces.Discrete(2), gamma=0.9, gae_lambda=0.8, n_envs=1)
    for step, (reward, value, active) in enumerate([(1, 5, True), (2, 100, False), (3, 100, False), (4, 7, True)]):
        buffer.stage(np.array([active]))
        estimate = th.tensor([float(value)])
        buffer.add(np.zeros((1, 1)), np.zeros((1, 1)), np.array([reward]), np.array([step == 0]), estimate, estimate)
    buffer.compute_returns_and_advantage(th.tensor([[10.0]]), np.array([False]))
    last = 4 + 0.9 * 10 - 7
    # Out of play, nothing is estimated: from the first step on it earns 1, 2, 3, and then what the last step is worth
    first = (1 + 0.9 * 2 + 0.9**2 * 3 + 0.9**3 * 7 - 5) + (0.9 * 0.8) ** 3 * last
    assert buffer.advantages[3, 0] == pytest.approx(last, rel=1e-5)
    assert buffer.advantages[0, 0] == pytest.approx(first, rel=1e-5)


def test_a_rollout_without_an_active_step_trains_nothing():
    model = make_model(env_kwargs=dict(inactive=1))
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    model.learn(2 * 42)
    assert all(th.equal(value, before[name]) for name, value in model.policy.state_dict().items())


# -- execution ---------------------------------------------------------------------------------------------------------


def test_deterministic_uses_the_mean_and_sampling_draws():
    model = make_model().learn(42)
    obs = np.repeat(model.observation_space.sample()[None], 64, axis=0)
    tensor = th.as_tensor(obs)
    model.predict(obs, deterministic=True)
    output = model.policy.features_extractor.output
    assert th.equal(output.latent, output.mean)
    model.predict(obs, deterministic=False)
    output = model.policy.features_extractor.output
    assert (output.latent - output.mean).std(dim=0).min() > 0
    values = [model.policy.predict_values(tensor) for _ in range(2)]
    assert th.equal(*values) and th.equal(model.policy.features_extractor.output.latent, output.mean)
    # The cached history is the same as the one encoded afresh
    assert th.allclose(values[0], model.policy.predict_values(tensor.clone().requires_grad_()), atol=1e-6)


def test_cached_history_follows_weights_and_history():
    model = make_model().learn(42)
    tensor = th.as_tensor(model.observation_space.sample()[None])

    def value():
        with th.no_grad():
            return model.policy.predict_values(tensor).item()

    seen = [value()]
    with th.no_grad():
        model.policy.belief.value.weight.mul_(2)
    seen.append(value())
    model.policy.remember(th.randn(5, 5), th.zeros(5, 7))
    seen.append(value())
    state = {name: tensor + 0.1 if "key" in name else tensor for name, tensor in model.policy.state_dict().items()}
    model.policy.load_state_dict(state)
    seen.append(value())
    assert len(set(seen)) == 4
    model.policy.belief.train()
    assert value() == pytest.approx(model.policy.predict_values(tensor).item(), abs=1e-6)  # encoded afresh under autograd


def test_saved_agent_acts_the_same_in_a_fresh_process(tmp_path):
    model = make_model(policy_kwargs=dict(embedding_dim=16, latent_dim=8)).learn(3 * 42)
    path = tmp_path / "agent.zip"
    model.save(path)
    obs = np.stack([model.observation_space.sample() for _ in range(20)])
    np.save(tmp_path / "obs.npy", obs)
    script = f"""
import numpy as np, torch as th
from sb3_belief.belief_ppo import BeliefPPO
model = BeliefPPO.load(r"{path}")
obs = np.load(r"{tmp_path / "obs.npy"}")
th.manual_seed(1)
sampled = model.predict(obs, deterministic=False)[0]
values = model.policy.predict_values(th.as_tensor(obs)).detach().numpy()
np.savez(r"{tmp_path / "out.npz"}", actions=model.predict(obs, deterministic=True)[0], sampled=sampled, values=values)
"""
    root = Path(__file__).parents[2]
    subprocess.run([sys.executable, "-c", script], check=True, cwd=root)
    out = np.load(tmp_path / "out.npz")
    th.manual_seed(1)
    np.testing.assert_array_equal(out["sampled"], model.predict(obs, deterministic=False)[0])
    np.testing.assert_array_equal(out["actions"], model.predict(obs, deterministic=True)[0])
    np.testing.assert_allclose(out["values"], model.policy.predict_values(th.as_tensor(obs)).detach().numpy(), atol=1e-6)


def test_load_goes_on_learning_with_its_history(tmp_path):
    model = make_model().learn(42)
    model.save(tmp_path / "agent")
    loaded = BeliefPPO.load(tmp_path / "agent", env=model.env)
    assert same_parameters(model, loaded)
    assert loaded.policy.history is not None and loaded.policy.history.valid.sum() == 40
    assert loaded.policy_kwargs == {} and loaded.rollout_buffer_class is None
    loaded.learn(42)
    model.policy.save(tmp_path / "policy")
    policy = BeliefActorCriticPolicy.load(tmp_path / "policy")
    obs = model.observation_space.sample()
    assert policy.predict(obs, deterministic=True)[0] == model.policy.predict(obs, deterministic=True)[0]
    assert policy.history is not None
    assert th.equal(policy.history.observations, model.policy.history.observations)


# -- spaces ------------------------------------------------------------------------------------------------------------

OTHERS: dict[str, dict[str, spaces.Space]] = {
    "one": {"b": spaces.Discrete(2)},
    "box": {"b": spaces.Box(-1, 1, (3,), np.float32), "c": spaces.Discrete(3)},
    "multi": {"b": spaces.MultiDiscrete([2, 3]), "c": spaces.MultiBinary(2)},
}


@pytest.mark.parametrize("others", OTHERS)
def test_learns_among_others_of_any_kind(others):
    model = make_model(env_kwargs=dict(others=OTHERS[others])).learn(2 * 42)
    layout = model.policy.layout
    assert layout.width == sum(spaces.flatdim(space) for space in OTHERS[others].values())
    measured = model.logger.name_to_value
    assert measured["belief/first_log_ratio"] < 1e-5 and np.isfinite(measured["belief/action_loss"])
    assert ("belief/accuracy" in measured) == bool(layout.blocks)


def test_image_and_dict_observations_and_continuous_actions():
    space = spaces.Dict(
        vector=spaces.Box(-1, 1, (3,), np.float32), kind=spaces.Discrete(4), image=spaces.Box(0, 255, (3, 36, 36), np.uint8)
    )
    env_kwargs = dict(observation_space=space, action_space=spaces.Box(-1, 1, (2,), np.float32), inactive=3)
    policy_kwargs = dict(features_extractor_class=CombinedExtractor)
    model = make_model(n_envs=2, env_kwargs=env_kwargs, policy_kwargs=policy_kwargs).learn(2 * 28)
    assert model.logger.name_to_value["belief/first_log_ratio"] < 1e-5
    history = model.policy.history
    assert history.observations.shape == (40, 3 + 4 + 3 * 36 * 36)
    # Preprocessed as the policy sees it: images in [0, 1], discrete values one-hot
    assert 0 <= history.observations[:, :-3].min() and history.observations[:, :-3].max() <= 1


def test_others_are_read_in_order_and_zeroed_where_not_visible():
    layout = action_layout({"b": spaces.Discrete(2), "c": spaces.MultiDiscrete([2, 2]), "d": spaces.Box(-5, 5, (1,))})
    assert layout.blocks == [(0, 0, 2), (1, 2, 2), (1, 4, 2)] and layout.owners == [0, 0, 1, 1, 1, 1, 2]
    row = np.array([0, 1, 1, 0, 0, 1, np.nan], dtype=np.float32)
    infos = [{"others_actions": row, "others_visible": np.array([False, True, False])}]
    actions, visible = read_others(infos, layout)
    assert actions.tolist() == [[0, 0, 1, 0, 0, 1, 0]] and visible.tolist() == [[False, True, False]]


# -- arguments ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "kwargs, message",
    [
        (dict(belief="psychic"), "'dynamic', 'context', 'variational', 'static', 'wide', 'none'"),
        (dict(history_length=0), "at least 1"),
        (dict(history_length=8.5), "integer"),
        (dict(keep_ratio=0.0), r"\(0, 1\]"),
        (dict(keep_ratio=1.5), r"\(0, 1\]"),
        (dict(action_coef=-1.0), "action_coef"),
        (dict(kl_coef=-1.0), "kl_coef"),
        (dict(policy_kwargs=dict(latent_dim=0)), "latent_dim"),
        (dict(policy_kwargs=dict(share_features_extractor=False)), "share"),
    ],
)
def test_nonsense_is_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make_model(**kwargs)


def test_foreign_policy_and_buffer_are_refused():
    from stable_baselines3.common.buffers import RolloutBuffer
    from stable_baselines3.common.policies import ActorCriticPolicy

    with pytest.raises(TypeError, match="BeliefRolloutBuffer"):
        make_model(rollout_buffer_class=RolloutBuffer)
    env = make_vec_env(AmongOthers, n_envs=1)
    with pytest.raises(TypeError, match="BeliefActorCriticPolicy"):
        BeliefPPO(ActorCriticPolicy, env, **SMALL)  # type: ignore[arg-type]


def test_another_set_of_others_is_refused(tmp_path):
    model = make_model().learn(42)
    foreign = make_vec_env(AmongOthers, n_envs=1, env_kwargs=dict(others={"b": spaces.Discrete(3)}))
    with pytest.raises(ValueError, match="in this order"):
        model.set_env(foreign)
    model.save(tmp_path / "agent")
    with pytest.raises(ValueError, match="in this order"):
        BeliefPPO.load(tmp_path / "agent", env=foreign)
    model.set_env(make_vec_env(AmongOthers, n_envs=3))
    model.learn(42)


def test_info_that_lacks_the_others_is_refused():
    class Silent(AmongOthers):
        def _info(self):
            return {}

    with pytest.raises(ValueError, match="lacks 'others_actions'"):
        BeliefPPO("BeliefPolicy", make_vec_env(Silent), **SMALL).learn(42)

    class Short(AmongOthers):
        def _info(self):
            return {**super()._info(), "others_actions": np.zeros(3)}

    with pytest.raises(ValueError, match=r"\(3,\).*\(7,\)"):
        BeliefPPO("BeliefPolicy", make_vec_env(Short), **SMALL).learn(42)


def test_many_agents_are_refused_with_the_ways_that_work():
    from mpe2 import simple_spread_v3

    for env in (simple_spread_v3.parallel_env(), simple_spread_v3.env()):
        with pytest.raises(TypeError, match=r"(?s)Team\(BeliefPPO.*fixed partners"):
            BeliefPPO("BeliefPolicy", env)
    with pytest.raises(TypeError, match=r"Team\(BeliefPPO"):
        make_model().set_env(simple_spread_v3.parallel_env())


@pytest.mark.parametrize(
    "kwargs",
    [
        dict(history_length=20),
        dict(keep_ratio=0.5),
        dict(action_coef=0.0),
        dict(kl_coef=0.1),
        dict(detach_belief=True),
        dict(policy_kwargs=dict(fusion_activation_fn=nn.Identity)),
        dict(policy_kwargs=dict(embedding_dim=16)),
        dict(policy_kwargs=dict(latent_dim=16)),
    ],
)
def test_every_argument_matters(kwargs):
    model, plain = make_model(**kwargs).learn(3 * 42), make_model().learn(3 * 42)
    differ = [
        name
        for name, value in model.policy.named_parameters()
        if value.shape != dict(plain.policy.named_parameters())[name].shape
        or not th.equal(value, dict(plain.policy.named_parameters())[name])
    ]
    assert "action_net.weight" in differ


def test_detached_belief_is_trained_by_its_own_loss_alone():
    detached = make_model(detach_belief=True, action_coef=0.0, kl_coef=0.0)
    attached = make_model(action_coef=0.0, kl_coef=0.0)
    for model, moves in ((detached, False), (attached, True)):
        before = model.policy.belief.encoder.weight.clone()
        model.learn(3 * 42)
        assert th.equal(before, model.policy.belief.encoder.weight) != moves


def test_diagnostics_measure_what_they_say():
    model = make_model(history_length=400, n_steps=100, batch_size=100, learning_rate=3e-3, n_epochs=10)
    model.learn(3 * 300)
    measured = {k.removeprefix("belief/"): v for k, v in model.logger.name_to_value.items() if k.startswith("belief/")}
    assert set(measured) == {
        *("action_loss", "kl", "accuracy", "base_rate", "history_gain"),
        *("attention_entropy", "fusion_ratio", "visible_fraction", "first_log_ratio"),
    }
    # The others act at random: 3 and 4 actions, seen six times out of ten, nothing to predict
    assert measured["visible_fraction"] == pytest.approx(0.6, abs=0.06)
    assert measured["base_rate"] == pytest.approx((1 / 3 + 1 / 4) / 2, abs=0.08)
    assert measured["accuracy"] <= measured["base_rate"] + 0.08
    assert abs(measured["history_gain"]) < 0.05
    assert 0 < measured["attention_entropy"] <= np.log(40) + 1e-5
    fusion = model.policy.mlp_extractor
    belief = sum(layer.weight[:, -64:].abs().sum() for layer in (fusion.fuse_pi, fusion.fuse_vf))
    every = sum(layer.weight.abs().sum() for layer in (fusion.fuse_pi, fusion.fuse_vf))
    assert fusion.belief_share() == pytest.approx((belief / every).item(), rel=1e-5)
