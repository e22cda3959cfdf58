"""Saving, loading and going on, as SB3's users do it."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecNormalize

from sb3_belief.belief_ppo import BeliefActorCriticPolicy, BeliefPPO, MaskableBeliefPPO
from tests.belief_ppo.helpers import ALGORITHMS, EVERY, ROLLOUT, SMALL, make_model, observations_of, same_parameters
from tests.belief_ppo.toy_envs import AmongOthers, MaskedAmongOthers


def same_history(a: Any, b: Any) -> bool:
    return all(th.equal(x, y) for x, y in zip(a.policy.history, b.policy.history, strict=True))


def assert_acts_the_same(a: Any, b: Any, **masks: Any) -> None:
    """Both models do and predict the same, sampled too."""
    obs = observations_of(a, 20)
    drawn = []
    for model in (a, b):
        th.manual_seed(1)
        drawn.append(model.predict(obs, deterministic=False, **masks)[0])
    np.testing.assert_array_equal(*drawn)
    np.testing.assert_array_equal(*(model.predict(obs, deterministic=True, **masks)[0] for model in (a, b)))


def test_saved_agent_acts_the_same_in_a_fresh_process(tmp_path):
    model = make_model(policy_kwargs=dict(embedding_dim=16, latent_dim=8)).learn(3 * ROLLOUT)
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
    model = make_model().learn(ROLLOUT)
    model.save(tmp_path / "agent")
    loaded = BeliefPPO.load(tmp_path / "agent", env=model.env)
    assert same_parameters(model, loaded)
    assert loaded.policy.history is not None and loaded.policy.history.valid.sum() == 40
    assert loaded.policy_kwargs == {} and loaded.rollout_buffer_class is None
    loaded.learn(ROLLOUT)
    model.policy.save(tmp_path / "policy")
    policy = BeliefActorCriticPolicy.load(tmp_path / "policy")
    obs = model.observation_space.sample()
    assert policy.predict(obs, deterministic=True)[0] == model.policy.predict(obs, deterministic=True)[0]
    assert policy.history is not None
    assert th.equal(policy.history.observations, model.policy.history.observations)


@pytest.mark.parametrize("algorithm, belief", EVERY)
def test_saved_and_loaded_it_is_the_same(tmp_path, belief, algorithm):
    model = make_model(algorithm=algorithm, belief=belief).learn(ROLLOUT)
    model.save(tmp_path / "agent")
    loaded = algorithm.load(tmp_path / "agent", device="cpu")
    assert loaded.env is None and same_parameters(model, loaded)
    assert_acts_the_same(model, loaded)
    loaded.set_env(model.get_env())
    loaded.learn(ROLLOUT)


ARGUMENTS: dict[str, Any] = dict(
    belief="variational",
    history_length=33,
    keep_ratio=0.25,
    action_loss="cross_entropy",
    policy_latent="mean",
    similarity="observation",
    detach_belief=True,
)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_all_arguments_are_saved(tmp_path, algorithm):
    widths: dict[str, Any] = dict(embedding_dim=12, latent_dim=10, net_arch=[16], fusion_activation_fn=th.nn.Tanh)
    schedules: dict[str, Any] = dict(action_coef=LinearSchedule(0.5, 0.1, 1.0), kl_coef=lambda remaining: 0.01 * remaining)
    model = make_model(algorithm=algorithm, policy_kwargs=widths, **ARGUMENTS, **schedules).learn(ROLLOUT)
    model.save(tmp_path / "agent")
    # A function without a name remains a pickle
    with pytest.raises(ValueError, match=r"agent: its entry 'kl_coef' is there as a pickle only .*trust_pickle=True"):
        algorithm.load(tmp_path / "agent", device="cpu")
    replaced: Any = algorithm.load(tmp_path / "agent", device="cpu", custom_objects={"kl_coef": 0.25})
    assert replaced.kl_coef(1.0) == 0.25 and replaced.action_coef(0.0) == pytest.approx(0.1)
    loaded = algorithm.load(tmp_path / "agent", env=model.get_env(), device="cpu", trust_pickle=True)
    for name, value in ARGUMENTS.items():
        assert getattr(loaded, name) == value == getattr(loaded.policy.options, name)
    assert loaded.policy_kwargs == widths and loaded.rollout_buffer_kwargs == {}
    for remaining in (1.0, 0.4, 0.0):
        assert loaded.action_coef(remaining) == pytest.approx(0.1 + 0.4 * remaining)
        assert loaded.kl_coef(remaining) == pytest.approx(0.01 * remaining)
    # Loaded once more, from what the loaded one saves
    loaded.learn(ROLLOUT).save(tmp_path / "again")
    assert same_parameters(loaded, algorithm.load(tmp_path / "again", device="cpu", trust_pickle=True))


def test_arguments_can_be_changed_when_loading(tmp_path):
    make_model().learn(ROLLOUT).save(tmp_path / "agent")
    loaded: Any = BeliefPPO.load(tmp_path / "agent", device="cpu", action_coef=0.125, learning_rate=1e-5)
    assert loaded.action_coef(0.5) == 0.125 and loaded.learning_rate == 1e-5
    assert loaded.policy.history.valid.all()


@pytest.mark.parametrize("algorithm, env_class", [(BeliefPPO, AmongOthers), (MaskableBeliefPPO, MaskedAmongOthers)])
@pytest.mark.parametrize("n_envs", [1, 5])
def test_loaded_with_another_number_of_environments_it_goes_on_learning(tmp_path, algorithm, env_class, n_envs):
    model = make_model(algorithm=algorithm).learn(ROLLOUT)
    model.save(tmp_path / "agent")
    loaded = algorithm.load(tmp_path / "agent", env=make_vec_env(env_class, n_envs=n_envs), device="cpu")
    assert same_history(model, loaded)
    loaded.learn(2 * 14 * n_envs, reset_num_timesteps=False)
    assert loaded.num_timesteps == ROLLOUT + 2 * 14 * n_envs
    assert loaded.rollout_buffer.noise.shape == (14 * n_envs, 64)
    assert loaded.logger.name_to_value["belief/first_log_ratio"] < 1e-5
    assert not same_history(model, loaded)


def test_parameters_hold_the_history():
    trained, fresh = make_model().learn(2 * ROLLOUT), make_model(seed=1)
    assert not fresh.policy.history.valid.any()
    fresh.set_parameters(trained.get_parameters())
    assert same_parameters(trained, fresh) and same_history(trained, fresh)
    assert_acts_the_same(trained, fresh)
    fresh.learn(ROLLOUT)
    assert not same_history(trained, fresh)


def test_the_vector_of_parameters_is_that_of_the_weights():
    trained, fresh = make_model().learn(2 * ROLLOUT), make_model(seed=1)
    fresh.policy.load_from_vector(trained.policy.parameters_to_vector())
    assert all(th.equal(a, b) for a, b in zip(trained.policy.parameters(), fresh.policy.parameters(), strict=True))


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("belief", ["dynamic", "static", "none"])
def test_policy_alone_is_saved_with_its_history(tmp_path, belief, algorithm):
    model = make_model(algorithm=algorithm, belief=belief, policy_kwargs=dict(latent_dim=7)).learn(2 * ROLLOUT)
    model.policy.save(tmp_path / "policy")
    policy = type(model.policy).load(tmp_path / "policy", device="cpu")
    found, expected = policy.state_dict(), model.policy.state_dict()
    assert found.keys() == expected.keys() and all(th.equal(value, found[name]) for name, value in expected.items())
    obs = observations_of(model, 20)
    np.testing.assert_array_equal(policy.predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0])
    if belief != "none":
        ours, theirs = policy.predict_others(obs), model.policy.predict_others(obs)
        np.testing.assert_array_equal(ours.actions["b"], theirs.actions["b"])
        np.testing.assert_array_equal(ours.rows, theirs.rows)


def test_set_env_goes_on_learning_from_what_it_remembers():
    model = make_model().learn(ROLLOUT)
    before = model.policy.history
    model.set_env(make_vec_env(AmongOthers, n_envs=3, seed=5))
    assert model.policy.history.observations is before.observations
    model.learn(ROLLOUT, reset_num_timesteps=False)
    assert model.logger.name_to_value["belief/first_log_ratio"] < 1e-5


def test_without_a_belief_an_agent_meets_whomever(tmp_path):
    model = make_model(belief="none").learn(ROLLOUT)
    others: dict[str, spaces.Space] = {"x": spaces.Box(-1, 1, (2,), np.float32)}
    model.set_env(make_vec_env(AmongOthers, n_envs=3, env_kwargs=dict(others=others)))
    model.learn(ROLLOUT)


def test_observations_normalised_for_one_agent(tmp_path):
    env = VecNormalize(make_vec_env(AmongOthers, n_envs=3, seed=0))
    model = BeliefPPO("BeliefPolicy", env, **SMALL).learn(3 * ROLLOUT)
    model.save(tmp_path / "agent")
    env.save(str(tmp_path / "statistics.pkl"))
    restored = VecNormalize.load(str(tmp_path / "statistics.pkl"), make_vec_env(AmongOthers, n_envs=3, seed=0))
    loaded = BeliefPPO.load(tmp_path / "agent", env=restored, device="cpu")
    assert same_history(model, loaded)
    raw = observations_of(model, 20)
    np.testing.assert_array_equal(env.normalize_obs(raw), restored.normalize_obs(raw))
    np.testing.assert_array_equal(
        model.predict(env.normalize_obs(raw), deterministic=True)[0],
        loaded.predict(restored.normalize_obs(raw), deterministic=True)[0],
    )
    loaded.learn(ROLLOUT)
    assert loaded.logger.name_to_value["belief/first_log_ratio"] < 1e-5


def test_the_history_moves_with_the_policy():
    policy = make_model().learn(ROLLOUT).policy
    assert {part.dtype for part in policy.history} == {th.float32, th.bool}
    policy.to(th.float64)
    assert {part.dtype for part in policy.history} == {th.float64, th.bool}
    policy.to("meta")
    assert {part.device.type for part in policy.history} == {"meta"}
