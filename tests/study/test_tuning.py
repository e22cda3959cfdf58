"""Tunings, as the command runs them."""

import csv
import json
import os
import shutil
import signal
import statistics
import subprocess
import sys

import numpy as np
import pytest
import yaml

from sb3_belief.cli.main import main, train_main
from sb3_belief.zoo.run_lock import run_lock
from tests.study.test_tuning_spec import GOOD, written

optuna = pytest.importorskip("optuna", reason="the tuning needs Optuna: pip install 'sb3-belief[tune]'")

FAST = {**GOOD, "n_trials": 4, "pruner": {"startup_trials": 2, "warmup_evaluations": 0}, "sampler": {"startup_trials": 2}}


def rows_of(folder):
    with open(folder / "trials.csv", newline="") as file:
        return list(csv.DictReader(file))


def tune(folder, *words, **changes):
    folder.mkdir(exist_ok=True)
    status = main(["tune", str(written(folder, **{**FAST, **changes})), "-f", str(folder / "out"), *words])
    return status, folder / "out" / "tiny"


def results(rows):
    """What was drawn and found, by the place of the trial: a repetition stands where the killed one stood."""
    searched = [name for name in rows[0] if name.startswith("search/")]
    return {
        row["repeats"] or row["trial"]: [row[name] for name in ("state", "value", "evaluations", *searched)]
        for row in rows
        if row["state"] != "killed"
    }


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """A finished tuning: its folder."""
    status, folder = tune(tmp_path_factory.mktemp("tuning"))
    assert status == 0
    return folder


def test_a_row_says_what_was_drawn_and_found(undisturbed):
    rows = rows_of(undisturbed)
    assert [row["trial"] for row in rows] == ["0", "1", "2", "3"]
    assert {row["state"] for row in rows} <= {"complete", "pruned"}
    for row in rows:
        (run,) = (undisturbed / "trials" / f"{int(row['trial']):04d}" / "seed_1000" / "ppo").iterdir()
        settings = yaml.safe_load((run / "config.yml").read_text())["traffic-junction-easy"]
        assert settings["learning_rate"] == row["search/learning_rate"].strip('"')
        assert settings["policy_kwargs"]["net_arch"] == json.loads(row["search/policy_kwargs.net_arch"])
        assert str(settings["n_epochs"]) == row["search/n_epochs"]
        with np.load(run / "evaluations.npz") as data:
            means = data["results"].mean(axis=1)
        np.testing.assert_allclose(json.loads(row["evaluations"]), means)
        assert float(row["value"]) == pytest.approx(means[-1])
        assert json.loads((run / "run.json").read_text())["seed"] == 1000


def test_pruned_are_those_below_the_median(undisturbed):
    rows = rows_of(undisturbed)
    values = [json.loads(row["evaluations"]) for row in rows]
    for i, row in enumerate(rows):
        expected = None
        for step in range(len(values[i])):
            others = [each[step] for each in values[:i] if len(each) > step]
            if i >= 2 and others and max(values[i][: step + 1]) < statistics.median(others):
                expected = step
                break
        assert (row["state"] == "pruned") == (expected is not None), i
        assert len(values[i]) == (3 if expected is None else expected + 1)


def test_the_best_settings_train(undisturbed, tmp_path):
    complete = [row for row in rows_of(undisturbed) if row["state"] == "complete"]
    best = max(complete, key=lambda row: float(row["value"]))
    section = yaml.safe_load((undisturbed / "best.yml").read_text())["traffic-junction-easy"]
    assert section["learning_rate"] == best["search/learning_rate"]
    # As long as the configuration file says, not as short as a trial
    assert section["n_timesteps"] == 200_000
    words = ["--algo", "ppo", "--env", "traffic-junction-easy", "-n", "80", "--eval-freq", "-1", "--verbose", "0"]
    assert train_main([*words, "-conf", str(undisturbed / "best.yml"), "-f", str(tmp_path)]) == 0


def test_a_report_reads_what_was_written(undisturbed):
    from sb3_belief.study.reported_tuning import reported_tuning
    from sb3_belief.zoo.run_files import is_tuning

    facts = reported_tuning(undisturbed)
    assert is_tuning(undisturbed) and len(facts.trials) == facts.n_trials == 4
    for row, trial in zip(rows_of(undisturbed), facts.trials, strict=True):
        assert (trial.state, trial.value, trial.seconds) == (row["state"], float(row["value"]), float(row["seconds"]))
        assert trial.settings == {
            "learning_rate": float(row["search/learning_rate"].removeprefix("lin_")),
            "policy_kwargs.net_arch": row["search/policy_kwargs.net_arch"],
            "n_epochs": int(row["search/n_epochs"]),
        }
    assert facts.best is not None and f"# Settings of trial {facts.best.number} of the tuning" in facts.best_settings
    assert facts.specification == (undisturbed / "tune.yml").read_text()


def test_a_finished_tuning_is_not_repeated_and_can_be_extended(undisturbed, tmp_path, capsys):
    folder = tmp_path / "out" / "tiny"
    shutil.copytree(undisturbed, folder)
    before = rows_of(folder)
    assert tune(tmp_path)[0] == 0
    assert rows_of(folder) == before and "Best: trial" in capsys.readouterr().out
    assert tune(tmp_path, n_trials=5)[0] == 0
    after = rows_of(folder)
    assert after[:4] == before and len(after) == 5


def test_another_search_in_the_same_folder_is_refused(undisturbed, capsys):
    before = rows_of(undisturbed)
    status, _ = tune(undisturbed.parent.parent, search={"gamma": {"low": 0.5, "high": 0.9}}, seeds=[3])
    assert status == 2 and rows_of(undisturbed) == before
    assert "search, seeds: the tuning in" in capsys.readouterr().err


KILLED = """
import os, sys
from sb3_belief.cli.main import main
from sb3_belief.study.tuning import ReportEvaluation
from tests.zoo.interrupted import call_before

def when(self):
    return self._trial.number == 2 and self.n_reported == 0

call_before(ReportEvaluation, "_on_step", when, lambda: os.kill(os.getpid(), {signal}))
sys.exit(main(["tune", {file!r}, "-f", {out!r}]))
"""


@pytest.mark.slow
@pytest.mark.parametrize("signum", [signal.SIGKILL, signal.SIGTERM])
def test_a_killed_tuning_ends_with_the_same_results(undisturbed, tmp_path, signum):
    file = written(tmp_path, **FAST)
    program = KILLED.format(signal=int(signum), file=str(file), out=str(tmp_path / "out"))
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=100)
    assert done.returncode == (-9 if signum == signal.SIGKILL else 143), done.stderr
    status, folder = tune(tmp_path)
    assert status == 0
    rows = rows_of(folder)
    assert [row["state"] == "killed" for row in rows] == [False, False, True, False, False]
    assert [row["repeats"] for row in rows] == ["", "", "", "2", ""]
    expected, found = results(rows_of(undisturbed)), results(rows)
    # The trial after the killed one has another number, and is the same otherwise
    assert list(expected.values()) == list(found.values())


@pytest.mark.slow
def test_two_processes_share_a_tuning(tmp_path):
    status, folder = tune(tmp_path, "--jobs", "2", n_trials=5)
    rows = rows_of(folder)
    assert status == 0 and len(rows) == 5 and {row["state"] for row in rows} <= {"complete", "pruned"}
    runs = list(folder.glob("trials/*/seed_1000/ppo/*/run.json"))
    assert len(runs) == 5 and {json.loads(run.read_text())["status"] for run in runs} == {"finished"}
    # What two processes draw differs
    assert len({row["search/learning_rate"] for row in rows}) == 5
    assert not list(folder.rglob(".lock"))


def test_a_trial_is_begun_three_times_at_most(tmp_path):
    from sb3_belief.study.tune import begin
    from sb3_belief.study.tuning_spec import load_tuning
    from sb3_belief.study.tuning_storage import Storage

    spec = load_tuning(written(tmp_path, **{**FAST, "n_trials": 1}))
    begin(spec, tmp_path / "out")
    storage = Storage(tmp_path / "out", spec)
    drawn = []
    for _ in range(3):
        trial = storage.draw()
        assert trial is not None
        storage.trial_folder(trial.number).mkdir(parents=True)
        with run_lock(storage.trial_folder(trial.number)):
            storage.give_up_killed()  # it is held
            assert storage.trials()[-1].state.name == "RUNNING"
        storage.give_up_killed()
        drawn.append(trial.params)
    assert storage.draw() is None
    assert drawn[0] == drawn[1] == drawn[2]
    states = [each.state.name for each in storage.trials()]
    assert states == ["FAIL"] * 3 and "as in 2 tries before" in storage.trials()[-1].user_attrs["error"]


@pytest.mark.parametrize(("warmup", "pruned"), [(0, [True, True, True]), (1, [False, True, True]), (2, [False, False, True])])
def test_no_trial_is_pruned_at_a_warm_up_evaluation(tmp_path, warmup, pruned):
    from sb3_belief.study.tune import begin
    from sb3_belief.study.tuning_spec import load_tuning
    from sb3_belief.study.tuning_storage import Storage

    pruner = {"startup_trials": 1, "warmup_evaluations": warmup}
    spec = load_tuning(written(tmp_path, **{**FAST, "pruner": pruner}))
    begin(spec, tmp_path / "out")
    storage = Storage(tmp_path / "out", spec)
    first = storage.draw()
    assert first is not None
    for step in (1, 2, 3):
        first.report(5.0, step)
    storage.finish(first, 5.0, [5.0], 1.0)
    second = storage.draw()
    assert second is not None
    found = []
    for step in (1, 2, 3):
        second.report(0.0, step)
        found.append(second.should_prune())
    assert found == pruned


def test_what_fails_whatever_is_drawn_stops_the_tuning(tmp_path, capsys):
    # PPO refuses a rollout of one step of one copy when it is set up
    params = {"n_envs": 1, "n_steps": 1, "batch_size": 1}
    status, folder = tune(tmp_path, params=params, n_trials=9)
    assert status == 1 and [row["state"] for row in rows_of(folder)] == ["failed"] * 5
    assert "5 trials in a row failed" in capsys.readouterr().err
    assert "ppo cannot be set up" in rows_of(folder)[0]["error"]
    assert not (folder / "best.yml").exists()


def test_success_is_an_objective_where_it_is_reported(tmp_path, capsys):
    status, folder = tune(tmp_path, objective="success", n_trials=1)
    (row,) = rows_of(folder)
    (run,) = folder.glob("trials/0000/seed_1000/ppo/*")
    with np.load(run / "evaluations.npz") as data:
        assert status == 0 and float(row["value"]) == data["successes"][-1].mean()
    other = tmp_path / "other"
    status, folder = tune(other, objective="success", env="convention-swap", n_trials=1)
    assert status == 1 and "reports no successes" in capsys.readouterr().err


def test_the_mean_over_seeds_and_last_evaluations_counts(tmp_path):
    status, folder = tune(tmp_path, seeds=2, last_evaluations=2, n_trials=1)
    (row,) = rows_of(folder)
    values = json.loads(row["evaluations"])
    assert status == 0 and len(values) == 6
    assert json.loads(row["seed_values"]) == pytest.approx([np.mean(values[1:3]), np.mean(values[4:6])])
    assert float(row["value"]) == pytest.approx(np.mean(values[1:3] + values[4:6]))


def test_what_cannot_be_is_refused_before_anything_is_written(tmp_path, capsys, monkeypatch):
    status, _ = tune(tmp_path, search={"gamma": {"low": 0.5, "high": 1.5}})
    assert status == 2 and "search: gamma: must be in [0, 1], not 1.5" in capsys.readouterr().err
    status, _ = tune(tmp_path, train={"device": "cuda:77"})
    assert status == 2 and "'cuda:77' is not available here" in capsys.readouterr().err
    monkeypatch.setattr("sb3_belief.study.tune.find_spec", lambda _: None)
    status, _ = tune(tmp_path)
    assert status == 2 and "pip install 'sb3-belief[tune]'" in capsys.readouterr().err
    assert os.listdir(tmp_path) == ["tiny.yml"]


def test_a_damaged_storage_is_said_and_kept(undisturbed, tmp_path, capsys):
    folder = tmp_path / "out" / "tiny"
    folder.mkdir(parents=True)
    content = (undisturbed / "study.db").read_bytes()
    half = b"x" * 200 + content[200 : len(content) // 2]
    for name, data in (("study.db", half), ("tune.yml", (undisturbed / "tune.yml").read_bytes())):
        (folder / name).write_bytes(data)
    status, _ = tune(tmp_path)
    assert status == 2 and "study.db: cannot be used as Optuna's storage" in capsys.readouterr().err
    assert (folder / "study.db").read_bytes() == half


@pytest.fixture
def small_disk(tmp_path):
    """A folder in a file system of its own, of 2 MB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=2000k", "tmpfs", str(folder)], capture_output=True)
    if mounted.returncode:
        pytest.skip("a small file system can be mounted by root only")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


@pytest.mark.slow
def test_a_full_disk_stops_the_tuning_and_loses_no_result(undisturbed, small_disk, capsys):
    file = written(small_disk, **FAST)
    assert main(["tune", str(file), "-f", str(small_disk)]) == 1
    said = capsys.readouterr()
    assert "Failed: The tuning cannot go on: " in said.err and len(said.err.strip().splitlines()) <= 3
    finished = [line for line in said.out.splitlines() if line.startswith("Trial ")]
    subprocess.run(["mount", "-o", "remount,size=60m", str(small_disk)], check=True)
    assert main(["tune", str(file), "-f", str(small_disk)]) == 0
    again = [line for line in capsys.readouterr().out.splitlines() if line.startswith("Trial ")]
    assert len(finished) + len(again) == 4
    rows = rows_of(small_disk / "tiny")
    assert list(results(rows).values()) == list(results(rows_of(undisturbed)).values())
