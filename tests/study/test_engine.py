"""The pool of processes: how many run, which run again, and how two studies share the cells."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

import sb3_belief
from sb3_belief.study import engine
from sb3_belief.study.cell_record import Cell
from sb3_belief.study.engine import MOST_KILLS, run_local
from sb3_belief.zoo.run_lock import run_lock

pytestmark = pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
ROOT = str(Path(sb3_belief.__file__).parents[1])


class Lines:
    def __init__(self):
        self.told: list = []

    def tell(self, text):
        self.told.append(text)

    def update(self):
        pass


@pytest.fixture
def study(tmp_path, monkeypatch):
    """Six cells, a function that runs them with cells that need no time, and the journal of what ran."""
    cells = []
    for seed in range(6):
        cell = Cell(tmp_path / "cells" / "arm" / "env" / f"seed_{seed}")
        record = {"study": "fake", "arm": "arm", "algo": "ppo", "env": "env", "seed": seed, "status": "waiting", "attempts": 0}
        cell.create({**record, "error": None, "n_timesteps": 10, "final_episodes": 1, "options": {}, "settings": {}})
        cells.append(cell)
    journal = tmp_path / "journal"
    journal.write_text("")

    def run(jobs=2, **how):
        def start(cell, packages, output):
            words = [sys.executable, "-m", "tests.study.fake_cell", str(cell.folder), str(journal), json.dumps(how)]
            return subprocess.Popen(
                words, stdin=subprocess.PIPE, stdout=output, stderr=output, cwd=ROOT, env={**os.environ, "PYTHONPATH": ROOT}
            )

        monkeypatch.setattr(engine, "start_cell", start)
        display = Lines()
        return run_local(cells, jobs, display), display

    return cells, run, journal


def begun(journal):
    return [line.split()[0] for line in journal.read_text().splitlines() if " begin " in line]


def test_every_cell_runs_once_and_no_more_than_jobs_at_a_time(study):
    cells, run, journal = study
    result, display = run(jobs=2)
    assert (result.exit_status, result.failures) == (0, {})
    assert sorted(begun(journal)) == sorted(cell.name for cell in cells)
    assert {cell.read()["status"] for cell in cells} == {"finished"}
    events = sorted((float(line.split()[2]), line.split()[1]) for line in journal.read_text().splitlines())
    at_once = [sum(1 if kind == "begin" else -1 for _, kind in events[: i + 1]) for i in range(len(events))]
    assert max(at_once) <= 2
    assert display.told.count("arm/env/seed_0: finished") == 1
    # Nothing is left to do
    run()
    assert len(begun(journal)) == 6


def test_failures_do_not_hide_others_and_are_not_repeated(study):
    cells, run, journal = study
    run(**{cells[1].name: "fails"})
    assert [cell.read()["status"] for cell in cells] == ["finished", "failed", *4 * ["finished"]]
    run()
    assert len(begun(journal)) == 6


def test_what_a_cell_could_not_record_is_known(study):
    cells, run, _ = study
    result, _ = run(**{cells[2].name: "silent"})
    assert list(result.failures) == [cells[2]] and "no room" in result.failures[cells[2]]
    assert cells[2].read()["status"] == "failed" and "no room" in (cells[2].folder / "error.txt").read_text()


def test_a_cell_that_is_killed_is_started_again_a_few_times(study):
    cells, run, journal = study
    result, _ = run(**{cells[0].name: "killed"})
    assert begun(journal).count(cells[0].name) == MOST_KILLS
    assert "SIGKILL" in result.failures[cells[0]] and cells[0].read()["status"] == "failed"
    assert {cell.read()["status"] for cell in cells[1:]} == {"finished"}


def test_a_cell_that_another_process_runs_is_waited_for(study):
    cells, run, journal = study
    with run_lock(cells[0].folder):
        cells[0].write({**cells[0].read(), "status": "running"})
        done: list = []
        # Signals are the main thread's, which is not needed here
        thread = threading.Thread(target=lambda: done.append(run()))
        thread.start()
        deadline = time.monotonic() + 30
        while len(begun(journal)) < 5 and time.monotonic() < deadline:
            time.sleep(0.1)
        time.sleep(1.5)
        assert not done and cells[0].name not in begun(journal)
        cells[0].write({**cells[0].read(), "status": "finished"})
    thread.join(20)
    assert done and cells[0].name not in begun(journal)


def test_a_signal_has_all_cells_save_and_end(study):
    cells, run, journal = study

    def send():
        deadline = time.monotonic() + 30
        while len(begun(journal)) < 2 and time.monotonic() < deadline:
            time.sleep(0.05)
        time.sleep(0.2)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=send).start()
    result, _ = run(all="waits")
    assert result.exit_status == 143
    assert {cell.read()["status"] for cell in cells} == {"waiting"} and len(begun(journal)) == 2
    # And goes on
    run()
    assert {cell.read()["status"] for cell in cells} == {"finished"}
