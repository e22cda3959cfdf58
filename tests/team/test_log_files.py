"""The logs of a run that is continued are those of a run that was never interrupted."""

import csv
import json
import os
import time

import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import Video

from sb3_belief.team.log_files import CSVLog, counters, open_logger, put_counters_back
from sb3_belief.team.logs import TeamLog
from tests.common.crashes import check_old_or_new, recorded
from tests.team.helpers import PPO_KWARGS, Team, make_team_env
from tests.team.toy_envs import ToyEnv


def write(log, step, **values):
    log.write(values, {key: None for key in values}, step)


def table(path):
    with open(path) as file:
        return list(csv.DictReader(file))


def test_a_continued_table_drops_later_rows_and_columns(tmp_path):
    path = str(tmp_path / "progress.csv")
    log = CSVLog(path)
    write(log, 1, a=1, b=0.5)
    state = json.loads(json.dumps(log.state()))
    before = open(path).read()
    write(log, 2, a=2, c=3)
    write(log, 3, a=4, d=5)
    # Killed here: nothing is closed
    again = CSVLog(path, state)
    assert open(path).read() == before and sorted(again.keys) == ["a", "b"]
    write(again, 2, a=2, c=3)
    write(again, 3, a=4)
    assert table(path) == [
        {"a": "1", "b": "0.5", "c": ""},
        {"a": "2", "b": "", "c": "3"},
        {"a": "4", "b": "", "c": ""},
    ]
    assert again.state()["size"] == os.path.getsize(path)


def test_a_table_that_is_gone_begins_anew(tmp_path):
    path = str(tmp_path / "progress.csv")
    log = CSVLog(path, {"keys": ["a"], "size": 10})
    write(log, 1, b=1)
    assert table(path) == [{"b": "1"}]


def test_a_crash_while_columns_are_added_leaves_the_old_or_the_new_table(tmp_path, monkeypatch):
    path = tmp_path / "progress.csv"
    log = CSVLog(str(path))
    for i in range(3_000):
        write(log, i, a=i, b=i)
    log.close()
    old = path.read_bytes()
    log = CSVLog(str(path), {"keys": log.keys, "size": len(old)})
    with recorded(tmp_path, monkeypatch) as disk:
        write(log, 1, c=1)
    assert len(old) > 20_000 and len(table(path)) == 3_001
    check_old_or_new(disk, "progress.csv", old, path.read_bytes())


def test_a_full_disk_while_columns_are_added_leaves_the_table(tmp_path, monkeypatch):
    path = str(tmp_path / "progress.csv")
    log = CSVLog(path)
    write(log, 1, a=1)
    with monkeypatch.context() as patched:

        def full(_):
            raise OSError(28, "No space left on device")

        patched.setattr(os, "fsync", full)
        with pytest.raises(OSError, match="No space"):
            write(log, 2, a=2, b=2)
    write(log, 3, a=3)
    write(log, 4, b=4)
    assert table(path) == [{"a": "1", "b": ""}, {"a": "3", "b": ""}, {"a": "", "b": "4"}]


def test_values_that_wait_are_written_by_the_continued_logger(tmp_path):
    def record(logger):
        logger.record("single", np.float32(0.1))
        logger.record("text", "x", exclude="csv")
        logger.record("array", np.arange(3))
        logger.record_mean("mean", 1.0)
        logger.record_mean("mean", 2.0)

    def finish(logger):
        logger.record_mean("mean", 6.0)
        logger.dump(1)
        return table(os.path.join(logger.dir, "progress.csv"))

    logger, again = (open_logger(str(tmp_path / name), None, None, None) for name in ("first", "again"))
    record(logger)
    again.record("stale", 1)
    put_counters_back(again, counters(logger))
    assert again.name_to_excluded["text"] == ("csv",)
    (row,) = finish(logger)
    assert finish(again) == [row]
    assert row["single"] == "0.1" and row["mean"] == "3.0" and "text" not in row and "stale" not in row


def test_what_a_checkpoint_cannot_hold_of_a_log_is_said(tmp_path):
    logger = open_logger(None, None, None, None)
    logger.record("film", Video(np.zeros(1), 1))  # type: ignore[arg-type]
    logger.record("a", 1)
    with pytest.warns(UserWarning, match="logged as 'film' is a Video, which a checkpoint does not hold"):
        saved = counters(logger)
    assert saved["values"] == {"a": 1} and list(saved["excluded"]) == ["a"]


def test_the_log_of_a_team_goes_on(tmp_path):
    """Two iterations, a state, one more that is lost, and the same again: as three iterations without a break."""
    env = make_team_env(ToyEnv, n_envs=2)
    team = Team(PPO, "MlpPolicy", env, seed=0, log_dir=str(tmp_path), tensorboard_log=str(tmp_path / "tb"), **PPO_KWARGS)
    team.learn(32, tb_log_name="tries")
    state = team._log.state(team.num_timesteps)
    assert all(len(values) > 3 for values in [state["agent_counters"]["agent_0"]["values"]])
    team.learn(32, reset_num_timesteps=False)
    files = ["progress.csv", "agents/agent_0/progress.csv", "agents/agent_1/progress.csv"]
    untouched = {file: table(tmp_path / file) for file in files}

    log = TeamLog(team.possible_agents, 0, str(tmp_path), str(tmp_path / "tb"), run_name="ignored", continue_from=state)
    assert log.run_name == "tries" and [path.name for path in (tmp_path / "tb").iterdir()] == ["tries_1"]
    assert {file: len(table(tmp_path / file)) for file in files} == dict.fromkeys(files, 2)
    log.put_back(state)
    for i, agent in enumerate(team.possible_agents):
        logger = log.agent_loggers[agent]
        # What train() had recorded is there, and the rest of a row comes
        for key, text in untouched[files[1 + i]][2].items():
            if text and key not in logger.name_to_value:
                logger.record(key, float(text))
        logger.dump(48)
        row, expected = table(tmp_path / files[1 + i])[2], untouched[files[1 + i]][2]
        assert {key: float(text or "nan") for key, text in row.items()} == pytest.approx(
            {key: float(text or "nan") for key, text in expected.items()}, nan_ok=True
        )
        assert row["train/loss"] == expected["train/loss"]


def test_iterations_are_counted_on(tmp_path):
    """In SB3 each ``learn()`` counts them from one."""

    def learn(log, *iterations):
        for i in iterations:
            model.logger.record("time/iterations", i)
            model.logger.dump(i)

    model = PPO("MlpPolicy", make_vec_env("CartPole-v1"), n_steps=8, batch_size=8, device="cpu")
    log = TeamLog(["a"], 0, str(tmp_path), None)
    log.connect("a", model)
    learn(log, 1, 2, 3)
    state = log.state(0)
    again = TeamLog(["a"], 0, str(tmp_path), None, continue_from=state)
    model._custom_logger = False
    again.connect("a", model)
    again.put_back(state)
    learn(again, 1, 2)
    assert again.state(0)["iterations"] == {"a": 5}
    # A further learn() of the continued team counts anew, as it would without an interruption
    learn(again, 1, 2)
    shown = [row["time/iterations"] for row in table(tmp_path / "agents" / "a" / "progress.csv")]
    assert shown == ["1", "2", "3", "4", "5", "1", "2"]


def test_tensorboard_shows_each_step_once(tmp_path):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    agents = ["a"]
    log = TeamLog(agents, 0, None, str(tmp_path))

    def dump(log, step, value):
        log.team_logger.record("x", value)
        log.team_logger.dump(step)
        log.agent_loggers["a"].record("y", value)
        log.agent_loggers["a"].dump(step)

    for step in (1, 2):
        dump(log, step, step)
    state = json.loads(json.dumps(log.state(2)))
    log.sync()
    for step in (3, 4):
        dump(log, step, -1)
    # TensorBoard orders the files of a run by the second of their beginning
    time.sleep(1.1)
    again = TeamLog(agents, 0, None, str(tmp_path), continue_from=state)
    for step in (3, 4, 5):
        dump(again, step, step)
    again.close()
    for folder, key in (("Team_1", "x"), ("Team_1/agents/a", "y")):
        events = accumulator.EventAccumulator(str(tmp_path / folder)).Reload()
        assert [(event.step, event.value) for event in events.Scalars(key)] == [(i, i) for i in range(1, 6)]
    assert [path.name for path in tmp_path.iterdir()] == ["Team_1"]


def test_the_name_of_a_run_leads_to_no_other_folder(tmp_path):
    state = TeamLog(["a"], 0, None, None).state(0)
    with pytest.raises(ValueError, match=r"is that of a folder, not '\.\./elsewhere'"):
        TeamLog(["a"], 0, None, str(tmp_path), continue_from={**state, "run": "../elsewhere"})


def test_all_files_are_synced(tmp_path, monkeypatch):
    pytest.importorskip("tensorboard")
    log = TeamLog(["a", "b"], 0, str(tmp_path), str(tmp_path))
    log.team_logger.record("x", 1)
    log.team_logger.dump()
    synced = []
    monkeypatch.setattr(os, "fsync", lambda descriptor: synced.append(os.fstat(descriptor).st_ino))
    log.sync()
    files = [*tmp_path.glob("**/progress.csv"), *tmp_path.glob("**/events.*")]
    assert len(files) == 6
    assert sorted(synced) == sorted(path.stat().st_ino for path in files)
