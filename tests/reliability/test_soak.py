"""What a soak counts and injects. The soak itself runs for an hour: ``make soak``."""

import json
import os
import random
import re
import shutil
import tempfile
from pathlib import Path

import pytest

from sb3_belief.team.checkpoints import checkpoint_files
from sb3_belief.zoo.run_folder import whole_checkpoints
from tests.reliability.ordered_env import OrderedEnv
from tests.reliability.soak.__main__ import check_temporary_files, soak
from tests.reliability.soak.faults import damage_newest
from tests.reliability.soak.memory import growth
from tests.reliability.soak.report import BEGIN, END, Report
from tests.zoo.runs import train


def filled() -> Report:
    report = Report(seed=7, minutes=12.4, runs=3)
    report.faults.update({"SIGTERM": 2, "SIGKILL": 1})
    assert report.check("the team loads", True, "")
    assert not report.check("the team loads", [], "run 2")
    report.memory = {"first": 300.0, "after": 10.0, "last": 303.0, "growth": 0.01, "steps": 12345}
    return report


def test_the_tables_say_what_was_counted(capsys):
    text = filled().to_markdown()
    assert text.startswith("12 minutes with seed 7 on ") and "3 runs, 3 faults, 2 checks, 1 violations." in text
    for line in ("| SIGTERM | 2 |", "| SIGKILL | 1 |", "| the team loads | 2 | 1 |"):
        assert line in text.splitlines()
    assert "300 MiB after 10 minutes, 303 MiB at the end (+1.0%; at most +5 %), over 12,345 joint steps" in text
    assert capsys.readouterr().out == "VIOLATION: the team loads: run 2\n"


def test_the_tables_take_the_place_of_those_before(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(f"# Page\n\n{BEGIN}\n\nold\n\n{END}\n\nMore.\n")
    for _ in range(2):
        filled().write_into(page)
        assert page.read_text() == f"# Page\n\n{BEGIN}\n\n{filled().to_markdown()}\n{END}\n\nMore.\n"
    page.write_text("# Page\n")
    with pytest.raises(ValueError, match="once each"):
        filled().write_into(page)


def test_a_report_is_json_too():
    found = json.loads(filled().to_json())
    assert found["faults"] == {"SIGTERM": 2, "SIGKILL": 1} and found["violations"] == ["the team loads: run 2"]


def test_teams_that_found_no_other_place_are_no_leftovers(tmp_path):
    temporary, outputs = tmp_path / "tmp", tmp_path / "outputs"
    for folder in (temporary, outputs):
        folder.mkdir()
    _, run = train(tmp_path / "logs", "-n", "80", "--eval-freq", "-1")
    shutil.copy(run / "team.zip", temporary / "ppo_team.zip")
    report = Report(0)
    check_temporary_files(temporary, outputs, report)
    assert report.violations == ["no temporary file is left: ['ppo_team.zip']"]
    (outputs / "output_1.txt").write_text(f"The team has been saved as {temporary / 'ppo_team.zip'} instead.\n")
    report = Report(0)
    check_temporary_files(temporary, outputs, report)
    assert not report.violations and report.checks == {"the team loads": 1, "no temporary file is left": 1}
    (temporary / "ppo_team.zip").write_bytes(b"PK")
    check_temporary_files(temporary, outputs, report)
    assert len(report.violations) == 1


def test_growth_counts_from_a_moment_on():
    # Grows fast, then by a tenth within the hour
    samples = [(60.0 * minute, 100.0 + 10 * min(minute, 10) + 0.4 * max(minute - 10, 0)) for minute in range(61)]
    found = growth(samples, after=600.0)
    assert found is not None
    first, last, grown = found
    # Medians of minutes 10 to 14 and 56 to 60
    assert first == pytest.approx(200.8) and last == pytest.approx(219.2)
    assert grown == pytest.approx(last / first - 1)
    assert growth(samples, after=3600.0) is None and growth([], after=0.0) is None


@pytest.mark.parametrize("seed", range(8))
def test_damaged_checkpoints_are_found(tmp_path, seed, capsys):
    _, run = train(tmp_path, "-n", "160", "--eval-freq", "-1")
    names = [path.name for _, path in checkpoint_files(run / "checkpoints")]
    assert len(names) == 2
    damaged = damage_newest(run / "checkpoints", random.Random(seed))
    assert damaged is not None and damaged[1].name == names[-1]
    assert [path.name for path in whole_checkpoints(run)] == names[:1]
    assert f"{damaged[1]} is damaged" in capsys.readouterr().err
    damaged[1].unlink()
    assert damage_newest(run / "checkpoints", random.Random(seed)) is None


def test_the_environment_obeys_once(tmp_path):
    orders = tmp_path / "orders"
    env, quiet = OrderedEnv(str(orders)), OrderedEnv()
    for each in (env, quiet):
        each.reset(seed=0)
    actions = {"one": 0, "other": 0}
    env.step(actions)
    orders.write_text("raise")
    quiet.step(actions)
    with pytest.raises(RuntimeError, match="as ordered"):
        env.step(actions)
    assert not list(tmp_path.iterdir())
    env.step(actions)
    assert (env.steps, quiet.steps) == (2, 1)


def test_a_folder_whose_path_is_too_long_for_sockets_is_refused(tmp_path):
    folder = tmp_path / ("x" * 80)
    with pytest.raises(ValueError, match="take a shorter folder"):
        soak(0.1, 0, folder)
    assert not folder.exists()


@pytest.mark.slow
@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="looks for processes in /proc")
def test_a_short_soak_finds_nothing():
    # Not pytest's own, whose path is too long
    with tempfile.TemporaryDirectory(prefix="soak-") as folder:
        report = soak(1.0, 5, Path(folder))
    assert not report.violations
    assert report.runs > 0 and sum(report.faults.values()) > 0 and report.checks["the team loads"] > 0


def test_make_soak_names_what_there_is():
    text = Path(__file__).parents[2].joinpath("Makefile").read_text()
    assert re.search(r"^soak: .*## ", text, re.MULTILINE)
    assert "-m tests.reliability.soak --minutes $(SOAK_MINUTES) --seed $(SOAK_SEED)" in text
