"""IAC is stock A2C with masks and without the steps in which the agent was not in play."""

import io
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.env_util import make_vec_env

from sb3_belief.baselines.iac import IAC, masked_logits
from sb3_belief.cli.main import main
from tests.belief_ppo.test_inactive_steps import Unplayed
from tests.belief_ppo.toy_envs import AmongOthers, MaskedAmongOthers
from tests.references.test_shared import masked_env
from tests.team.exact.test_exact import SaveOnce
from tests.team.helpers import Team, make_team_env, parameters
from tests.team.toy_envs import ToyEnv

SMALL: dict[str, Any] = dict(n_steps=14, seed=0, device="cpu", policy_kwargs=dict(net_arch=[16]), ent_coef=0.01)
SPACES = [spaces.Discrete(5), spaces.MultiDiscrete([3, 4]), spaces.MultiBinary(4)]


class Unmasked(gym.Env):
    """An environment without ``action_masks``, in which the agent is always in play."""

    def __init__(self, action_space):
        self._env = AmongOthers(action_space=action_space)
        self.observation_space, self.action_space = self._env.observation_space, action_space

    def reset(self, *, seed=None, options=None):
        return self._env.reset(seed=seed)

    def step(self, action):
        return self._env.step(action)


def make_env(env_class=AmongOthers, n_envs=3, **kwargs):
    return make_vec_env(env_class, n_envs=n_envs, seed=0, env_kwargs=kwargs)


@pytest.mark.parametrize("action_space", [*SPACES, spaces.Box(-1, 1, (2,))])
@pytest.mark.parametrize("normalize_advantage", [False, True])
def test_without_inactive_steps_and_masks_it_is_a2c(action_space, normalize_advantage):
    ours, stock = (
        algorithm(
            "MlpPolicy", make_env(Unmasked, action_space=action_space), normalize_advantage=normalize_advantage, **SMALL
        ).learn(5 * 42)
        for algorithm in (IAC, A2C)
    )
    assert len(list(stock.policy.parameters())) > 5
    assert all(th.equal(a, b) for a, b in zip(ours.policy.parameters(), stock.policy.parameters(), strict=True))


def test_in_a_team_it_is_a2c_too():
    teams = [Team(algorithm, "MlpPolicy", make_team_env(ToyEnv, n_envs=2, seed=0), **SMALL) for algorithm in (IAC, A2C)]
    for team in teams:
        team.learn(140)
    for agent, model in teams[0].agents.items():
        assert th.equal(parameters(model), parameters(teams[1].agents[agent]))


def test_inactive_steps_train_nothing():
    models = [IAC("MlpPolicy", make_env(Unplayed, 2, garbage=garbage), **SMALL).learn(3 * 28) for garbage in (-1.0, 1.0)]
    assert not np.array_equal(*(model.rollout_buffer.observations for model in models))  # type: ignore[arg-type]
    assert th.equal(*(parameters(model) for model in models))
    (samples,) = models[0].rollout_buffer.get()
    assert len(samples.actions) == models[0].rollout_buffer.active.sum() < 28


def test_a_rollout_without_an_active_step_trains_nothing():
    model = IAC("MlpPolicy", make_env(inactive=1), **SMALL)
    before = parameters(model)
    model.learn(42)
    assert th.equal(before, parameters(model))


# -- masks -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("action_space", SPACES)
def test_masks_hold_in_rollout_and_update(action_space):
    # The environment raises if an impossible action is taken
    model = IAC("MlpPolicy", make_env(MaskedAmongOthers, action_space=action_space), **SMALL).learn(5 * 42)
    buffer = model.rollout_buffer
    assert 0 < buffer.action_masks.mean() < 1
    # Those of the rollout are those of the update: the old log probability is that of the weights before it
    probe = IAC("MlpPolicy", make_env(MaskedAmongOthers, action_space=action_space), **{**SMALL, "learning_rate": 0.0})
    probe.learn(42)
    (samples,) = probe.rollout_buffer.get()
    actions = samples.actions.long().flatten() if isinstance(action_space, spaces.Discrete) else samples.actions
    _, log_prob, _ = probe.policy.evaluate_actions(samples.observations, actions)
    th.testing.assert_close(log_prob, samples.old_log_prob)
    unmasked = probe.policy.evaluate_actions(samples.observations.clone(), actions)[1]
    assert (log_prob - unmasked).abs().max() > 0.1


@pytest.mark.parametrize("action_space", SPACES)
def test_masks_hold_in_predict(action_space):
    model = IAC("MlpPolicy", make_env(MaskedAmongOthers, action_space=action_space), **SMALL)
    env = model.get_env()
    assert env is not None
    obs: Any = env.reset()
    for deterministic in (True, False) * 10:
        masks = np.stack(env.env_method("action_masks"))
        actions, _ = model.predict(obs, deterministic=deterministic, action_masks=masks)
        obs = env.step(actions)[0]
    single, _ = model.predict(obs[0], action_masks=env.env_method("action_masks")[0])
    assert np.shape(single) == action_space.shape
    assert model.policy._masks is None


def test_what_is_forbidden_has_no_probability_and_no_gradient():
    logits = th.zeros(1, 3, requires_grad=True)
    masks = th.tensor([[True, False, True]])
    probs = th.softmax(masked_logits(spaces.Discrete(3), logits, masks), dim=1)
    assert probs.tolist() == [[0.5, 0.0, 0.5]]
    (gradient,) = th.autograd.grad(probs[0, 0], logits)
    assert gradient[0, 1] == 0
    assert gradient[0, 0] == pytest.approx(0.25)
    # Each component of a MultiBinary has a flag for its zero and one for its one
    ones = th.tensor([[True, True, True, False, False, True]])
    assert th.sigmoid(masked_logits(spaces.MultiBinary(3), th.zeros(1, 3), ones)).tolist() == [[0.5, 0.0, 1.0]]


def test_changing_what_is_forbidden_changes_nothing():
    # Only the logit of the forbidden action differs: the same actions, the same update of everything else
    models = []
    for bias in (0.0, 7.0):

        class Never(AmongOthers):
            def action_masks(self):
                return np.array([True, True, False])

        model = IAC("MlpPolicy", make_env(Never), **SMALL)
        with th.no_grad():
            model.policy.state_dict()["action_net.bias"][2] = bias
        models.append(model.learn(3 * 42))
    own = [model.policy.state_dict() for model in models]
    for name in own[0]:
        pairs = (own[0][name], own[1][name])
        rows = slice(0, 2) if name.startswith("action_net") else slice(None)
        assert th.equal(pairs[0][rows], pairs[1][rows]), name
    assert set(models[0].rollout_buffer.actions.flatten()) == {0.0, 1.0}


# -- in a team ---------------------------------------------------------------------------------------------------------


def test_it_runs_beside_other_algorithms_and_is_loaded(tmp_path):
    env = make_team_env(masked_env, n_envs=2, seed=0)
    classes = {"agent_0": IAC, "agent_1": PPO}
    own = {"agent_0": dict(ent_coef=0.0), "agent_1": dict(batch_size=14)}
    kwargs = dict(n_steps=14, device="cpu", policy_kwargs=dict(net_arch=[16]))
    with pytest.warns(UserWarning, match="'agent_1'"):
        team = Team(classes, "MlpPolicy", env, seed=0, agent_kwargs=own, **kwargs).learn(56)
    assert team.takes_masks
    team.save(tmp_path / "team.zip")
    loaded = Team.load(tmp_path / "team.zip")
    obs = env.reset()
    masks = env.action_masks()
    expected, _ = team.predict(obs, deterministic=True, action_masks=masks)
    found, _ = loaded.predict(obs, deterministic=True, action_masks=masks)
    assert all(np.array_equal(found[agent], expected[agent]) for agent in expected)
    assert loaded.agents["agent_0"].learned_with_masks


def test_without_masks_it_asks_for_none(recwarn):
    team = Team(IAC, "MlpPolicy", make_team_env(ToyEnv, n_envs=2, seed=0), **SMALL).learn(28)
    team.predict(team.get_env().reset())
    assert not [warning for warning in recwarn if "mask" in str(warning.message)]


def test_resumed_it_goes_on_exactly():
    def make(env=masked_env):
        return make_team_env(env, n_envs=2, seed=0)

    whole, callback = Team(IAC, "MlpPolicy", make(), **SMALL), SaveOnce(at=56)
    whole.learn(140, callback=callback)
    resumed = Team.load(io.BytesIO(callback.saved), env=make(), exact=True)
    resumed.learn(140 - resumed.num_timesteps, callback=SaveOnce(), reset_num_timesteps=False)
    for agent, model in whole.agents.items():
        assert th.equal(parameters(model), parameters(resumed.agents[agent]))


@pytest.mark.parametrize("env_id", ["traffic-junction-easy", "mpe/simple_spread_v3"])
def test_train_py_trains_it_with_masks_and_without(tmp_path, env_id):
    words = ["--algo", "iac", "--env", env_id, "-f", str(tmp_path), "-n", "160", "--eval-freq", "80", "--eval-episodes", "2"]
    assert main(["train", *words, "--verbose", "0", "-params", "n_envs:2", "n_steps:20"]) == 0


# -- arguments ---------------------------------------------------------------------------------------------------------


def test_what_has_no_place_for_masks_is_refused():
    with pytest.raises(TypeError, match="must be derived from IACPolicy"):
        IAC(A2C.policy_aliases["MlpPolicy"], make_env())  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="derive it from IACRolloutBuffer"):
        IAC("MlpPolicy", make_env(), rollout_buffer_class=RolloutBuffer)
    with pytest.raises(TypeError, match="IAC trains one agent"):
        IAC("MlpPolicy", make_team_env(ToyEnv, seed=0))


def test_dict_observations():
    space = spaces.Dict({"a": spaces.Box(-1, 1, (3,), np.float32), "b": spaces.Discrete(4)})
    model = IAC("MultiInputPolicy", make_env(MaskedAmongOthers, observation_space=space, inactive=3), **SMALL).learn(84)
    (samples,) = model.rollout_buffer.get()
    assert len(samples.observations["a"]) == model.rollout_buffer.active.sum()
