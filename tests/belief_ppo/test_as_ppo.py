"""What Belief PPO shares with the PPO that it is made from."""

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import MaskablePPO
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnvWrapper

from sb3_belief.belief_ppo import BeliefPPO, MaskableBeliefPPO
from sb3_belief.belief_ppo.policies import BeliefPolicyMixin
from tests.belief_ppo.helpers import ROLLOUT, SMALL, VARIANTS, make_model
from tests.belief_ppo.toy_envs import AmongOthers, MaskedAmongOthers

OUR_ADAM = dict(optimizer_kwargs=dict(eps=1e-5, fused=True))


@pytest.fixture
def one_at_a_time(monkeypatch):
    """Bootstrap copy by copy, as SB3 does: in one pass (test_terminal_values.py) the last bits differ."""
    monkeypatch.setattr(BeliefPolicyMixin, "attach_terminal_values", lambda *args: None)


@pytest.mark.parametrize("belief", ["none", "dynamic"])
@pytest.mark.parametrize("env_id", ["CartPole-v1", "Pendulum-v1"])
def test_without_belief_or_others_it_is_ppo(belief, env_id):
    kwargs: dict[str, Any] = dict(n_steps=64, batch_size=32, n_epochs=3, seed=3, device="cpu")
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


MASKABLE: list[spaces.Space] = [spaces.Discrete(4), spaces.MultiDiscrete([3, 2]), spaces.MultiBinary(3)]


def of_stock_and_ours(env_kwargs, belief):
    """MaskablePPO and ours on the same environment, after three iterations."""
    envs = [make_vec_env(MaskedAmongOthers, n_envs=2, seed=0, env_kwargs=env_kwargs) for _ in range(2)]
    kwargs: dict[str, Any] = dict(n_steps=12, batch_size=8, n_epochs=3, seed=3, device="cpu")
    stock = MaskablePPO("MlpPolicy", envs[0], policy_kwargs=OUR_ADAM, **kwargs).learn(3 * 24)
    ours = MaskableBeliefPPO("BeliefPolicy", envs[1], belief=belief, **kwargs)
    before = [parameter.detach().clone() for parameter in ours.policy.parameters()]
    ours.learn(3 * 24)
    assert not any(th.equal(a, b) for a, b in zip(before, ours.policy.parameters(), strict=True))
    return dict(stock.policy.named_parameters()), dict(ours.policy.named_parameters())


@pytest.mark.parametrize("action_space", MASKABLE, ids=lambda space: type(space).__name__)
def test_maskable_without_belief_is_maskable_ppo(action_space, one_at_a_time):
    expected, found = of_stock_and_ours(dict(action_space=action_space), "none")
    assert expected.keys() == found.keys() and all(th.equal(value, found[name]) for name, value in expected.items())


def test_maskable_without_others_is_maskable_ppo(one_at_a_time):
    with pytest.warns(UserWarning, match="MaskableBeliefPPO is MaskablePPO here"):
        expected, found = of_stock_and_ours(dict(others={}), "dynamic")
    assert expected.keys() == found.keys() and all(th.equal(value, found[name]) for name, value in expected.items())


@pytest.mark.parametrize(
    "given, used",
    [
        (None, dict(eps=1e-5, fused=True)),
        (dict(eps=1e-3), dict(eps=1e-3, fused=True)),
        (dict(foreach=True), dict(foreach=True, fused=None)),
        (dict(fused=False), dict(fused=False)),
    ],
)
def test_adam_is_the_fused_one_unless_the_user_says_otherwise(given, used):
    model = make_model(policy_kwargs=dict(optimizer_kwargs=given))
    assert {key: model.policy.optimizer.defaults[key] for key in used} == used


class Solo(gym.Wrapper):
    """Hides that there are others at all."""

    def __getattr__(self, name: str) -> Any:
        if name == "others_action_spaces":
            raise AttributeError(name)
        return super().__getattribute__(name)

    def step(self, action: Any) -> Any:
        return *self.env.step(action)[:4], {}


@pytest.mark.parametrize("names_nobody", [True, False])
@pytest.mark.parametrize("belief", VARIANTS)
def test_every_variant_is_ppo_where_there_are_no_others(belief, names_nobody, one_at_a_time):
    def make_env():
        return make_vec_env(lambda: AmongOthers(others={}) if names_nobody else Solo(AmongOthers(others={})), n_envs=2, seed=0)

    with pytest.warns(UserWarning, match="names no other agents") as caught:
        ours = BeliefPPO("BeliefPolicy", make_env(), belief=belief, **SMALL).learn(2 * 28)
    assert len(caught) == 1
    stock = {k: v for k, v in SMALL.items() if k not in ("history_length", "keep_ratio")}
    ppo = PPO("MlpPolicy", make_env(), policy_kwargs=OUR_ADAM, **stock).learn(2 * 28)
    found = dict(ours.policy.named_parameters())
    assert all(th.equal(value, found[name]) for name, value in ppo.policy.named_parameters())
    assert ours.policy.belief is None and ours.policy.history is None
    assert not any(name.startswith("belief/") for name in ours.logger.name_to_value)


def test_none_leaves_the_belief_out_though_there_are_others():
    model = make_model(belief="none").learn(ROLLOUT)
    assert model.policy.belief is None and model.policy.history is None
    assert not any("belief" in name for name, _ in model.policy.named_parameters())


def test_the_belief_keeps_its_own_initialisation():
    policy = make_model().policy
    for name, value in policy.belief.named_parameters():
        if name.endswith("weight"):  # PyTorch's default is uniform within 1/sqrt(fan_in); SB3's orthogonal one is not
            assert value.abs().max() <= 1 / np.sqrt(value.shape[1]) + 1e-6, name
    assert th.allclose(policy.action_net.weight @ policy.action_net.weight.T, 0.01**2 * th.eye(3), atol=1e-6)


def test_variants_start_from_the_same_other_weights():
    # However many weights a belief has, those that SB3 draws after it are the same at the same seed
    # (The adaptive belief is wider where policy and value take it, so that other numbers are drawn there)
    policies = [make_model(belief=name).policy for name in VARIANTS if name != "adaptive"]
    others = [{name: p for name, p in policy.named_parameters() if ".belief." not in name} for policy in policies]
    assert len({sum(p.numel() for p in policy.parameters()) for policy in policies}) > 3
    for found in others[1:]:
        assert len(found) > 10 and all(th.equal(value, found[name]) for name, value in others[0].items())


@pytest.mark.parametrize("algorithm, stock", [(BeliefPPO, PPO), (MaskableBeliefPPO, MaskablePPO)])
def test_rollout_and_update_are_sb3s_own(algorithm, stock, monkeypatch):
    calls: list[str] = []

    def counted(base: Any, name: str) -> None:
        method = getattr(base, name)

        def call(*args: Any, **kwargs: Any) -> Any:
            calls.append(name)
            return method(*args, **kwargs)

        monkeypatch.setattr(base, name, call)

    counted(stock, "train")
    counted(stock, "collect_rollouts")
    make_model(algorithm=algorithm).learn(2 * ROLLOUT)
    assert calls == ["collect_rollouts", "train"] * 2
    ours = [base for base in algorithm.__mro__ if base.__module__.startswith("sb3_belief")]
    mixins = ["BeliefAlgorithmMixin", "SafeFilesMixin", "DetailsAlgorithmMixin", "ActiveStepsAlgorithmMixin"]
    assert [base.__name__ for base in ours] == [algorithm.__name__, *mixins]
    assert not {"train", "collect_rollouts"} & set(vars(algorithm))


# -- what SB3 takes, ours takes too ------------------------------------------------------------------------------------


def test_worker_processes_are_asked_for_others_without_harm():
    with pytest.warns(UserWarning, match="names no other agents"):
        env = make_vec_env("CartPole-v1", 2, vec_env_cls=SubprocVecEnv, vec_env_kwargs=dict(start_method="fork"))
        model = BeliefPPO("MlpPolicy", env, n_steps=8, batch_size=16)
    assert model.learn(16).num_timesteps == 16
    env.close()


class Terse(VecEnvWrapper):
    """Says nothing in its infos, not even one for each copy."""

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        obs, rewards, dones, _ = self.venv.step_wait()
        return obs, rewards, dones, []


def test_infos_may_be_missing_without_others():
    env = Terse(make_vec_env(AmongOthers, n_envs=2, seed=0, env_kwargs=dict(episode_length=1000)))
    model = BeliefPPO("MlpPolicy", env, belief="none", n_steps=8, batch_size=16)
    assert model.learn(16)._n_updates > 0 and model.rollout_buffer.active.all()


def test_rollouts_of_a_single_step_train_where_advantages_are_not_normalized():
    models = [make_model(n_envs=1, n_steps=1, batch_size=1, normalize_advantage=False, belief=b) for b in ("none", "dynamic")]
    for model in models:
        before = model.policy.action_net.weight.detach().clone()
        assert not th.equal(before, model.learn(3).policy.action_net.weight)


@pytest.mark.parametrize("algorithm", [BeliefPPO, MaskableBeliefPPO])
@pytest.mark.parametrize("policy, warned", [("BeliefPolicy", True), ("MlpPolicy", True), ("CnnPolicy", False)])
def test_a_gpu_is_advised_against_where_sb3_does(algorithm, policy, warned, recwarn):
    # No GPU is needed to be asked for one
    space = spaces.Box(0, 255, (3, 36, 36), np.uint8) if policy == "CnnPolicy" else None
    env = make_vec_env(MaskedAmongOthers, n_envs=1, seed=0, env_kwargs=dict(observation_space=space))
    model = algorithm(policy, env, **SMALL)
    model.device = th.device("meta")
    model._maybe_recommend_cpu()
    assert any("primarily intended to run on the CPU" in str(warning.message) for warning in recwarn) == warned
