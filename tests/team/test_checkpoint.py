"""The file of a team, and the agents' SB3 zips within it."""

import io
import json
import subprocess
import sys
import tempfile
import zipfile
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from mpe2 import simple_spread_v3
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_belief import BeliefPPO
from sb3_belief.belief import filled_rows
from sb3_belief.team.fixed_partners.partners import load_model
from tests.archives import changed_json, rewrite
from tests.team.helpers import PPO_KWARGS, Team, make_team_env, parameters
from tests.team.toy_envs import MixedEnv, ToyEnv

ROOT = Path(__file__).parents[2]


def trained(n_envs=2, **kwargs):
    """Return a team of PPO agents after 32 timesteps."""
    team = Team(PPO, "MlpPolicy", make_team_env(ToyEnv, n_envs=n_envs), **{"seed": 0, **PPO_KWARGS, **kwargs})
    return team.learn(32)


def test_an_agents_zip_loads_alone_in_a_fresh_process(tmp_path):
    team = trained()
    team.save(tmp_path / "team.zip")
    with zipfile.ZipFile(tmp_path / "team.zip") as archive:
        archive.extract("agents/agent_1.zip", tmp_path)
    obs = np.random.default_rng(0).normal(size=(20, 2)).astype(np.float32)
    np.save(tmp_path / "obs.npy", obs)
    # The script imports nothing of this package
    script = """
import sys
import numpy as np
import torch as th
from stable_baselines3 import PPO
model = PPO.load("agents/agent_1.zip", device="cpu")
obs = np.load("obs.npy")
with th.no_grad():
    values = model.policy.predict_values(th.as_tensor(obs)).numpy()
np.savez("out.npz", actions=model.predict(obs, deterministic=True)[0], values=values)
assert not any(name.startswith("sb3_belief") for name in sys.modules)
"""
    subprocess.run([sys.executable, "-c", script], cwd=tmp_path, check=True)
    out = np.load(tmp_path / "out.npz")
    model = team.agents["agent_1"]
    assert np.array_equal(out["actions"], model.predict(obs, deterministic=True)[0])
    with th.no_grad():
        assert np.array_equal(out["values"], model.policy.predict_values(th.as_tensor(obs)).numpy())


@pytest.mark.parametrize("normalize", [False, {"clip_obs": 2.0}])
def test_round_trip(tmp_path, normalize):
    team = trained(normalize=normalize)
    team.save(tmp_path / "deep" / "er" / "team")
    obs = make_team_env(ToyEnv, n_envs=4, seed=8).reset()
    for path, env in (
        ("team", None),
        ("team.zip", make_team_env(ToyEnv, n_envs=2)),
        ("team", make_team_env(ToyEnv, n_envs=3)),
    ):
        loaded = Team.load(tmp_path / "deep" / "er" / path, env=env, device="cpu")
        assert loaded.num_timesteps == 32 and loaded.seed == 0 and loaded.normalize == normalize
        assert loaded.possible_agents == team.possible_agents and loaded.get_env() is env
        for agent, model in team.agents.items():
            assert th.equal(parameters(model), parameters(loaded.agents[agent]))
            assert np.array_equal(
                loaded.predict(obs, deterministic=True)[0][agent], team.predict(obs, deterministic=True)[0][agent]
            )
        if env is None:
            assert loaded.observation_space == team.observation_space
            with pytest.raises(ValueError, match="no environment to learn in"):
                loaded.learn(8)
            continue
        if normalize:
            mine, theirs = (t.agents["agent_0"].get_vec_normalize_env() for t in (loaded, team))
            assert np.array_equal(mine.obs_rms.mean, theirs.obs_rms.mean) and mine.clip_obs == 2.0 and mine.training
        before = parameters(loaded.agents["agent_1"])
        loaded.learn(24, reset_num_timesteps=False)
        assert loaded.num_timesteps >= 56 and not th.equal(before, parameters(loaded.agents["agent_1"]))


def test_an_agents_statistics_load_alone(tmp_path):
    env = make_team_env(simple_spread_v3.parallel_env, n_envs=2, seed=0)
    kwargs: dict[str, Any] = {"history_length": 40, **PPO_KWARGS}
    team = Team(BeliefPPO, "BeliefPolicy", env, seed=0, normalize=True, **kwargs).learn(64)
    team.save(tmp_path / "team.zip")
    with zipfile.ZipFile(tmp_path / "team.zip") as archive:
        archive.extractall(tmp_path)
    alone = BeliefPPO.load(tmp_path / "agents" / "agent_0.zip")
    own_env = DummyVecEnv([lambda: SoloEnv(alone.observation_space, alone.action_space)])
    statistics = VecNormalize.load(str(tmp_path / "agents" / "agent_0.vecnormalize.pkl"), own_env)
    obs = env.reset()
    expected, _ = team.predict(obs, deterministic=True)
    normalized = statistics.normalize_obs(obs["agent_0"])
    assert isinstance(normalized, np.ndarray) and not np.allclose(normalized, obs["agent_0"])
    assert alone.predict(normalized, deterministic=True)[0].tolist() == expected["agent_0"].tolist()
    # The history holds observations as the agent saw them
    assert alone.policy.history is not None
    rows = filled_rows(alone.policy.history).observations
    assert len(rows) == 40 and rows.abs().max() <= statistics.clip_obs and rows.std(dim=0).mean() > 0.3


class SoloEnv(gym.Env):
    """Gymnasium environment that has nothing but the spaces of one agent."""

    def __init__(self, observation_space, action_space):
        self.observation_space, self.action_space = observation_space, action_space


def test_open_files_and_classes():
    team = Team({"agent_0": A2C, "agent_1": DQN}, "MlpPolicy", make_team_env(ToyEnv), seed=0)
    file = io.BytesIO()
    team.save(file)
    file.seek(0)
    with zipfile.ZipFile(file) as archive:
        manifest = json.loads(archive.read("team.json"))
    assert manifest["format"] == 2 and manifest["agents"] == ["agent_0", "agent_1"]
    assert manifest["classes"] == {"agent_0": "stable_baselines3.a2c.a2c:A2C", "agent_1": "stable_baselines3.dqn.dqn:DQN"}
    assert manifest["versions"]["stable-baselines3"] and manifest["versions"]["sb3-belief"]
    loaded = Team.load(file, env=make_team_env(ToyEnv))
    assert [type(model) for model in loaded.agents.values()] == [A2C, DQN]
    loaded.learn(20)


def test_open_files_need_no_name_and_may_be_anywhere():
    with tempfile.TemporaryFile() as file:
        trained().save(file)
        # As it has been left by the save
        assert Team.load(file, device="cpu").num_timesteps == 32 and not file.closed
    with tempfile.TemporaryFile() as file:
        BeliefPPO("BeliefPolicy", gym.make("CartPole-v1"), belief="none", gamma=0.5, **PPO_KWARGS).save(file)
        assert BeliefPPO.load(file, device="cpu").gamma == 0.5 and not file.closed
        file.truncate(100)
        for load in (Team.load, BeliefPPO.load):
            with pytest.raises(ValueError, match=r"The open file wasn't a zip-file|The open file is not a saved team"):
                load(file)


def test_an_environment_that_does_not_fit(tmp_path):
    trained().save(tmp_path / "team")

    class Longer(ToyEnv):
        def action_space(self, agent):
            return type(super().action_space(agent))(4 if agent == "agent_1" else 3)

    with pytest.raises(ValueError, match=r"agent_1: action space saved as Discrete\(3\), environment has Discrete\(4\)\.$"):
        Team.load(tmp_path / "team", env=make_team_env(Longer))
    with pytest.raises(ValueError, match=r"has the agents \['agent_0', 'agent_1'\], the environment has \['zeta'"):
        Team.load(tmp_path / "team", env=make_team_env(MixedEnv))
    with pytest.raises(TypeError, match="make_team_env"):
        Team.load(tmp_path / "team", env=ToyEnv())


@pytest.mark.parametrize(
    "change, says",
    [
        ({"format": 99}, "team format 99; this version reads 2"),
        ({"agents": ["agent_0", "agent_1", "agent_9"]}, "entry 'classes' does not say what each of the agents has"),
        ({"agents": "agent_0"}, "entry 'agents' is not as it was written"),
        ({"seed": "x"}, "entry 'seed' is not as it was written"),
        (
            {"classes": {"agent_0": "no.such.module:Class", "agent_1": "os:path"}},
            "'agent_0' is a no.such.module:Class, but .* is of a package that is not allowed",
        ),
        (
            {"classes": {"agent_0": "sb3_belief.nowhere:Class", "agent_1": "os:path"}},
            "'agent_0' is a sb3_belief.nowhere:Class, but .* cannot be imported here",
        ),
        (
            {"classes": dict.fromkeys(("agent_0", "agent_1"), "torch.nn.modules.linear:Linear")},
            "is a torch.nn.modules.linear:Linear, which is not an SB3 algorithm",
        ),
    ],
)
def test_manifests_that_are_wrong(tmp_path, change, says):
    trained().save(tmp_path / "team.zip")
    rewrite(tmp_path / "team.zip", "team.json", changed_json(**change))
    with pytest.raises(ValueError, match=says):
        Team.load(tmp_path / "team.zip")


def test_files_that_are_no_team(tmp_path):
    team = trained()
    team.save(tmp_path / "team.zip")
    whole = (tmp_path / "team.zip").read_bytes()
    (tmp_path / "half.zip").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "text.zip").write_text("not a zip")
    team.agents["agent_0"].save(tmp_path / "model.zip")
    for name in ("half.zip", "text.zip"):
        with pytest.raises(ValueError, match="not a saved team, or it is damaged"):
            Team.load(tmp_path / name)
    with pytest.raises(ValueError, match="single SB3 model"):
        Team.load(tmp_path / "model.zip")
    # Cut off where the zip of an agent ends, which is a zip with something in front
    with zipfile.ZipFile(tmp_path / "team.zip") as archive:
        second = archive.getinfo("agents/agent_1.zip").header_offset
    (tmp_path / "cut.zip").write_bytes(whole[:second])
    for load in (Team.load, BeliefPPO.load, partial(load_model, agent="agent_0")):
        with pytest.raises(ValueError, match=r"damaged|in front of its members"):
            load(tmp_path / "cut.zip")
    with pytest.raises(FileNotFoundError):
        Team.load(tmp_path / "nothing")


def test_no_environment_in_the_file(tmp_path):
    """An agent's zip holds neither the environment, nor the loop of the team, nor a user's callback."""
    team = Team(PPO, "MlpPolicy", make_team_env(partial(ToyEnv, limit=3)), seed=0, **PPO_KWARGS)
    team.learn(8)
    team.save(tmp_path / "team")
    with zipfile.ZipFile(tmp_path / "team.zip") as archive:
        for agent in team.possible_agents:
            with zipfile.ZipFile(io.BytesIO(archive.read(f"agents/{agent}.zip"))) as model:
                data = model.read("data").decode()
            assert "sb3_belief" not in data and "greenlet" not in data
            assert "env" not in json.loads(data) and "_logger" not in json.loads(data)
