"""A team prints one table per iteration, and writes each agent's own values to files."""

import csv
from functools import partial

import numpy as np
import pytest
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger

from tests.team.helpers import PPO_KWARGS, Team, make_team_env
from tests.team.toy_envs import ScriptedEnv, ToyEnv


def rows(path):
    """Return the rows of a CSV file."""
    with open(path) as file:
        return list(csv.DictReader(file))


def test_one_table_per_iteration(capsys):
    team = Team(PPO, "MlpPolicy", make_team_env(ScriptedEnv, n_envs=2), seed=0, verbose=1, **PPO_KWARGS)
    team.learn(48)
    out = capsys.readouterr().out
    assert out.count("| time/ ") == 3 and out.count("total_timesteps") == 3
    for name in ("ep_rew_mean_std", "success_rate", "approx_kl_std", "explained_variance", "| rollout/"):
        assert out.count(f" {name.strip('| ')} ") == out.count(name) > 0
    assert "Using cpu device" not in out


def test_means_and_spread(tmp_path):
    team = Team(PPO, "MlpPolicy", make_team_env(ScriptedEnv, n_envs=2), seed=0, log_dir=str(tmp_path), **PPO_KWARGS)
    team.learn(48)
    table = rows(tmp_path / "progress.csv")
    own = {agent: rows(tmp_path / "agents" / agent / "progress.csv") for agent in team.possible_agents}
    assert len(table) == 3 and all(len(series) == 3 for series in own.values())
    for i, row in enumerate(table):
        assert float(row["time/total_timesteps"]) == 16 * (i + 1) and int(row["time/iterations"]) == i + 1
        returns = [float(series[i]["rollout/ep_rew_mean"]) for series in own.values()]
        # Agent k's return is the sum of 1 + 10 k + step / 100 over 8 steps, the team's is the mean over agents
        assert returns == pytest.approx([8 * (1 + 10 * k) + 0.36 for k in range(4)], rel=1e-5)
        assert float(row["rollout/ep_rew_mean"]) == pytest.approx(np.mean(returns))
        assert float(row["rollout/ep_rew_mean_std"]) == pytest.approx(np.std(returns))
        assert float(row["rollout/ep_len_mean"]) == 8
        # Of the episodes 1, 2 and 3 of both copies only the second succeeds
        assert float(row["rollout/success_rate"]) == pytest.approx([0, 1 / 2, 1 / 3][i])
        if i > 0:
            for key in ("train/approx_kl", "train/value_loss"):
                numbers = [float(series[i][key]) for series in own.values()]
                assert float(row[key]) == pytest.approx(np.mean(numbers))
            assert float(row["train/approx_kl_std"]) == pytest.approx(
                np.std([float(series[i]["train/approx_kl"]) for series in own.values()])
            )
            assert "train/value_loss_std" not in row


def test_belief_values_have_a_spread(tmp_path):
    def accuracy(model):
        return model.seed % 7 / 10

    class Believes(A2C):
        def train(self):
            super().train()
            self.logger.record("belief/accuracy", accuracy(self))
            self.logger.record("note", "a text")

    team = Team(Believes, "MlpPolicy", make_team_env(ToyEnv), seed=0, log_dir=str(tmp_path))
    team.learn(20)
    numbers = [accuracy(model) for model in team.agents.values()]
    assert numbers[0] != numbers[1]
    row = rows(tmp_path / "progress.csv")[-1]
    assert float(row["belief/accuracy"]) == pytest.approx(np.mean(numbers))
    assert float(row["belief/accuracy_std"]) == pytest.approx(np.std(numbers))
    assert "note" not in row and rows(tmp_path / "agents" / "agent_0" / "progress.csv")[-1]["note"] == "a text"


def test_agents_that_log_at_different_times(tmp_path):
    """A table is printed as soon as every agent that learns has logged something new."""
    own_kwargs = {"agent_0": {"n_steps": 8, "batch_size": 8}, "agent_1": {"learning_starts": 4, "train_freq": 1}}
    env = make_team_env(ToyEnv)
    team = Team({"agent_0": PPO, "agent_1": DQN}, "MlpPolicy", env, seed=0, agent_kwargs=own_kwargs, log_dir=str(tmp_path))
    team.learn(32)
    table = rows(tmp_path / "progress.csv")
    # PPO logs every 8 steps, DQN at the end of each episode of 7
    assert [float(row["time/total_timesteps"]) for row in table] == [8, 16, 24, 32]
    assert [row["rollout/exploration_rate"] != "" for row in table] == [True] * 4
    assert len(rows(tmp_path / "agents" / "agent_0" / "progress.csv")) == len(
        rows(tmp_path / "agents" / "agent_1" / "progress.csv")
    )


def test_off_policy_values_survive_episodes_that_end_together(tmp_path):
    kwargs = {"learning_starts": 2, "train_freq": 1, "policy_kwargs": {"net_arch": [8]}}
    env = make_team_env(ToyEnv, n_envs=4)
    team = Team(DQN, "MlpPolicy", env, seed=0, log_dir=str(tmp_path), **kwargs)
    # The four episodes of a step make four dumps, of which only the first holds what train() has recorded
    team.learn(84, log_interval=1)
    own = rows(tmp_path / "agents" / "agent_0" / "progress.csv")
    assert [row["train/loss"] != "" for row in own] == [True, False, False, False] * 3
    table = rows(tmp_path / "progress.csv")
    assert len(table) == 3
    other = rows(tmp_path / "agents" / "agent_1" / "progress.csv")
    for i, row in enumerate(table):
        assert float(row["train/loss"]) == pytest.approx(
            (float(own[4 * i]["train/loss"]) + float(other[4 * i]["train/loss"])) / 2
        )
        # The latest of what each dump holds
        assert float(row["rollout/ep_rew_mean"]) == pytest.approx(
            np.mean([float(series[4 * i + 3]["rollout/ep_rew_mean"]) for series in (own, other)])
        )


class LogsBelief(A2C):
    """Logs a value of which the team's table shows the spread, too."""

    def train(self):
        super().train()
        self.logger.record("belief/accuracy", 0.5)


def test_one_agent_has_no_spread(tmp_path):
    classes = {"agent_0": LogsBelief, "agent_1": A2C}
    Team(classes, "MlpPolicy", make_team_env(ToyEnv), seed=0, log_dir=str(tmp_path)).learn(10)
    row = rows(tmp_path / "progress.csv")[-1]
    assert float(row["belief/accuracy"]) == 0.5 and "belief/accuracy_std" not in row


def test_different_algorithms_are_not_averaged(tmp_path):
    classes = {"agent_0": PPO, "agent_1": A2C, "agent_2": PPO}
    own_kwargs = {agent: {"n_steps": 8, "batch_size": 8} for agent in ("agent_0", "agent_2")} | {"agent_1": {"n_steps": 8}}
    env = make_team_env(partial(ToyEnv, n_agents=3))
    Team(classes, "MlpPolicy", env, seed=0, agent_kwargs=own_kwargs, log_dir=str(tmp_path)).learn(24)
    row = rows(tmp_path / "progress.csv")[-1]
    own = {agent: rows(tmp_path / "agents" / agent / "progress.csv")[-1] for agent in classes}
    ppo = [float(own[agent]["train/value_loss"]) for agent in ("agent_0", "agent_2")]
    assert float(row["train/PPO/value_loss"]) == pytest.approx(np.mean(ppo))
    assert float(row["train/A2C/value_loss"]) == pytest.approx(float(own["agent_1"]["train/value_loss"]))
    kl = [float(own[agent]["train/approx_kl"]) for agent in ("agent_0", "agent_2")]
    assert float(row["train/PPO/approx_kl_std"]) == pytest.approx(np.std(kl), abs=1e-9)
    assert "train/value_loss" not in row and "rollout/ep_rew_mean" in row


def test_long_names_in_the_table(capsys):
    class AnAlgorithmWithANameOfMoreThanThirtySixLetters(A2C):
        pass

    classes = {"agent_0": AnAlgorithmWithANameOfMoreThanThirtySixLetters, "agent_1": A2C}
    Team(classes, "MlpPolicy", make_team_env(ToyEnv), seed=0, verbose=1).learn(10)
    assert "AnAlgorithmWithANameOfMoreThanThirtySixLetters/value_loss" in capsys.readouterr().out


def test_nothing_on_disk_without_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    team = Team(PPO, "MlpPolicy", make_team_env(ToyEnv), seed=0, **PPO_KWARGS)
    with pytest.raises(AttributeError, match="first learn"):
        _ = team.logger
    team.learn(16)
    assert list(tmp_path.iterdir()) == []


def test_tensorboard(tmp_path):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    for _ in range(2):
        team = Team(PPO, "MlpPolicy", make_team_env(ToyEnv), seed=0, tensorboard_log=str(tmp_path), **PPO_KWARGS)
        team.learn(16)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["Team_1", "Team_2"]
    for folder in ("Team_1", "Team_2/agents/agent_1"):
        events = EventAccumulator(str(tmp_path / folder)).Reload()
        assert [scalar.step for scalar in events.Scalars("rollout/ep_rew_mean")] == [8, 16]
    assert not list(tmp_path.glob("**/*.csv"))


def test_callbacks_log_to_the_team_and_own_loggers_stay():
    class Writer(KVWriter):
        def __init__(self):
            self.rows = []

        def write(self, key_values, key_excluded, step=0):
            self.rows.append(dict(key_values))

        def close(self):
            pass

    class Logs(BaseCallback):
        def _on_step(self):
            self.logger.record("mine/steps", self.n_calls)
            return True

    team_writer, agent_writer = Writer(), Writer()
    team = Team(PPO, "MlpPolicy", make_team_env(ToyEnv), seed=0, **PPO_KWARGS)
    team.set_logger(Logger(None, [team_writer]))
    team.agents["agent_0"].set_logger(Logger(None, [agent_writer]))
    team.learn(16, callback=Logs())
    assert [row["mine/steps"] for row in team_writer.rows] == [8, 16]
    assert len(agent_writer.rows) == 2 and "train/loss" in team_writer.rows[1]
