"""A study that is killed at any moment, or shared by two processes, ends with the episodes of an undisturbed one."""

import os
import random
import signal
import subprocess
import time

import pytest

from sb3_belief.cli.main import main
from sb3_belief.report.episodes import read_episodes_table
from sb3_belief.study.cell_record import all_cells
from tests.study.tiny import EASY, TINY, record, start, statuses, write

pytestmark = pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
# A run of about four seconds
LONGER = {"seeds": 2, "n_timesteps": 2400, "evaluation": {**TINY["evaluation"], "every": 400}}


def ended(process, seconds=170):
    """Wait for a study, and return its exit status and what it wrote."""
    try:
        out, _ = process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        process.kill()
        raise
    return process.returncode, out


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("undisturbed")
    status, out = ended(start(write(folder, **LONGER), "-f", folder / "logs", "--jobs", "2"))
    assert status == 0, out
    return read_episodes_table(folder / "logs" / "tiny" / "episodes.parquet")


@pytest.mark.slow
def test_killed_three_times_it_ends_with_the_same_episodes(tmp_path, undisturbed):
    file, folder = write(tmp_path, **LONGER), tmp_path / "logs"
    words = [file, "-f", folder, "--jobs", "2"]
    # Another one each time, which a failure shows
    seed = random.randrange(10**6)
    rng = random.Random(seed)
    moments: list[float] = []
    for _ in range(3):
        process = start(*words)
        before = len(moments)
        deadline = time.monotonic() + 60
        # From the start of the first cell on: what comes before writes nothing
        while "running" not in statuses(folder / "tiny").values() and time.monotonic() < deadline and process.poll() is None:
            time.sleep(0.05)
        moments.append(rng.uniform(0.0, 4.0))
        time.sleep(moments[before])
        process.send_signal(signal.SIGKILL)
        process.communicate()
    status, out = ended(start(*words))
    assert status == 0, (seed, moments, out)
    table = read_episodes_table(folder / "tiny" / "episodes.parquet")
    assert table.equals(undisturbed), (seed, moments)
    for cell in all_cells(folder / "tiny"):
        # One run each, and nothing that somebody left
        assert len(list((cell.folder / "ppo").iterdir())) == 1
        assert not list(cell.folder.rglob("*.tmp")), (seed, moments)


@pytest.mark.slow
def test_sigterm_has_the_runs_save_and_the_study_goes_on(tmp_path, undisturbed):
    file, folder = write(tmp_path, **LONGER), tmp_path / "logs"
    process = start(file, "-f", folder, "--jobs", "2")
    deadline = time.monotonic() + 60
    while list(statuses(folder / "tiny").values()).count("running") < 2 and time.monotonic() < deadline:
        time.sleep(0.05)
    process.terminate()
    status, out = ended(process)
    assert status == 143 and "The same command goes on" in out, out
    assert set(statuses(folder / "tiny").values()) <= {"waiting", "finished"}
    status, out = ended(start(file, "-f", folder, "--jobs", "2"))
    assert status == 0, out
    assert read_episodes_table(folder / "tiny" / "episodes.parquet").equals(undisturbed)


@pytest.mark.slow
def test_two_processes_share_a_study_without_doubling_a_run(tmp_path):
    file, folder = write(tmp_path, seeds=3), tmp_path / "logs"
    both = [start(file, "-f", folder) for _ in range(2)]
    outputs = [ended(process) for process in both]
    assert [status for status, _ in outputs] == [0, 0], outputs
    cells = list(all_cells(folder / "tiny"))
    assert [record(cell)["status"] for cell in cells] == 3 * ["finished"]
    # Each was begun once, and both took part
    assert [record(cell)["attempts"] for cell in cells] == 3 * [1]
    assert all(": finished" in out for _, out in outputs)
    assert read_episodes_table(folder / "tiny" / "episodes.parquet").num_rows == 3 * 32


def test_some_environments_first_and_the_rest_later(tmp_path, capsys):
    settings = TINY["environments"][EASY]
    medium = EASY.replace("easy", "medium")
    path, logs = write(tmp_path, environments={EASY: settings, medium: settings}), tmp_path / "logs"
    words = ["study", str(path), "-f", str(logs)]
    assert main([*words, "--envs", medium, "hard"]) == 2
    assert f"--envs: 'hard' is none of the environments of {path}: {EASY}, {medium}." in capsys.readouterr().err
    assert not logs.exists()
    assert main([*words, "--envs", medium]) == 0
    assert statuses(logs / "tiny") == {f"ippo/{EASY}/seed_0": "waiting", f"ippo/{medium}/seed_0": "finished"}
    assert main(words) == 0
    assert set(statuses(logs / "tiny").values()) == {"finished"}
    table = read_episodes_table(logs / "tiny" / "episodes.parquet")
    assert set(table["environment"].to_pylist()) == {EASY, medium}
