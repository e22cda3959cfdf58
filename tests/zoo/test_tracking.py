"""Runs that are logged to a tracker, and what of its failures reaches the training."""

import importlib
import json
import struct
import sys
import warnings
from typing import ClassVar

import numpy as np
import pytest
from stable_baselines3.common.logger import Logger

from sb3_belief.cli.main import main, train_main
from sb3_belief.zoo import tracking
from sb3_belief.zoo.errors import ConfigError
from sb3_belief.zoo.trackers import TRACKERS, Tracker, flat
from sb3_belief.zoo.tracking import TrackerOutput, Tracking, check_tracking
from sb3_belief.zoo.train_options import TrainOptions
from tests.zoo.runs import record_of, table, train

EXCLUDED = ("time/iterations", "time/time_elapsed", "time/total_timesteps", "train/n_updates")


class FakeTracker(Tracker):
    """Tracker that keeps what it is told."""

    runs: ClassVar[list] = []
    fails_at = 10**9

    def __init__(self, run):
        self.run, self.rows, self.status = run, [], None
        self.run_id = run.run_id or f"id{len(self.runs)}"
        self.runs.append(self)

    def log(self, values, step):
        if step >= self.fails_at:
            raise ConnectionError("the server is gone")
        self.rows.append((step, values))

    def finish(self, status):
        self.status = status


@pytest.fixture
def fake(monkeypatch):
    monkeypatch.setitem(TRACKERS, "wandb", ("Fake", FakeTracker))
    # It needs no package
    monkeypatch.setattr(tracking, "find_spec", lambda _: pytest)
    monkeypatch.setattr(pytest, "origin", "here", raising=False)
    monkeypatch.setattr(FakeTracker, "runs", [])
    monkeypatch.setattr(FakeTracker, "fails_at", 10**9)
    return FakeTracker


def logged(path, last=None):
    """The rows of a table as a tracker gets them, by step: numbers only, without what TensorBoard does not get."""
    rows: dict[int, dict[str, float]] = {}
    for row in table(path):
        step = int(row["time/total_timesteps"])
        values = {key: float(text) for key, text in row.items() if text and key not in EXCLUDED and key != "time/fps"}
        if last is None or step <= last:
            rows.setdefault(step, {}).update(values)
    return rows


def tracked(rows, prefix=""):
    found: dict = {}
    for step, values in rows:
        for key, value in values.items():
            name = key.removeprefix(prefix)
            ours = key.startswith(prefix) and (prefix or not key.startswith("agents/"))
            if ours and name != "time/fps":
                found.setdefault(step, {})[name] = value
    return found


def check_equal(found, expected):
    assert found.keys() == expected.keys() and found
    for step, values in expected.items():
        assert found[step].keys() == values.keys()
        np.testing.assert_allclose([found[step][key] for key in values], list(values.values()), rtol=1e-5)


@pytest.mark.parametrize("jobs", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_tracker_gets_the_tables_of_the_team_and_of_each_agent(tmp_path, fake, jobs):
    status, run = train(tmp_path, "--track", "wandb", "--jobs", str(jobs))
    (found,) = fake.runs
    assert status == 0 and found.status == "finished"
    check_equal(tracked(found.rows), logged(run / "progress.csv"))
    for agent in ("car_0", "car_4"):
        check_equal(tracked(found.rows, f"agents/{agent}/"), logged(run / "agents" / agent / "progress.csv"))
    assert found.run.project == "sb3-belief" and found.run.name == f"ppo/{run.name}"
    config = found.run.config
    assert (config["algo"], config["env"], config["seed"], config["n_steps"]) == ("ppo", "traffic-junction-easy", 3, 20)
    assert found.run.versions == record_of(run)["versions"]
    assert record_of(run)["tracking"] == {"tracker": "wandb", "project": "sb3-belief", "run": "id0"}


def test_a_resumed_run_goes_on_in_the_tracker(tmp_path, fake):
    _, run = train(tmp_path, "--track", "wandb", "--track-project", "mine")
    assert main(["train", "--resume", str(run), "--until", "560", "--verbose", "0"]) == 0
    first, second = fake.runs
    assert (second.run_id, second.run.project, second.status) == (first.run_id, "mine", "finished")
    assert min(step for step, _ in second.rows) > 400 and max(step for step, _ in second.rows) == 560
    check_equal(tracked(second.rows), {k: v for k, v in logged(run / "progress.csv").items() if k > 400})
    assert record_of(run)["tracking"]["run"] == first.run_id


def test_a_run_without_a_tracker_says_nothing_of_it(tmp_path, fake):
    status, run = train(tmp_path)
    assert status == 0 and fake.runs == [] and "tracking" not in record_of(run)


def test_a_tracker_that_fails_is_warned_of_once_and_ends_nothing(tmp_path, fake, monkeypatch):
    monkeypatch.setattr(fake, "fails_at", 200)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        status, run = train(tmp_path, "--track", "wandb")
    said = [str(each.message) for each in caught if "Fake failed" in str(each.message)]
    assert status == 0 and len(said) == 1 and "the server is gone" in said[0]
    assert record_of(run)["status"] == "finished" and record_of(run)["timesteps"] == 400
    assert max(step for step, _ in fake.runs[0].rows) < 200
    # It is told the end nevertheless
    assert fake.runs[0].status == "finished"


def test_a_tracker_is_told_that_a_run_failed(tmp_path, fake, monkeypatch):
    def fail(*_):
        raise ArithmeticError("no more")

    monkeypatch.setattr("sb3_belief.zoo.seeded_evaluation.SeededEvalCallback._on_step", fail)
    status, run = train(tmp_path, "--track", "wandb")
    assert status == 1 and record_of(run)["status"] == fake.runs[0].status == "failed"


def test_a_tracker_that_cannot_begin_refuses_the_run(tmp_path, fake, monkeypatch, capsys):
    def fail(self, run):
        (run.folder / "wandb").mkdir()
        raise OSError("no login")

    monkeypatch.setattr(fake, "__init__", fail)
    words = ["--algo", "ppo", "--env", "traffic-junction-easy", "-f", str(tmp_path / "logs"), "--track", "wandb"]
    assert train_main(words) == 2
    assert "--track: Fake cannot log this run: OSError: no login" in capsys.readouterr().err
    assert not (tmp_path / "logs").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--track", "wandb"], "--track: Weights & Biases needs wandb: pip install 'sb3-belief[track]'."),
        (["--track", "mlflow"], "--track: MLflow needs mlflow: pip install 'sb3-belief[track]'."),
        (["--track-project", "x"], "--track-project: says where --track logs to: add --track wandb or --track mlflow."),
    ],
)
def test_a_missing_package_is_said_before_anything_is_written(tmp_path, monkeypatch, capsys, words, message):
    monkeypatch.setattr(tracking, "find_spec", lambda _: None)
    assert train_main(["--algo", "ppo", "--env", "traffic-junction-easy", "-f", str(tmp_path / "logs"), *words]) == 2
    assert message in capsys.readouterr().err and not (tmp_path / "logs").exists()


def test_a_folder_of_the_name_of_a_tracker_is_no_package(tmp_path, monkeypatch):
    # wandb makes such folders
    (tmp_path / "wandb").mkdir()
    monkeypatch.setattr(sys, "path", [str(tmp_path)])
    monkeypatch.delitem(sys.modules, "wandb", raising=False)
    importlib.invalidate_caches()
    with pytest.raises(ConfigError, match="needs wandb"):
        check_tracking(TrainOptions(track="wandb"))


def test_an_output_logs_numbers_that_are_not_excluded():
    rows = []

    class Log(Tracking):
        def __init__(self):
            pass

        def log(self, values, step):
            rows.append((step, values))

    logger = Logger(None, [TrackerOutput(Log(), "a/")])
    for key, value in (("x", np.float32(2.0)), ("n", 3), ("text", "no"), ("list", [1])):
        logger.record(key, value, exclude="stdout")
    logger.record("hidden", 1, exclude="tensorboard")
    logger.dump(7)
    logger.record("text", "only")
    logger.dump(8)
    assert rows == [(7, {"a/x": 2.0, "a/n": 3.0})]


def test_nested_settings_have_dotted_names():
    assert flat({"a": {"b": {"c": 1}, "d": [2]}, "e": {}}) == {"a.b.c": 1, "a.d": [2], "e": {}}


@pytest.mark.slow
def test_mlflow_gets_a_run(tmp_path, monkeypatch):
    mlflow = pytest.importorskip("mlflow", reason="MLflow's tests need it: pip install 'sb3-belief[track]'")
    uri = f"sqlite:///{tmp_path / 'mlflow.db'}"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", uri)
    monkeypatch.chdir(tmp_path)
    _, run = train(tmp_path / "logs", "--track", "mlflow", "--track-project", "mine")
    assert main(["train", "--resume", str(run), "--until", "480", "--verbose", "0"]) == 0
    client = mlflow.MlflowClient(uri)
    (found,) = client.search_runs([client.get_experiment_by_name("mine").experiment_id])
    assert found.info.status == "FINISHED" and found.info.run_id == record_of(run)["tracking"]["run"]
    assert found.data.params["seed"] == "3" and found.data.params["env_kwargs.reward_scale"] == "0.1"
    assert found.data.tags["version.torch"] == record_of(run)["versions"]["torch"]
    for key, path in (("", "progress.csv"), ("agents/car_2/", "agents/car_2/progress.csv")):
        expected = [
            (step, row["rollout/ep_rew_mean"]) for step, row in logged(run / path).items() if "rollout/ep_rew_mean" in row
        ]
        history = client.get_metric_history(found.info.run_id, f"{key}rollout/ep_rew_mean")
        assert [each.step for each in history] == [step for step, _ in expected]
        np.testing.assert_allclose([each.value for each in history], [value for _, value in expected], rtol=1e-5)


def records(path):
    """The records of a run's file of wandb: LevelDB's log format, after a header of its own."""
    from wandb.proto.wandb_internal_pb2 import Record

    data, position, parts = path.read_bytes(), 7, b""
    while position + 7 <= len(data):
        if 32768 - position % 32768 < 7:
            position += 32768 - position % 32768
            continue
        length, kind = struct.unpack("<HB", data[position + 4 : position + 7])
        parts += data[position + 7 : position + 7 + length]
        position += 7 + length
        # A whole record, or the last part of one
        if kind in (1, 4):
            record = Record()
            record.ParseFromString(parts)
            parts = b""
            yield record


def test_wandb_gets_a_run_offline(tmp_path, monkeypatch):
    pytest.importorskip("wandb.proto.wandb_internal_pb2", reason="wandb's tests need it: pip install 'sb3-belief[track]'")
    for name, value in (("WANDB_MODE", "offline"), ("WANDB_SILENT", "true")):
        monkeypatch.setenv(name, value)
    _, run = train(tmp_path / "logs", "--track", "wandb", "--track-project", "mine")
    (file,) = run.glob("wandb/offline-run-*/run-*.wandb")
    rows, config, project, summary = [], {}, "", {}
    for record in records(file):
        if record.HasField("run"):
            project = record.run.project
        summary.update({item.key or item.nested_key[0]: json.loads(item.value_json) for item in record.summary.update})
        for item in [*record.run.config.update, *record.config.update]:
            config[item.key or item.nested_key[0]] = json.loads(item.value_json)
        if record.HasField("history"):
            row = {item.key or "/".join(item.nested_key): json.loads(item.value_json) for item in record.history.item}
            rows.append((row["global_step"], {key: value for key, value in row.items() if "/" in key}))
    assert project == "mine" and summary["status"] == "finished"
    assert (config["algo"], config["seed"], config["n_steps"]) == ("ppo", 3, 20)
    assert config["versions"]["torch"] == record_of(run)["versions"]["torch"]
    check_equal(tracked(rows), logged(run / "progress.csv"))
    check_equal(tracked(rows, "agents/car_2/"), logged(run / "agents" / "car_2" / "progress.csv"))
    # The same run goes on
    assert main(["train", "--resume", str(run), "--until", "480", "--verbose", "0"]) == 0
    files = sorted(run.glob("wandb/offline-run-*/run-*.wandb"))
    assert len(files) == 2 and len({path.name for path in files}) == 1
    steps = [
        json.loads(item.value_json)
        for record in records(next(path for path in files if path != file))
        for item in record.history.item
        if (item.key or item.nested_key[0]) == "global_step"
    ]
    assert steps and min(steps) > 400
