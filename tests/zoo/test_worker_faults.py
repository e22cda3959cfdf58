"""Runs whose environment hangs, dies or fails: flags, what they record, and that Ctrl-C ends them."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
import uuid
from pathlib import Path

import pytest

from sb3_belief.cli.main import train_main
from tests.vec_env.scripts import LINUX, gone_within, marked
from tests.vec_env.test_worker_faults import no_test_hangs  # noqa: F401 (a fixture)

TROUBLED = "tests.vec_env.faulty_envs:Troubled"
pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")


def words(folder, fault, *more, times=""):
    counted = ["folder:" + repr(str(folder))] * bool(times) + [f"times:{times}"] * bool(times)
    return [
        *("--algo", "ppo", "--env", TROUBLED, "--allow-package", "tests", "-f", str(folder / "logs"), "--eval-freq", "-1"),
        *("--verbose", "0", "--seed", "0", "-n", "64", "-params", "n_envs:2", "n_steps:8", "batch_size:8"),
        *("--env-kwargs", "place:'step'", f"fault:'{fault}'", *counted, *more),
    ]


def only_run(folder):
    (run,) = (folder / "logs" / "ppo").glob("*_1")
    return run, json.loads((run / "run.json").read_text())


def test_a_run_ends_when_a_worker_hangs(tmp_path, capsys):
    assert train_main(words(tmp_path, "hang", "--vec-env", "subproc", "--step-timeout", "0.7s")) == 1
    said = "worker process 0 did not answer step() within 0.7 s and was ended in environment copy 0 at step 3"
    assert said in capsys.readouterr().err
    run, record = only_run(tmp_path)
    assert record["status"] == "failed" and "did not answer step()" in record["error"]
    assert (run / "team.zip").exists()


@pytest.mark.parametrize("fault", ["own", "exit"])
def test_a_run_goes_on_with_new_workers(fault, tmp_path):
    flags = ["--vec-env", "subproc", "--restart-workers", "2"]
    assert train_main(words(tmp_path, fault, *flags, times="2")) == 0
    run, record = only_run(tmp_path)
    assert record["status"] == "finished" and record["options"]["restart_workers"] == 2
    with open(run / "progress.csv") as file:
        assert list(csv.DictReader(file))[-1]["rollout/worker_restarts"] == "2"


def test_step_timeout_needs_workers(tmp_path, capsys):
    assert train_main(words(tmp_path, "own", "--step-timeout", "5s")) == 2
    assert "--step-timeout" in capsys.readouterr().err and not (tmp_path / "logs").exists()


@LINUX
@pytest.mark.parametrize(("name", "status"), [("SIGINT", 130), ("SIGTERM", 143)])
def test_one_signal_ends_a_run_that_hangs(name, status, tmp_path):
    marker = uuid.uuid4().hex
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2]), "OMP_NUM_THREADS": "1", "FAULTS_TEST": marker}
    command = [sys.executable, "-m", "sb3_belief", "train", *words(tmp_path, "hang", "--vec-env", "subproc", "--jobs", "2")]
    process = subprocess.Popen(command, env=env, stdout=subprocess.PIPE, preexec_fn=lambda: _default(signal.SIGINT))
    assert process.stdout is not None
    try:
        deadline = time.monotonic() + 120
        # The main process, two copies, one worker of the agents, and those of multiprocessing
        while not (only_there(tmp_path) and len(marked(marker)) >= 6) and time.monotonic() < deadline:
            time.sleep(0.1)
        time.sleep(1.5)
        process.send_signal(getattr(signal, name))
        started = time.monotonic()
        assert f"Interrupted by {name}" in process.stdout.readline().decode()
        # What follows is the end of Python itself, which takes its time where others compute
        assert time.monotonic() - started < 5
        assert process.wait(timeout=30) == status
        assert gone_within(30.0, marker) == []
    finally:
        for pid, _ in marked(marker):
            os.kill(pid, signal.SIGKILL)
        process.stdout.close()
    run, record = only_run(tmp_path)
    assert record["status"] == "interrupted" and record["signal"] == name
    assert (run / "team.zip").exists()


def only_there(folder):
    return list(folder.glob("logs/ppo/*_1/run.json"))


def _default(number):
    # A shell has it ignored in what runs in the background
    signal.signal(number, signal.default_int_handler)
