"""MAPPO: the critic sees the global state, the actor does not, and an agent's file predicts from its own observation alone."""

import io
import json
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from torch import nn

from sb3_belief import AgentEnv
from sb3_belief.belief_ppo import BeliefActorCriticPolicy
from sb3_belief.cli.main import main
from sb3_belief.references.adapters import shared_with_state
from sb3_belief.references.mappo import CRITIC_ID, MAPPO, OWN, STATE, MaskableMAPPO
from sb3_belief.references.shared import MaskableSharedMAPPO, SharedMAPPO
from sb3_belief.references.with_state import AGENT_ID, WithAgentId, WithState, with_state
from sb3_belief.zoo.config import load_config
from sb3_belief.zoo.errors import ConfigError
from tests.references.test_shared import masked_env
from tests.team.exact.test_exact import SaveOnce
from tests.team.helpers import Team, make_team_env, parameters
from tests.team.toy_envs import MixedEnv, ScriptedEnv, ToyEnv

SMALL: dict[str, Any] = dict(n_steps=14, batch_size=28, n_epochs=2, seed=0, device="cpu", policy_kwargs=dict(net_arch=[16]))
LIKE_ITS_AUTHORS: dict[str, Any] = dict(value_norm=True, huber_delta=10.0, value_clip=0.2, vf_coef=1.0)


class Stateful(ToyEnv):
    """Its state is the step, times ``scale``: it depends on nothing that an agent sees or does."""

    def __init__(self, scale=1.0, n_agents=2):
        super().__init__(n_agents)
        self.scale = scale
        self.state_space = spaces.Box(-np.inf, np.inf, (1,), np.float32)

    def state(self):
        return np.array([self.scale * self.t], dtype=np.float32)


def make_team(env: Any = Stateful, algorithm: Any = MAPPO, adapter: Any = with_state, **kwargs: Any) -> Any:
    return Team(algorithm, "MultiInputPolicy", adapter(make_team_env(env, n_envs=2, seed=0)), **{**SMALL, **kwargs})


# -- what is shown -----------------------------------------------------------------------------------------------------


def test_the_state_stands_beside_the_agents_own_observation():
    env, twin = WithState(make_team_env(Stateful, n_envs=2, seed=0)), make_team_env(Stateful, n_envs=2, seed=0)
    obs: Any = env.reset()
    own: Any = twin.reset()
    for step in range(1, 9):
        for i, agent in enumerate(twin.possible_agents):
            assert np.array_equal(obs[agent][OWN], own[agent])
            assert obs[agent][STATE].tolist() == [[(step - 1) % 7]] * 2
            assert obs[agent][CRITIC_ID].tolist() == [np.eye(2)[i].tolist()] * 2
            assert env.observation_space[agent].contains({key: part[0] for key, part in obs[agent].items()})
        actions = {agent: np.full(2, step % 3) for agent in twin.possible_agents}
        obs, _, dones, infos = env.step(actions)
        own, _, _, own_infos = twin.step(actions)
        assert dones.all() == (step == 7)
        if step == 7:
            # The last state is that of the episode that has ended, not of the next one
            last: Any = infos[1]["terminal_observation"]["agent_1"]
            assert np.array_equal(last[OWN], own_infos[1]["terminal_observation"]["agent_1"])
            assert last[STATE].tolist() == [7.0]
            assert last[CRITIC_ID].tolist() == [0.0, 1.0]


def test_who_leaves_early_last_sees_the_present_state():
    env = WithState(make_team_env(ScriptedEnv, n_envs=1, seed=0))
    env.reset()
    for _ in range(6):
        _, _, dones, infos = env.step({agent: np.zeros(1, dtype=int) for agent in env.possible_agents})
    assert not dones[0]
    assert infos[0]["terminal_observation"]["cut"][STATE].tolist() == env.states()[0].tolist()


def test_without_a_state_of_its_own_it_is_all_observations():
    env = WithState(make_team_env(ToyEnv, n_envs=2, seed=0))
    obs: Any = env.reset()
    assert np.array_equal(obs["agent_1"][STATE], np.concatenate([obs["agent_0"][OWN], obs["agent_1"][OWN]], axis=1))


class Parts(ToyEnv):
    """Its observations are Dicts."""

    def observation_space(self, agent):
        return spaces.Dict({"place": spaces.Box(-np.inf, np.inf, (2,), np.float32), "step": spaces.Discrete(8)})

    def observations(self):
        return {agent: {"place": place.astype(np.float32), "step": self.t} for agent, place in self.positions.items()}


@pytest.mark.parametrize("algorithm, adapter", [(MAPPO, with_state), (SharedMAPPO, shared_with_state)])
def test_observations_that_are_dicts_keep_their_entries(algorithm, adapter):
    env = WithState(WithAgentId(make_team_env(Parts, n_envs=1, seed=0)))
    obs: Any = env.reset()
    assert obs["agent_1"].keys() == {"place", "step", AGENT_ID, STATE, CRITIC_ID}
    model = next(iter(make_team(Parts, algorithm, adapter).learn(28).agents.values()))
    # Two numbers of the place, eight of the step, and with shared weights two of the id
    assert model.policy.mlp_extractor.own_dim == 10 + 2 * (algorithm is SharedMAPPO)


def test_a_state_that_is_not_there_is_refused():
    with pytest.raises(ValueError, match=r"it has none \(PettingZoo's state\(\)\)"):
        with_state(make_team_env(ToyEnv, seed=0), state="env")
    with pytest.raises(ValueError, match="it must be one of 'env', 'any'"):
        with_state(make_team_env(ToyEnv, seed=0), state="mine")
    with_state(make_team_env(Stateful, seed=0), state="env")


# -- who sees what -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("algorithm, env", [(MAPPO, Stateful), (MaskableMAPPO, masked_env)])
def test_the_actor_does_not_see_the_state_and_the_critic_does(algorithm, env):
    policy = make_team(env, algorithm, policy_kwargs=dict(net_arch=[16], action_gain=1.0)).agents["agent_0"].policy
    obs = {key: th.as_tensor(np.stack([space.sample()] * 2)) for key, space in policy.observation_space.spaces.items()}
    obs[STATE] = th.tensor([[0.0] * obs[STATE].shape[1], [5.0] * obs[STATE].shape[1]])
    logits = policy.get_distribution(obs).distribution.logits
    assert th.equal(logits[0], logits[1])
    values = policy.predict_values(obs)
    assert abs(float(values[0] - values[1])) > 1e-3
    # And the gradient of the policy reaches nothing that reads it
    for key in (OWN, STATE, CRITIC_ID):
        obs[key] = obs[key].clone().requires_grad_()
    own, state, whose = th.autograd.grad(
        policy.get_distribution(obs).log_prob(th.zeros(2)).sum(), [obs[OWN], obs[STATE], obs[CRITIC_ID]], allow_unused=True
    )
    assert own.abs().max() > 0
    assert all(gradient is None or not gradient.any() for gradient in (state, whose))


def test_the_critic_knows_whose_value_it_is():
    policy = make_team().agents["agent_0"].policy
    obs = {OWN: th.zeros(2, 2), STATE: th.zeros(2, 1), CRITIC_ID: th.eye(2)}
    values = policy.predict_values(obs)
    assert abs(float(values[0] - values[1])) > 1e-4


def test_acting_depends_on_no_state_and_learning_does():
    # The same seeds: until the first update nothing differs, although the states do
    teams = [make_team(lambda scale=scale: Stateful(scale)) for scale in (0.0, 3.0)]
    for team in teams:
        team.learn(28)
    buffers = [team.agents["agent_0"].rollout_buffer for team in teams]
    assert np.array_equal(buffers[0].actions, buffers[1].actions)
    assert not np.array_equal(buffers[0].values, buffers[1].values)
    assert not th.equal(*(parameters(team.agents["agent_0"]) for team in teams))


def test_weights_are_each_agents_own():
    team = make_team().learn(28)
    one, other = (parameters(model) for model in team.agents.values())
    assert not th.equal(one, other)


# -- an agent alone ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("algorithm, env", [(MAPPO, Stateful), (MaskableMAPPO, masked_env)])
def test_it_predicts_from_its_own_observation(algorithm, env):
    team = make_team(env, algorithm).learn(28)
    model, obs = team.agents["agent_1"], team.get_env().reset()["agent_1"]
    masks = dict(action_masks=np.ones((2, 3), dtype=bool)) if algorithm is MaskableMAPPO else {}
    whole, _ = model.predict(obs, deterministic=True, **masks)
    bare, _ = model.predict(obs[OWN], deterministic=True, **masks)
    assert bare.tolist() == whole.tolist()
    single, _ = model.predict(obs[OWN][0], deterministic=True, **{key: mask[0] for key, mask in masks.items()})
    assert single.shape == ()
    assert single == whole[0]


def test_it_can_be_the_partner_of_another_learner(tmp_path):
    team = make_team(Stateful).learn(28)
    team.save(tmp_path / "team.zip")
    env = make_team_env(Stateful, n_envs=2, seed=0)
    learner = Team(PPO, "MlpPolicy", env, partners={"agent_1": str(tmp_path / "team.zip")}, **SMALL).learn(28)
    assert learner.possible_agents == ["agent_0"]
    agent_env = AgentEnv(Stateful, "agent_0", {"agent_1": team.agents["agent_1"]})
    agent_env.reset(seed=0)
    assert agent_env.step(0)[4]["others_actions"].sum() == 1


ALONE = """
import json, sys
import numpy as np
from sb3_belief.references.mappo import MAPPO
model = MAPPO.load(sys.argv[1])
obs = np.array(json.loads(sys.argv[2]), dtype=np.float32)
assert "pettingzoo" not in sys.modules and "sb3_belief.team" not in sys.modules
print(json.dumps(model.predict(obs, deterministic=True)[0].tolist()))
"""


@pytest.mark.parametrize("net_arch", [[], {"vf": [16]}, {"pi": [8], "vf": [16]}])
def test_actor_and_critic_have_layers_of_their_own(net_arch):
    team = make_team(policy_kwargs=dict(net_arch=net_arch)).learn(28)
    policy = team.agents["agent_0"].policy
    hidden = [layer.out_features for layer in policy.mlp_extractor.policy_net if isinstance(layer, th.nn.Linear)]
    assert hidden == ([8] if "pi" in net_arch else [])
    assert policy.action_net.in_features == (8 if hidden else policy.features_extractor.own_dim)


def test_its_zip_loads_alone_in_a_fresh_process(tmp_path):
    team = make_team(**LIKE_ITS_AUTHORS).learn(28)
    model = team.agents["agent_0"]
    model.save(tmp_path / "agent.zip")
    obs = np.random.default_rng(0).normal(size=(20, 2)).astype(np.float32)
    words = [sys.executable, "-c", ALONE, str(tmp_path / "agent.zip"), json.dumps(obs.tolist())]
    output = subprocess.run(words, check=True, capture_output=True, text=True).stdout
    assert json.loads(output) == model.predict(obs, deterministic=True)[0].tolist()


# -- as a team ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "algorithm, env, adapter",
    [
        (MAPPO, Stateful, with_state),
        (MaskableMAPPO, masked_env, with_state),
        (SharedMAPPO, Stateful, shared_with_state),
        (MaskableSharedMAPPO, masked_env, shared_with_state),
    ],
)
def test_it_is_saved_and_resumed_exactly(algorithm, env, adapter):
    def make():
        return adapter(make_team_env(env, n_envs=2, seed=0))

    whole, callback = make_team(env, algorithm, adapter, **LIKE_ITS_AUTHORS), SaveOnce(at=28)
    whole.learn(84, callback=callback)
    resumed = Team.load(io.BytesIO(callback.saved), env=make(), exact=True)
    resumed.learn(84 - resumed.num_timesteps, callback=SaveOnce(), reset_num_timesteps=False)
    for agent, model in whole.agents.items():
        assert th.equal(parameters(model), parameters(resumed.agents[agent]))
    obs = make().reset()
    assert whole.predict(obs, deterministic=True)[0].keys() == obs.keys()


@pytest.mark.parametrize("agent_id", [True, False])
def test_with_shared_weights_the_actor_may_know_who_it_is(agent_id):
    team = make_team(Stateful, SharedMAPPO, lambda env: shared_with_state(env, agent_id=agent_id))
    model = team.agents["team"]
    assert model.policy.mlp_extractor.own_dim == 2 + 2 * agent_id
    obs: Any = team.get_env().reset()["team"]
    whole, _ = model.predict(obs, deterministic=True)
    bare, _ = model.predict(obs[OWN], deterministic=True)
    assert whole.shape == (2, 2)
    assert bare.tolist() == whole.tolist()
    one, _ = model.predict(obs[OWN][0, 1], deterministic=True)
    assert one == whole[0, 1]


def test_layer_norms_are_as_wide_as_what_is_seen():
    team = make_team(policy_kwargs=dict(obs_layer_norm=True, net_arch=[16]), **LIKE_ITS_AUTHORS).learn(28)
    networks = team.agents["agent_0"].policy.mlp_extractor
    norms = [net[0] for net in (networks.policy_net, networks.value_net)]
    assert [(type(norm), norm.normalized_shape) for norm in norms] == [(nn.LayerNorm, (2,)), (nn.LayerNorm, (2 + 1 + 2,))]


def test_agents_with_unequal_spaces_have_critics_of_their_own():
    env = with_state(make_team_env(MixedEnv, n_envs=2, seed=0))
    Team(MAPPO, "MultiInputPolicy", env, **SMALL).learn(28)


@pytest.mark.parametrize("algo", ["mappo", "mappo_shared"])
def test_train_py_trains_evaluates_and_shows_it(tmp_path, capsys, algo):
    words = ["--algo", algo, "--env", "hidden-offset", "-f", str(tmp_path), "-n", "64", "--eval-freq", "32"]
    params = ["n_envs:4", "n_steps:8", "batch_size:16", "n_epochs:1", "adapter_kwargs.state:env"]
    assert main(["train", *words, "--eval-episodes", "2", "-params", *params]) == 0
    said = capsys.readouterr().out
    assert f"{algo} uses the global state in training" in said
    assert "(the environment has its own)" in said
    assert ("shares weights: not decentralised" in said) == (algo == "mappo_shared")
    run = tmp_path / algo / "hidden-offset_1"
    assert json.loads((run / "run.json").read_text())["state"] == "env"
    assert main(["train", "--resume", str(run), "--until", "96", "--verbose", "0"]) == 0
    assert main(["enjoy", str(run), "--episodes", "2"]) == 0
    assert "Episode 2" in capsys.readouterr().out


# -- arguments ---------------------------------------------------------------------------------------------------------


def test_without_the_state_it_is_refused():
    with pytest.raises(ValueError, match=r"with_state\(env\)"):
        Team(MAPPO, "MultiInputPolicy", make_team_env(ToyEnv, seed=0), **SMALL)
    with pytest.raises(ValueError, match="whose actor does not see the state"):
        Team(MAPPO, BeliefActorCriticPolicy, with_state(make_team_env(ToyEnv, seed=0)), **SMALL)
    with pytest.raises(ValueError, match="hold none: leave it 'none'"):
        make_team(belief="dynamic")


def test_beside_agents_that_see_less_it_is_refused():
    with pytest.raises(ConfigError, match="do not learn side by side"):
        load_config("mappo", "hidden-offset", params=["agent_kwargs:{agent_0: {algo: ippo}}"])
