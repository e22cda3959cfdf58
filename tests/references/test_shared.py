"""One model for all agents of a team: its rows are the agents' own, and a team takes it as one of its own."""

import io
import json
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecNormalize

from sb3_belief.belief_ppo import BeliefPPO
from sb3_belief.cli.main import main
from sb3_belief.references.adapters import (
    SharedVecEnv,
    StackedVecEnv,
    row_space,
    shared_weights,
    shared_with_state,
    stacked_space,
)
from sb3_belief.references.shared import MaskableSharedPPO, SharedMAPPO, SharedPPO
from sb3_belief.references.with_state import WithAgentId
from sb3_belief.vec_env.agent_vec_env import TransitionSplitter
from sb3_belief.zoo.config import load_config
from sb3_belief.zoo.errors import ConfigError
from tests.team.exact.test_exact import SaveOnce
from tests.team.helpers import PPO_KWARGS, Team, make_team_env, parameters
from tests.team.toy_envs import MixedEnv, ScriptedEnv, ToyEnv

PPO_ROWS = {**PPO_KWARGS, "belief": "none"}


def masked_env(n_agents=2):
    """Agents of which each may only do what its number of the step says."""

    class Masked(ToyEnv):
        def infos(self):
            masks = {}
            for i, agent in enumerate(self.agents):
                masks[agent] = np.zeros(3, dtype=bool)
                masks[agent][[i, (i + 1) % 3]] = True
            return {agent: {"action_mask": masks[agent]} for agent in self.agents}

    return Masked(n_agents)


@pytest.mark.parametrize("agent_id", [False, True])
def test_a_row_is_what_the_agents_own_environment_would_have_been(agent_id):
    env, twin = (make_team_env(ScriptedEnv, n_envs=3, seed=0) for _ in range(2))
    rows = SharedVecEnv(StackedVecEnv(WithAgentId(env) if agent_id else env))
    agents = twin.possible_agents
    splitter = TransitionSplitter(agents, dict(twin.action_space.spaces))
    n = len(agents)
    assert rows.num_envs == 3 * n
    first: Any = rows.reset()
    own_first = twin.reset()
    rng = np.random.default_rng(0)

    def check(row, agent, obs):
        assert row[:2].tolist() == obs.tolist()
        if agent_id:
            assert row[2:].tolist() == np.eye(n)[agent].tolist()

    for copy in range(3):
        for i, agent in enumerate(agents):
            check(first[copy * n + i], i, own_first[agent][copy])
    ends = 0
    for _ in range(20):
        actions = rng.integers(2, size=(3, n))
        obs, rewards, dones, infos = rows.step(actions.reshape(-1))
        taken = {agent: actions[:, i] for i, agent in enumerate(agents)}
        steps = splitter.split(taken, twin.step(taken))
        for copy in range(3):
            for i, (own_obs, own_rewards, own_dones, own_infos) in enumerate(steps):
                row = copy * n + i
                check(obs[row], i, own_obs[copy])  # type: ignore[index]
                assert (rewards[row], dones[row]) == (own_rewards[copy], own_dones[copy])
                mine, theirs = infos[row], own_infos[copy]
                assert mine["active"] == theirs["active"]
                assert mine.get("TimeLimit.truncated") == theirs.get("TimeLimit.truncated")
                if own_dones[copy]:
                    ends += 1
                    check(mine["terminal_observation"], i, theirs["terminal_observation"])
                if "episode" in theirs:
                    assert mine["episode"]["r"] == pytest.approx(theirs["episode"]["r"])
    assert ends > 3 * n


def test_with_one_agent_it_learns_as_the_agent_itself_would():
    kwargs = dict(seed=3, **PPO_ROWS)
    alone = Team(BeliefPPO, "BeliefPolicy", make_team_env(lambda: ToyEnv(1), n_envs=2, seed=0), **kwargs)
    shared_env = shared_weights(make_team_env(lambda: ToyEnv(1), n_envs=2, seed=0), agent_id=False)
    shared = Team(SharedPPO, "BeliefPolicy", shared_env, **kwargs)
    for team in (alone, shared):
        team.learn(40)
    assert shared.num_timesteps == alone.num_timesteps
    assert th.equal(parameters(shared.agents["team"]), parameters(alone.agents["agent_0"]))


def test_it_counts_joint_steps_as_a_team_does():
    team = Team(SharedPPO, "MlpPolicy", shared_weights(make_team_env(ToyEnv, n_envs=2, seed=0)), seed=0, **PPO_ROWS)
    team.learn(32)
    model = team.agents["team"]
    assert (team.num_timesteps, model.num_timesteps) == (32, 64)
    # A rollout of 8 steps of 2 copies has 32 rows of two agents
    assert model.rollout_buffer.observations.shape == (32, 4)


def test_all_agents_learn_from_all_agents_rows():
    # One weight vector: the gradient of a row is that of its own observation, whoever made it
    team = Team(SharedPPO, "MlpPolicy", shared_weights(make_team_env(ToyEnv, seed=0), False), seed=0, **PPO_ROWS)
    obs = np.array([[[0.3, -0.2], [0.3, -0.2]]], dtype=np.float32)
    actions, _ = team.agents["team"].predict(obs, deterministic=True)
    assert actions.shape == (1, 2)
    assert actions[0, 0] == actions[0, 1]
    one, _ = team.agents["team"].predict(obs[0, 0], deterministic=True)
    many, _ = team.agents["team"].predict(obs[0], deterministic=True)
    assert one == actions[0, 0]
    assert many.tolist() == actions[0].tolist()


def test_masks_hold_for_each_agent():
    env = shared_weights(make_team_env(masked_env, n_envs=2, seed=0))
    team = Team(MaskableSharedPPO, "BeliefPolicy", env, seed=0, **PPO_ROWS)
    team.learn(64)
    taken = team.agents["team"].rollout_buffer
    actions = taken.actions.reshape(-1)
    ids = taken.observations.reshape(-1, 4)[:, 2:].argmax(axis=1)
    assert set(actions[ids == 0]) == {0.0, 1.0}
    assert set(actions[ids == 1]) == {1.0, 2.0}
    obs = env.reset()
    for _ in range(10):
        actions, _ = team.predict(obs, action_masks=env.action_masks())
        assert np.isin(actions["team"][:, 0], (0, 1)).all()
        assert np.isin(actions["team"][:, 1], (1, 2)).all()
        obs, _, _, _ = env.step(actions)


def test_saved_and_loaded_it_predicts_the_same():
    team = Team(SharedPPO, "BeliefPolicy", shared_weights(make_team_env(ToyEnv, n_envs=2, seed=0)), seed=0, **PPO_ROWS)
    team.learn(32)
    file = io.BytesIO()
    team.save(file)
    env = shared_weights(make_team_env(ToyEnv, n_envs=2, seed=0))
    loaded, alone = (Team.load(io.BytesIO(file.getvalue()), env=each) for each in (env, None))
    obs = env.reset()
    expected, _ = team.predict(obs, deterministic=True)
    for other in (loaded, alone):
        assert other.predict(obs, deterministic=True)[0]["team"].tolist() == expected["team"].tolist()
    loaded.learn(32, reset_num_timesteps=False)
    assert (loaded.num_timesteps, loaded.agents["team"].num_timesteps) == (64, 128)


@pytest.mark.parametrize("normalize", [False, {"norm_reward": False}])
def test_resumed_it_goes_on_exactly(normalize):
    def make_env():
        return shared_weights(make_team_env(ToyEnv, n_envs=2, seed=0))

    whole, callback = Team(SharedPPO, "BeliefPolicy", make_env(), seed=0, normalize=normalize, **PPO_ROWS), SaveOnce(at=32)
    whole.learn(96, callback=callback)
    resumed = Team.load(io.BytesIO(callback.saved), env=make_env(), exact=True)
    resumed.learn(96 - resumed.num_timesteps, callback=SaveOnce(), reset_num_timesteps=False)
    assert th.equal(parameters(whole.agents["team"]), parameters(resumed.agents["team"]))


def test_normalised_last_observations_are_those_of_the_statistics():
    normalized = VecNormalize(StackedVecEnv(make_team_env(ToyEnv, n_envs=1, seed=0)), norm_reward=False)
    rows, twin = SharedVecEnv(normalized), make_team_env(ToyEnv, n_envs=1, seed=0)
    rows.reset()
    twin.reset()
    for _ in range(7):
        _, _, dones, infos = rows.step(np.zeros(2, dtype=int))
        _, _, _, their_infos = twin.step({agent: np.zeros(1, dtype=int) for agent in twin.possible_agents})
    assert dones.all()
    last = np.stack([info["terminal_observation"] for info in infos])
    # VecNormalize normalises what it returns before the last observation, with the same statistics
    own = np.stack(list(their_infos[0]["terminal_observation"].values()))
    expected: Any = normalized.normalize_obs(own)
    np.testing.assert_allclose(last, expected, rtol=1e-6)
    assert not np.allclose(last, own)


@pytest.mark.parametrize("adapter", [shared_weights, shared_with_state])
def test_normalised_agents_are_told_apart_and_alike_otherwise(adapter):
    """A statistic for each place would make zeros of whatever tells them apart."""
    env = adapter(make_team_env("permutation", n_envs=4, seed=0))
    algorithm, policy = (SharedPPO, "MlpPolicy") if adapter is shared_weights else (SharedMAPPO, "MultiInputPolicy")
    team = Team(algorithm, policy, env, seed=0, normalize={"norm_reward": False}, **PPO_KWARGS).learn(64)
    statistics: Any = team.agents["team"].get_vec_normalize_env()
    seen = statistics.normalize_obs(env.reset()["team"])
    for part in seen.values() if isinstance(seen, dict) else [seen]:
        assert part.shape[:2] == (4, 2) and np.isfinite(part).all()
    ids = seen["critic_id"] if isinstance(seen, dict) else seen[..., -2:]
    np.testing.assert_allclose(ids, np.tile([[1, -1], [-1, 1]], (4, 1, 1)), atol=0.05)
    # Statistics of all rows: 64 joint steps of two agents, and the first observations
    found = statistics.obs_rms["critic_id"] if isinstance(seen, dict) else statistics.obs_rms
    assert found.mean[-2:].tolist() == pytest.approx([0.5, 0.5], abs=1e-3) and found.mean.ndim == 1
    assert found.count == pytest.approx(2 * (64 + 4), abs=0.01)
    # As they are saved
    file = io.BytesIO()
    team.save(file)
    file.seek(0)
    loaded = Team.load(file, env=env)
    again = loaded.agents["team"].get_vec_normalize_env().normalize_obs(env.reset()["team"])
    for mine, theirs in zip(*(each.values() if isinstance(each, dict) else [each] for each in (seen, again)), strict=True):
        np.testing.assert_array_equal(mine, theirs)
    loaded.learn(64)


def test_normalised_rewards_are_refused():
    env = shared_weights(make_team_env(ToyEnv, seed=0))
    with pytest.raises(ValueError, match="norm_reward: false"):
        Team(SharedPPO, "BeliefPolicy", env, normalize=True, **PPO_ROWS)


def test_unequal_spaces_are_refused():
    with pytest.raises(ValueError, match=r"need equal spaces.*pad_observations"):
        shared_weights(make_team_env(MixedEnv, seed=0))


def test_an_environment_that_is_not_stacked_is_refused():
    with pytest.raises(ValueError, match=r"shared_weights\(env\)"):
        Team(SharedPPO, "BeliefPolicy", make_team_env(ToyEnv, seed=0), **PPO_ROWS)


def test_a_belief_is_refused():
    with pytest.raises(ValueError, match="leave it 'none'"):
        Team(SharedPPO, "BeliefPolicy", shared_weights(make_team_env(ToyEnv, seed=0)), **{**PPO_ROWS, "belief": "dynamic"})


@pytest.mark.parametrize(
    "space",
    [
        spaces.Discrete(4),
        spaces.MultiDiscrete([2, 3]),
        spaces.MultiBinary(3),
        spaces.Box(-1, 1, (2, 3), np.float32),
        spaces.Box(0, 255, (4, 4, 3), np.uint8),
        spaces.Dict({"a": spaces.Discrete(2), "b": spaces.Box(0, 1, (2,), np.float32)}),
    ],
)
def test_the_space_of_a_row_is_the_agents_own(space):
    assert row_space(stacked_space(space, 3)) == space


def test_train_py_trains_evaluates_resumes_and_shows_it(tmp_path, capsys):
    words = ["--algo", "ippo_shared", "--env", "traffic-junction-easy", "--seed", "1", "-f", str(tmp_path)]
    words += ["-n", "320", "--eval-freq", "160", "--eval-episodes", "2", "--save-freq", "160"]
    assert main(["train", *words, "-params", "n_envs:2", "n_steps:20", "batch_size:40", "n_epochs:1"]) == 0
    run = tmp_path / "ippo_shared" / "traffic-junction-easy_1"
    record = json.loads((run / "run.json").read_text())
    assert record["note"] == "shares weights: not decentralised"
    assert "ippo_shared shares weights: not decentralised" in capsys.readouterr().out
    with np.load(run / "evaluations.npz") as evaluations:
        assert evaluations["timesteps"].tolist() == [160, 320]
    assert main(["train", "--resume", str(run), "--until", "400"]) == 0
    assert json.loads((run / "run.json").read_text())["timesteps"] == 400
    assert main(["enjoy", str(run), "--episodes", "1", "--output", str(tmp_path / "a.gif")]) == 0
    assert "Episode 1" in capsys.readouterr().out


def test_only_central_learners_have_adapter_settings():
    with pytest.raises(ConfigError, match="what they see themselves"):
        load_config("ippo", "traffic-junction-easy", params=["adapter_kwargs:{agent_id: false}"])
    with pytest.raises(ConfigError, match="agent_ids"):
        load_config("ippo_shared", "traffic-junction-easy", params=["adapter_kwargs:{agent_ids: false}"])


def test_a_central_learner_has_no_agent_of_another_algorithm_beside_it():
    with pytest.raises(ConfigError, match="do not learn side by side"):
        load_config("ippo", "traffic-junction-easy", params=["agent_kwargs:{car_0: {algo: ippo_shared}}"])
