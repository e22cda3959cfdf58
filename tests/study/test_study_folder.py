"""Going on with a study: what was changed in its file, what was added, and what was lost."""

import subprocess
import sys

import pytest

from sb3_belief.cli.main import main
from sb3_belief.report.episodes import read_episodes_table
from sb3_belief.study import cell as cell_module
from sb3_belief.study import engine
from sb3_belief.study.cell_record import all_cells
from tests.study.tiny import EASY, TINY, record, statuses, write


@pytest.fixture
def in_process(monkeypatch):
    """Have cells run in this process, one after the other, without the seconds that a new Python takes."""

    class Done:
        stdin = None

        def __init__(self, returncode):
            self.returncode = returncode
            self.stdin = subprocess.Popen([sys.executable, "-c", ""], stdin=subprocess.PIPE).stdin

        def poll(self):
            return self.returncode

    monkeypatch.setattr(engine, "start_cell", lambda cell, packages, output: Done(cell_module.cell_main([str(cell.folder)])))


def test_a_study_is_extended_and_a_change_refused(tmp_path, in_process, capsys):
    folder = tmp_path / "logs"
    words = ["study", str(write(tmp_path)), "-f", str(folder)]
    assert main(words) == 0
    first = {name: (folder / "tiny" / "cells" / name / "cell.json").read_bytes() for name in statuses(folder / "tiny")}
    capsys.readouterr()
    # A seed and an algorithm more
    algorithms = {**TINY["algorithms"], "fast": {"algo": "ppo", "params": {"policy": "MlpPolicy", "learning_rate": 0.01}}}
    write(tmp_path, seeds=[0, 1], algorithms=algorithms)
    assert main(words) == 0
    assert set(statuses(folder / "tiny").values()) == {"finished"} and len(statuses(folder / "tiny")) == 4
    for name, content in first.items():
        assert (folder / "tiny" / "cells" / name / "cell.json").read_bytes() == content
    table = read_episodes_table(folder / "tiny" / "episodes.parquet")
    assert table.num_rows == 4 * (2 * 4 + 4 * 6) and set(table["arm"].to_pylist()) == {"ippo", "fast"}
    # Another setting of what has finished
    write(tmp_path, n_timesteps=800)
    assert main(words) == 2
    error = capsys.readouterr().err
    assert "n_timesteps was 400 and is 800" in error and f"ippo/{EASY}/seed_0" in error and error.count("\n") == 1
    write(tmp_path, evaluation={**TINY["evaluation"], "final_episodes": 7})
    assert main([*words, "--dry-run"]) == 2
    assert "final_episodes was 6 and is 7" in capsys.readouterr().err
    # How it is computed may change
    write(tmp_path, train={**TINY["train"], "num_threads": 2, "save_every": "1h"})
    assert main(words) == 0
    # What was taken out of the file is left alone, and said
    assert "3 cells" in capsys.readouterr().out and len(statuses(folder / "tiny")) == 4
    assert read_episodes_table(folder / "tiny" / "episodes.parquet").num_rows == 32


def test_lost_and_halved_results_are_made_again_and_cost_no_others(tmp_path, in_process, capsys):
    folder = tmp_path / "logs" / "tiny"
    words = ["study", str(write(tmp_path, seeds=2)), "-f", str(tmp_path / "logs")]
    assert main(words) == 0
    before = read_episodes_table(folder / "episodes.parquet")
    one, other = all_cells(folder)
    one.episodes.write_bytes(one.episodes.read_bytes()[:2000])
    kept = record(other)
    (folder / "episodes.parquet").unlink()
    assert main(words) == 0
    assert "The final episodes of" in capsys.readouterr().out
    assert read_episodes_table(folder / "episodes.parquet").equals(before) and record(other) == kept
    # A record cannot be made again: nobody knows with which settings the run was made
    one.path.write_bytes(one.path.read_bytes()[:200])
    assert main(words) == 2
    assert "cell.json: is damaged" in capsys.readouterr().err
    assert record(other) == kept


def test_failed_runs_are_said_and_retried_on_request(tmp_path, in_process, capsys, monkeypatch):
    from sb3_belief.study import final_evaluation

    real = final_evaluation.evaluate
    calls: list = []

    def break_first(*args):
        calls.append(args)
        if len(calls) == 1:
            raise RuntimeError("nothing works")
        return real(*args)

    monkeypatch.setattr(final_evaluation, "evaluate", break_first)
    words = ["study", str(write(tmp_path, seeds=2)), "-f", str(tmp_path / "logs")]
    assert main(words) == 1
    name = f"ippo/{EASY}/seed_0"
    assert f"Failed: {name}: RuntimeError: nothing works" in capsys.readouterr().err
    assert statuses(tmp_path / "logs" / "tiny") == {name: "failed", f"ippo/{EASY}/seed_1": "finished"}
    assert read_episodes_table(tmp_path / "logs" / "tiny" / "episodes.parquet").num_rows == 32
    # It is not repeated, and said again
    assert main(words) == 1 and len(calls) == 5
    assert f"Failed: {name}" in capsys.readouterr().err
    assert main([*words, "--retry"]) == 0
    assert read_episodes_table(tmp_path / "logs" / "tiny" / "episodes.parquet").num_rows == 64
