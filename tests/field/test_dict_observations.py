"""Agents that observe a ``Dict``, a ``Tuple`` or something nested, in a team and beside partners."""

from functools import partial
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import QRDQN, MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecMonitor

from sb3_belief import AgentEnv, BeliefPPO, MaskableBeliefPPO
from sb3_belief.envs import check_team_env, to_parallel
from tests.team.helpers import Team, make_team_env
from tests.team.toy_envs import ToyEnv

ON_POLICY: dict[str, Any] = {"n_steps": 8, "batch_size": 8, "n_epochs": 1, "device": "cpu"}
OFF_POLICY: dict[str, Any] = {"learning_starts": 8, "buffer_size": 100, "batch_size": 4, "device": "cpu"}

PLACE = spaces.Box(-np.inf, np.inf, (2,), np.float32)
SPACES: dict[str, spaces.Space] = {
    "agent_0": spaces.Dict({"place": PLACE, "clock": spaces.Discrete(20)}),
    "agent_1": spaces.Tuple([PLACE, spaces.MultiBinary(2)]),
    "agent_2": spaces.Dict({"self": spaces.Dict({"place": PLACE, "items": spaces.MultiDiscrete([3, 4])}), "v.x": PLACE}),
}


class Rich(ToyEnv):
    """
    A ``ToyEnv`` with an observation space of another kind for each agent.

    :param leaves: Whether ``agent_1`` terminates at step 3
    :param fault: What is wrong at step 2: ``"nan"``, ``"shape"`` or ``"missing"``
    """

    def __init__(self, leaves=True, fault=None):
        super().__init__(n_agents=3, limit=6)
        self.leaves, self.fault = leaves, fault

    def observation_space(self, agent):
        return SPACES[agent]

    def observations(self):
        places = {agent: position.astype(np.float32) for agent, position in self.positions.items()}
        seen: dict[str, Any] = {
            "agent_0": {"place": places["agent_0"], "clock": self.t},
            "agent_1": (places["agent_1"], np.array([1, self.t % 2], np.int8)),
            "agent_2": {"self": {"place": places["agent_2"], "items": np.array([2, 0])}, "v.x": places["agent_2"] / 2},
        }
        if self.fault and self.t == 2:
            seen["agent_0"]["place"] = {"nan": np.array([0, np.nan], np.float32), "shape": np.zeros(3, np.float32)}.get(
                self.fault
            )
            if self.fault == "missing":
                del seen["agent_0"]["place"]
        return {agent: seen[agent] for agent in self.agents}

    def step(self, actions):
        obs, rewards, terminations, truncations, infos = super().step(actions)
        if self.leaves and self.t == 3:
            terminations["agent_1"], self.agents = True, [agent for agent in self.agents if agent != "agent_1"]
        return obs, rewards, terminations, truncations, infos


def flat(obs):
    """Return all numbers of an observation, or of observations by agent, in a fixed order."""
    if isinstance(obs, dict):
        return np.concatenate([flat(obs[key]) for key in sorted(obs)])
    return np.ravel(obs).astype(float)


def test_what_becomes_of_the_spaces():
    space: Any = make_team_env(Rich).observation_space
    assert space["agent_0"] == SPACES["agent_0"]
    assert space["agent_1"] == spaces.Dict({"0": PLACE, "1": spaces.MultiBinary(2)})
    # PyTorch's modules cannot have names with dots
    assert set(space["agent_2"]) == {"self/place", "self/items", "v_x"}
    assert to_parallel(Rich()).observation_space("agent_1") == space["agent_1"]


def test_entries_that_would_have_one_name():
    class Twice(ToyEnv):
        def observation_space(self, agent):
            return spaces.Dict({"a/b": PLACE, "a": spaces.Dict({"b": PLACE})})

    with pytest.raises(ValueError, match=r"'agent_0' has several entries that would be called 'a/b'.*: rename one of them"):
        make_team_env(Twice)


@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
def test_observations_last_observations_and_zeros(vec_env):
    env = make_team_env(Rich, n_envs=2, seed=3, vec_env=vec_env)
    plain: Any = make_team_env(partial(ToyEnv, 3, 6), n_envs=2, seed=3)
    obs, places = env.reset(), plain.reset()
    for t in range(1, 9):
        np.testing.assert_array_equal(obs["agent_0"]["place"], places["agent_0"])
        np.testing.assert_array_equal(obs["agent_2"]["v_x"], places["agent_2"] / 2)
        actions = dict.fromkeys(env.possible_agents, np.ones(2, int))
        obs, _, dones, infos = env.step(actions)
        places, _, _, plain_infos = plain.step(actions)
        assert obs["agent_0"]["clock"].tolist() == [t % 6] * 2 and obs["agent_2"]["self/items"].shape == (2, 2)
        gone = 3 <= t < 6
        assert (flat(obs["agent_1"]) == 0).all() == gone
        for copy in range(2):
            last: Any = infos[copy].get("terminal_observation")
            plain_last: Any = plain_infos[copy].get("terminal_observation")
            assert (last is None) == (t not in (3, 6))
            if t == 3:
                assert list(last) == ["agent_1"] and last["agent_1"]["0"].shape == (2,)
                assert last["agent_1"]["1"].tolist() == [1, 1]
            elif t == 6:
                assert dones.all() and last["agent_0"]["clock"] == 6
                np.testing.assert_array_equal(last["agent_0"]["place"], plain_last["agent_0"])
                assert (flat(last["agent_1"]) == 0).all()
    env.close()


@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ("nan", r"entry 'place' of the observation of 'agent_0' in environment copy 0 at step 2 holds nan \(index 1\)"),
        ("shape", r"entry 'place' of the observation of 'agent_0' in environment copy 0 at step 2 has the shape \(3,\)"),
        ("missing", r"observation of 'agent_0' in environment copy 0 at step 2 has the entries \['clock'\], but"),
    ],
)
def test_faults_name_the_entry(fault, says, vec_env):
    env = make_team_env(partial(Rich, fault=fault), n_envs=2, vec_env=vec_env)
    env.reset()
    actions = dict.fromkeys(env.possible_agents, np.ones(2, int))
    env.step(actions)
    with pytest.raises(ValueError, match=says):
        env.step(actions)
    assert "observations" in {finding.topic for finding in check_team_env(partial(Rich, fault=fault), n_steps=20).failures}
    env.close()


def test_what_is_no_dict_at_all():
    class Flat(ToyEnv):
        def observation_space(self, agent):
            return spaces.Dict({"place": PLACE})

    with pytest.raises(ValueError, match=r"'agent_0' in environment copy 0 at reset has the type ndarray, but .* a Dict with"):
        make_team_env(Flat).reset()


def test_the_checker_agrees():
    assert check_team_env(Rich, n_steps=40).failures == []


ALGORITHMS: dict[str, tuple[Any, str, dict[str, Any]]] = {
    "PPO": (PPO, "MultiInputPolicy", ON_POLICY),
    "A2C": (A2C, "MultiInputPolicy", {"n_steps": 8, "device": "cpu"}),
    "DQN": (DQN, "MultiInputPolicy", OFF_POLICY),
    "QRDQN": (QRDQN, "MultiInputPolicy", OFF_POLICY),
    "BeliefPPO": (BeliefPPO, "BeliefPolicy", {**ON_POLICY, "history_length": 30}),
    "BeliefPPO-multi": (BeliefPPO, "MultiInputPolicy", {**ON_POLICY, "history_length": 30}),
}


@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_algorithm_learns_saves_and_plays(name, normalize, tmp_path):
    algorithm, policy, kwargs = ALGORITHMS[name]
    env: Any = make_team_env(Rich, n_envs=2, seed=0)
    team = Team(algorithm, policy, VecMonitor(env), seed=0, normalize=normalize, **kwargs).learn(48)
    assert np.isfinite(evaluate_policy(team, env, 3)[0])
    team.save(tmp_path / "team.zip")
    obs, actions = env.reset(), []
    for loaded in (team, Team.load(tmp_path / "team.zip"), Team.load(tmp_path / "team.zip", env=env)):
        actions.append(loaded.predict(obs, deterministic=True)[0])
        for agent in env.possible_agents:
            np.testing.assert_array_equal(actions[-1][agent], actions[0][agent])
    loaded.learn(16)
    # A single observation, as the environment itself returns it
    single = {agent: {key: part[0] for key, part in seen.items()} for agent, seen in obs.items()}
    assert {agent: np.shape(action) for agent, action in team.predict(single)[0].items()} == dict.fromkeys(obs, ())


class MaskedRich(Rich):
    """A ``Rich`` that forbids action 0."""

    def infos(self):
        return {agent: {"action_mask": np.array([0, 1, 1])} for agent in self.agents}

    def step(self, actions):
        assert all(actions.values())
        return super().step(actions)


@pytest.mark.parametrize(("algorithm", "policy"), [(MaskablePPO, "MultiInputPolicy"), (MaskableBeliefPPO, "BeliefPolicy")])
def test_with_masks(algorithm, policy):
    Team(algorithm, policy, make_team_env(partial(MaskedRich, leaves=False), n_envs=2), seed=0, **ON_POLICY).learn(32)


def test_the_same_is_learned_in_any_number_of_processes():
    kinds = [PPO, BeliefPPO, BeliefPPO]
    policies = ["MultiInputPolicy", "BeliefPolicy", "BeliefPolicy"]
    names = list(SPACES)
    weights = []
    for jobs, vec_env in ((1, "dummy"), (2, "dummy"), (1, "subproc")):
        env = make_team_env(Rich, n_envs=2, vec_env=vec_env)
        pairs = dict(zip(names, kinds, strict=True)), dict(zip(names, policies, strict=True))
        team = Team(*pairs, env, seed=1, normalize=True, jobs=jobs, **ON_POLICY).learn(64)
        weights.append([th.nn.utils.parameters_to_vector(model.policy.parameters()) for model in team.agents.values()])
        env.close()
    for other in weights[1:]:
        assert all(th.equal(a, b) for a, b in zip(weights[0], other, strict=True))


def test_values_at_a_limit_come_from_the_last_observation():
    env = make_team_env(Rich, n_envs=2)
    team = Team(DQN, "MultiInputPolicy", env, seed=0, **OFF_POLICY).learn(24)
    buffer = team.agents["agent_0"].replay_buffer
    ends = buffer.dones[: buffer.pos].astype(bool)
    assert ends.sum() == 4 and set(buffer.next_observations["clock"][: buffer.pos][ends].ravel().tolist()) == {6}
    assert buffer.timeouts[: buffer.pos][ends].all()


def test_statistics_are_those_of_the_entries_with_numbers():
    env = make_team_env(Rich, n_envs=2)
    team = Team(PPO, "MultiInputPolicy", env, normalize={"norm_obs_keys": ["place", "v_x"]}, **ON_POLICY).learn(16)
    found = {agent: model.get_vec_normalize_env() for agent, model in team.agents.items()}
    assert [found[agent].norm_obs for agent in SPACES] == [True, False, True]
    assert found["agent_0"].norm_obs_keys == ["place"] and found["agent_2"].norm_obs_keys == ["v_x"]
    env = make_team_env(Rich, n_envs=2)
    team = Team(PPO, "MultiInputPolicy", env, normalize=True, **ON_POLICY).learn(16)
    assert set(team.agents["agent_2"].get_vec_normalize_env().norm_obs_keys) == {"self/place", "v_x"}


class Pictures(ToyEnv):
    """A ``ToyEnv`` with a picture, its channels last, beside each place."""

    def observation_space(self, agent):
        return spaces.Dict({"place": PLACE, "picture": spaces.Box(0, 255, (36, 36, 3), np.uint8)})

    def observations(self):
        picture = np.full((36, 36, 3), 20 * self.t, np.uint8)
        return {agent: {"place": seen, "picture": picture} for agent, seen in super().observations().items()}


@pytest.mark.parametrize("parallel_env", [Rich, Pictures])
def test_beside_partners_that_observe_dicts(parallel_env, tmp_path):
    env = make_team_env(parallel_env, n_envs=2)
    team = Team(BeliefPPO, "BeliefPolicy", env, seed=0, normalize=True, history_length=20, **ON_POLICY).learn(16)
    team.save(tmp_path / "team.zip")
    names = env.possible_agents
    for partners in (str(tmp_path / "team.zip"), {name: team.agents[name] for name in names[1:]}):
        alone = AgentEnv(parallel_env, names[0], partners)
        obs, _ = alone.reset(seed=0)
        assert alone.observation_space.contains(obs)
        while True:
            obs, _, terminated, truncated, _ = alone.step(1)
            assert alone.observation_space.contains(obs)
            if terminated or truncated:
                break
        model = BeliefPPO("BeliefPolicy", alone, history_length=20, **ON_POLICY).learn(16)
        assert model.policy.predict_others(obs).mean.shape


def test_a_partner_without_a_model_gets_the_dict():
    def partner(obs):
        assert obs.keys() == {"0", "1"} and obs["0"].shape == (2,)
        return 1

    env = AgentEnv(Rich, "agent_0", {"agent_1": partner, "agent_2": lambda obs: int("v_x" in obs)})
    env.reset()
    env.step(0)


def test_with_a_recurrent_state():
    # Not in Rich: with a MultiDiscrete entry, sb3-contrib makes no such model in single-agent use either
    env = make_team_env(Pictures, n_envs=2)
    team = Team(RecurrentPPO, "MultiInputLstmPolicy", env, seed=0, normalize=True, **ON_POLICY).learn(16)
    assert np.isfinite(evaluate_policy(team, env, 2)[0])


def test_a_team_of_pictures_that_was_loaded_without_an_environment_can_be_saved_again(tmp_path):
    env = make_team_env(Pictures)
    Team(PPO, "MultiInputPolicy", env, **ON_POLICY).save(tmp_path / "a.zip")
    Team.load(tmp_path / "a.zip").save(tmp_path / "b.zip")
    Team.load(tmp_path / "b.zip", env=env).learn(8)
