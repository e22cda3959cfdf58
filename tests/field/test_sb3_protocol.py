"""Arguments, attributes and methods of an SB3 model that users expect of a ``Team``."""

import os
import sys
import types
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback
from stable_baselines3.common.logger import HParam
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_belief import AgentEnv
from tests.team.helpers import PPO_KWARGS, Team, make_team_env, parameters
from tests.team.toy_envs import ToyEnv

DQN_KWARGS = {"learning_starts": 4, "buffer_size": 50, "policy_kwargs": {"net_arch": [8]}}


def make_team(**kwargs):
    return Team(PPO, "MlpPolicy", make_team_env(ToyEnv, n_envs=2), **{"seed": 0, **PPO_KWARGS, **kwargs})


def make_mixed():
    env = make_team_env(ToyEnv)
    own_kwargs = {"agent_0": PPO_KWARGS, "agent_1": {**DQN_KWARGS, "learning_rate": 1e-3}}
    return Team({"agent_0": PPO, "agent_1": DQN}, "MlpPolicy", env, seed=0, agent_kwargs=own_kwargs)


def test_what_agents_have_in_common_is_read_like_a_models():
    team = make_team(learning_rate=1e-3, gamma=0.9, clip_range=0.3)
    assert (team.learning_rate, team.gamma, team.n_steps, team.n_envs) == (1e-3, 0.9, 8, 2)
    assert (
        team.clip_range(1.0) == 0.3
        and team.device == th.device("cpu")
        and team.policy_class is team.agents["agent_0"].policy_class
    )
    assert team.env is team.get_env()
    # It is what the models have now, not what they began with
    for model in team.agents.values():
        vars(model)["gamma"] = 0.8
    assert team.gamma == 0.8


def test_what_they_have_not_in_common_says_where_it_is():
    team = make_mixed()
    assert team.gamma == 0.99
    with pytest.raises(AttributeError, match=r"no learning_rate in common \(\{'agent_0': 0.0003, 'agent_1': 0.001\}\)"):
        _ = team.learning_rate
    with pytest.raises(AttributeError, match=r"no n_steps in common.*team.agents\[name\].n_steps"):
        # That DQN has an attribute of the same name says nothing
        _ = team.n_steps
    for name in ("policy", "rollout_buffer", "lr_schedule", "train"):
        with pytest.raises(AttributeError, match=rf"its models have: read team.agents\['agent_0'\].{name}"):
            getattr(team, name)
    with pytest.raises(AttributeError, match=r"A team is seeded by Team\(\.\.\., seed=s\)"):
        team.set_random_seed(0)
    for name in ("no_such_thing", "_private"):
        with pytest.raises(AttributeError, match=f"'Team' object has no attribute '{name}'"):
            getattr(team, name)
    assert not hasattr(make_team(), "replay_buffer")


def test_what_is_set_on_the_team_is_not_lost_in_silence():
    team = make_team()
    team.learning_rate = 1e-5
    with pytest.raises(ValueError, match=r"team.learning_rate was set.*on each model of team.agents"):
        team.learn(16)


class HParamCallback(BaseCallback):
    """As in SB3's documentation."""

    def _on_training_start(self):
        model: Any = self.model
        hparam_dict = {"algorithm": type(model).__name__, "learning rate": model.learning_rate, "gamma": model.gamma}
        metric_dict = {"rollout/ep_len_mean": 0.0, "train/value_loss": 0.0}
        self.logger.record("hparams", HParam(hparam_dict, metric_dict), exclude=("stdout", "log", "json", "csv"))

    def _on_step(self):
        return True


def test_hparam_callback(tmp_path):
    pytest.importorskip("tensorboard")
    make_team(tensorboard_log=str(tmp_path)).learn(16, HParamCallback(), 1, "mine")
    (events,) = (tmp_path / "mine_1").glob("events*")
    assert b"_hparams_/session_start_info" in events.read_bytes() and b"learning rate" in events.read_bytes()


def test_the_runs_name(tmp_path):
    team = make_team(tensorboard_log=str(tmp_path)).learn(16, tb_log_name="mine")
    # The run continues; another name would be ignored, so it is refused
    team.learn(16).learn(16, tb_log_name="mine", reset_num_timesteps=False)
    with pytest.raises(ValueError, match="tb_log_name is 'other', but this team's run is 'mine'"):
        team.learn(16, tb_log_name="other")
    assert sorted(os.listdir(tmp_path)) == ["mine_1"] and os.listdir(tmp_path / "mine_1" / "agents")


def test_wandb_callback(monkeypatch):
    """What wandb's callback does with a model, without wandb."""

    wandb: Any = types.ModuleType("wandb")
    wandb.config = {}
    monkeypatch.setitem(sys.modules, "wandb", wandb)

    class WandbCallback(BaseCallback):
        def _init_callback(self):
            config = {"algo": type(self.model).__name__}
            for key in self.model.__dict__:
                value = self.model.__dict__[key]
                config[key] = value if type(value) in (float, int, str) else str(value)
            wandb.config.update(config)

        def _on_step(self):
            return True

        def _on_training_end(self):
            self.model.save("model.zip")

    callback = WandbCallback()
    monkeypatch.setattr(Team, "save", lambda self, path: wandb.config.update(saved=path))
    team = make_team(learning_rate=1e-3)
    team.learn(16, callback)
    assert wandb.config["algo"] == "Team" and wandb.config["learning_rate"] == 1e-3 and wandb.config["gamma"] == 0.99
    assert wandb.config["seed"] == 0 and wandb.config["saved"] == "model.zip"
    # Afterwards it is read from the models again, and nothing counts as set
    assert "gamma" not in vars(team)
    team.learn(16)


@pytest.mark.parametrize("kwargs, size", [({}, 100), ({"stats_window_size": 3}, 3)])
def test_stats_window_size(kwargs, size, tmp_path):
    team = make_team(**kwargs).learn(100)
    assert team._stats_window_size == size and len(team.ep_info_buffer) == min(size, 16)
    team.save(tmp_path / "team")
    assert Team.load(tmp_path / "team").ep_info_buffer.maxlen == size
    own = make_team(agent_kwargs={"agent_0": {"stats_window_size": 7}})
    assert own.ep_info_buffer.maxlen == 100 and own.agents["agent_0"]._stats_window_size == 7


def test_load_replaces_arguments(tmp_path, capsys):
    make_team().save(tmp_path / "team")
    env = make_team_env(ToyEnv, n_envs=2)
    own = {"agent_1": {"gamma": 0.5}}
    team = Team.load(tmp_path / "team", env=env, learning_rate=1e-5, agent_kwargs=own, print_system_info=True)
    assert team.learning_rate == 1e-5 and [model.gamma for model in team.agents.values()] == [0.99, 0.5]
    assert all(model.policy.optimizer.param_groups[0]["lr"] == 1e-5 for model in team.learn(32).agents.values())
    out = capsys.readouterr().out
    assert out.count("== CURRENT SYSTEM INFO ==") == out.count("== SAVED MODEL SYSTEM INFO ==") == 1
    replaced = Team.load(tmp_path / "team", custom_objects={"learning_rate": 0.5})
    assert replaced.learning_rate == 0.5
    seeded = Team.load(tmp_path / "team", env=env, seed=7)
    assert seeded.seed == 7
    fresh = Team(PPO, "MlpPolicy", env, seed=7, **PPO_KWARGS)
    assert [m.seed for m in seeded.agents.values()] == [m.seed for m in fresh.agents.values()]


@pytest.mark.parametrize("given", [{"learning_rte": 1}, {"agent_kwargs": {"agent_0": {"buffer_size": 5}}}, {"env_kwargs": {}}])
def test_load_refuses_unknown_arguments(tmp_path, given):
    make_team().save(tmp_path / "team")
    with pytest.raises(TypeError, match="PPO, the algorithm of 'agent_0', has no arguments"):
        Team.load(tmp_path / "team", **given)
    with pytest.raises(ValueError, match=r"agent_kwargs has entries for unknown agents \['agent_5'\]"):
        Team.load(tmp_path / "team", agent_kwargs={"agent_5": {}})


def test_parameters(tmp_path):
    team, other = make_team(), make_team(seed=1)
    other.set_parameters(team.get_parameters())
    assert all(th.equal(parameters(team.agents[agent]), parameters(model)) for agent, model in other.agents.items())
    third = make_team(seed=2)
    own = parameters(third.agents["agent_1"])
    third.set_parameters({"agent_0": team.get_parameters()["agent_0"]}, exact_match=False)
    assert th.equal(parameters(third.agents["agent_0"]), parameters(team.agents["agent_0"]))
    assert th.equal(parameters(third.agents["agent_1"]), own)
    with pytest.raises(ValueError, match=r"no parameters for \['agent_1'\]"):
        third.set_parameters({"agent_0": team.get_parameters()["agent_0"]})
    with pytest.raises(ValueError, match="unknown agents"):
        third.set_parameters(team.get_parameters()["agent_0"])
    team.save(tmp_path / "team")
    third.set_parameters(tmp_path / "team.zip")
    assert th.equal(parameters(third.agents["agent_1"]), parameters(team.agents["agent_1"]))


def test_replay_buffers_are_saved_with_checkpoints(tmp_path):
    env = make_team_env(ToyEnv, n_envs=2)
    team = Team(DQN, "MlpPolicy", env, seed=0, **DQN_KWARGS)
    team.learn(32, CheckpointCallback(8, str(tmp_path), save_replay_buffer=True))
    assert "rl_model_replay_buffer_32_steps.pkl" in os.listdir(tmp_path)
    loaded = Team.load(tmp_path / "rl_model_32_steps", env=env)
    assert all(buffer.pos == 0 for buffer in loaded.replay_buffer.values())
    loaded.load_replay_buffer(tmp_path / "rl_model_replay_buffer_32_steps.pkl")
    for agent, buffer in loaded.replay_buffer.items():
        # Callbacks run before the step at hand is stored, with SB3's own models too
        assert loaded.agents[agent].replay_buffer is buffer and buffer.pos == 15
        assert np.array_equal(buffer.observations[:15], team.agents[agent].replay_buffer.observations[:15])
    # Only off-policy agents have buffers
    mixed = make_mixed()
    mixed.learn(16, CheckpointCallback(8, str(tmp_path / "mixed"), save_replay_buffer=True))
    assert list(mixed.replay_buffer) == ["agent_1"]
    mixed.load_replay_buffer(tmp_path / "mixed" / "rl_model_replay_buffer_16_steps.pkl")
    with pytest.raises(ValueError, match=r"unknown agents \['agent_0'\]; the agents are \['agent_1'\]"):
        mixed.load_replay_buffer(tmp_path / "rl_model_replay_buffer_32_steps.pkl")
    team.agents["agent_0"].save_replay_buffer(tmp_path / "one")
    with pytest.raises(ValueError, match="holds a ReplayBuffer, not the replay buffers of a team"):
        team.load_replay_buffer(tmp_path / "one.pkl")


@pytest.mark.filterwarnings("ignore:Training and eval env are not of the same type")
def test_one_agent_is_evaluated_among_its_teammates(tmp_path):
    def evaluation(env):
        return EvalCallback(env, n_eval_episodes=2, eval_freq=8, log_path=str(tmp_path), verbose=0)

    runs = []
    for evaluates in (False, True):
        team = Team(A2C, "MlpPolicy", make_team_env(ToyEnv, n_envs=2), seed=0, n_steps=8)
        others = {"agent_1": team.agents["agent_1"]}
        env = DummyVecEnv([partial(AgentEnv, ToyEnv, "agent_0", others)])
        team.learn(48, agent_callbacks={"agent_0": evaluation(env)} if evaluates else None)
        runs.append(parameters(team.agents["agent_1"]))
    assert np.load(tmp_path / "evaluations.npz")["results"].shape == (3, 2)
    assert th.equal(*runs)
    with pytest.raises(ValueError, match=r"of 'agent_0'.*one agent is evaluated in an AgentEnv\(parallel_env, 'agent_0'"):
        team.learn(16, agent_callbacks={"agent_0": evaluation(make_team_env(ToyEnv))})


@pytest.mark.parametrize("steps", [float("inf"), float("nan"), -1, True, "64"])
def test_a_number_of_steps_that_never_ends_or_begins_is_refused(steps):
    team = make_team()
    with pytest.raises(ValueError, match=r"total_timesteps is .*; it must be a number of joint steps of at least 0"):
        team.learn(steps)
    assert team.num_timesteps == 0
