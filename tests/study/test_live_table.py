"""What a study shows: counts, progress, and the time that is left."""

import io

import pytest
from rich.console import Console

from sb3_belief.study.cell_record import Cell, steps_done
from sb3_belief.study.live_table import CellState, StudyDisplay, TimeLeft, duration_text, matrix_table, summary


def states(*entries):
    return [
        CellState(arm, env_id, i, status, steps, 1000, seconds)
        for i, (arm, env_id, status, steps, seconds) in enumerate(entries)
    ]


STATES = states(
    ("ippo", "a", "finished", 1000, 50.0),
    ("ippo", "a", "running", 250, 0.0),
    ("ippo", "b", "failed", 100, 0.0),
    ("dynamic", "a", "waiting", 0, 0.0),
)


def shown(table):
    file = io.StringIO()
    Console(file=file, width=120).print(table)
    return file.getvalue()


def test_the_table_counts_cells_by_algorithm_and_environment():
    lines = shown(matrix_table("mine", STATES, 90.0)).splitlines()
    assert "mine: 1 of 4 runs done, 1 running, 1 failed, 1,350 of 4,000 joint steps, about 2 min left" in lines[0]
    row = next(line for line in lines if "ippo" in line)
    assert "1/2 done" in row and "running: 25 %" in row and "0/1 done" in row and "1 failed" in row
    assert "0/1 done" in next(line for line in lines if "dynamic" in line) and lines[-2].count("-") >= 1


def test_the_time_left_follows_from_what_is_finished():
    # 20 steps a second: 750 steps of ippo, and 1,000 of dynamic, of which nothing better is known
    assert TimeLeft(1).estimate(STATES) == pytest.approx(87.5)
    assert TimeLeft(2).estimate(STATES) == pytest.approx(87.5 / 2)
    # More processes than cells do not make them faster
    assert TimeLeft(9).estimate(STATES) == pytest.approx(87.5 / 2)
    # Nothing is known at first
    assert TimeLeft(1).estimate(STATES[1:]) is None


def test_before_anything_is_finished_the_speed_is_measured(monkeypatch):
    now = [0.0]
    monkeypatch.setattr("sb3_belief.study.live_table.time.monotonic", lambda: now[0])
    left = TimeLeft(1)
    left.estimate(states(("ippo", "a", "running", 100, 0.0)))
    now[0] = 10.0
    assert left.estimate(states(("ippo", "a", "running", 200, 0.0))) == pytest.approx(80.0)


@pytest.mark.parametrize(("seconds", "text"), [(40.4, "40 s"), (61, "1 min"), (3600, "1 h 00 min"), (7500, "2 h 05 min")])
def test_times_in_words(seconds, text):
    assert duration_text(seconds) == text


def test_without_a_terminal_there_are_lines(tmp_path, capsys):
    cell = Cell(tmp_path / "cells" / "arm" / "env" / "seed_0")
    record = {"study": "s", "arm": "arm", "algo": "ppo", "env": "env", "seed": 0, "status": "waiting", "attempts": 0}
    cell.create({**record, "n_timesteps": 1000, "final_episodes": 1, "options": {}, "settings": {}})
    with StudyDisplay("s", [cell], 1, Console(file=io.StringIO())) as display:
        display.tell("arm/env/seed_0: started")
        cell.write({**cell.read(), "status": "finished"})
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("s: 0 of 1 runs done") and lines[1].startswith("arm/env/seed_0: started")
    assert lines[-1] == "s: 1 of 1 runs done, 1,000 of 1,000 joint steps"


def test_the_terminal_shows_the_table(tmp_path):
    cell = Cell(tmp_path / "cells" / "arm" / "env" / "seed_0")
    record = {"study": "s", "arm": "arm", "algo": "ppo", "env": "env", "seed": 0, "status": "failed", "attempts": 1}
    cell.create({**record, "n_timesteps": 1000, "final_episodes": 1, "options": {}, "settings": {}})
    file = io.StringIO()
    console = Console(file=file, force_terminal=True, width=100)
    with StudyDisplay("s", [cell], 1, console) as display:
        display.tell("a line above")
        display.update()
    assert "1 failed" in file.getvalue() and "a line above" in file.getvalue()


def test_progress_is_read_from_the_end_of_the_tables(tmp_path):
    cell = Cell(tmp_path / "seed_0")
    run = cell.folder / "ppo" / "env_1"
    run.mkdir(parents=True)
    record = {"algo": "ppo", "status": "running", "n_timesteps": 1000}
    assert steps_done(cell, record) == 0
    (run / "run.json").write_text("{}")
    assert steps_done(cell, record) == 0
    rows = "".join(f"{step},{step / 7}\n" for step in range(40, 4040, 40))
    (run / "progress.csv").write_text(f"time/total_timesteps,x\n{rows}40")
    # The last line is being written
    assert steps_done(cell, record) == 4000
    assert steps_done(cell, {**record, "status": "finished"}) == 1000


def test_the_summary_of_a_study_that_has_ended():
    assert summary(STATES[:1], 3.0) == "1 of 1 runs done, 1,000 of 1,000 joint steps"
