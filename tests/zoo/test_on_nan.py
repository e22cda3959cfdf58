"""Runs in which an update is not finite, on the command line."""

import json

import numpy as np
import pytest
import torch as th

from sb3_belief.cli.main import train_main
from sb3_belief.team import Team
from sb3_belief.zoo.run_folder import CHECKPOINTS
from tests.zoo.runs import SETTINGS, record_of, table, train

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")
# The first update of each agent fails
BAD = [*SETTINGS, "learning_rate:1e30"]


def is_finite(path):
    team = Team.load(path)
    return all(bool(th.isfinite(p).all()) for model in team.agents.values() for p in model.policy.parameters())


def test_a_run_ends_at_an_update_that_is_not_finite_and_may_go_on_without_such(tmp_path, capsys):
    status, run = train(tmp_path, settings=BAD)
    said = capsys.readouterr().err
    assert (
        status == 1
        and "loss or parameters are not finite after its update at joint step 80" in said
        and "learning_rate is 1e+30" in said
    )
    record = record_of(run)
    assert record["status"] == "failed" and "not finite" in record["error"] and record["options"]["on_nan"] == "raise"
    # What an update of before left
    files = [run / "team.zip", *(run / CHECKPOINTS).glob("*.zip")]
    assert len(files) > 1 and all(is_finite(path) for path in files)
    assert train_main(["--resume", str(run), "--on-nan", "skip"]) == 0
    assert record_of(run)["status"] == "finished" and record_of(run)["options"]["on_nan"] == "skip"
    assert is_finite(run / "team.zip")
    # One for each rollout but the last, whose update no table shows
    rows = [row for row in table(run / "progress.csv") if row["time/iterations"]]
    team = Team.load(run / "team.zip")
    assert [float(row["train/skipped_updates"] or 0) for row in rows] == [0.0, *(len(team.agents) * np.arange(1.0, 5.0))]
    assert {vars(model)["skipped_updates"] for model in team.agents.values()} == {5}


def test_skip_is_recorded_and_changes_nothing_of_a_healthy_run(tmp_path):
    (status, run), (_, other) = (train(tmp_path / name, *words) for name, words in (("a", ["--on-nan", "skip"]), ("b", [])))
    assert status == 0 and json.loads((run / "run.json").read_text())["options"]["on_nan"] == "skip"
    mine, theirs = (Team.load(each / "team.zip").agents for each in (run, other))
    for agent, model in mine.items():
        assert all(map(th.equal, model.policy.parameters(), theirs[agent].policy.parameters()))
    assert "train/skipped_updates" not in table(run / "progress.csv")[-1]


def test_other_words_are_refused(capsys):
    with pytest.raises(SystemExit):
        train_main(["--on-nan", "ignore"])
    assert "--on-nan: invalid choice: 'ignore'" in capsys.readouterr().err
