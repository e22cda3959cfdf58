"""Small runs, and whether two of them are the same."""

import csv
import json

import numpy as np
import torch as th

from sb3_belief.cli.main import train_main
from sb3_belief.team import Team

EASY = "traffic-junction-easy"
SETTINGS = ["n_envs:4", "n_steps:20", "batch_size:40", "n_epochs:1"]
#: Five rollouts of 80 joint steps, and an evaluation after each second one
TOTAL = 400
WORDS = [
    *("--algo", "ppo", "--env", EASY, "--seed", "3", "-n", str(TOTAL), "--verbose", "0", "--save-freq", "80"),
    *("--eval-freq", "160", "--eval-episodes", "6", "--n-eval-envs", "3"),
]


def train(folder, *words, settings=SETTINGS):
    """Train a small run, and return the exit status and the run's folder."""
    status = train_main([*WORDS, "-f", str(folder), *words, "-params", *settings])
    return status, run_folder(folder)


def run_folder(folder):
    (record,) = folder.glob("*/*/run.json")
    return record.parent


def record_of(run):
    return json.loads((run / "run.json").read_text())


def table(path, skip=0):
    with open(path) as file:
        for _ in range(skip):
            next(file)
        return list(csv.DictReader(file))


def without_times(rows):
    # Columns come in the order of a set in SB3; an empty cell is no value
    return [
        {key: text for key, text in row.items() if key not in ("t", "time/fps", "time/time_elapsed") and text} for row in rows
    ]


def parameters(team):
    return {agent: model.policy.state_dict() for agent, model in Team.load(team).agents.items()}


def check_same_run(run, other):
    """Check that two runs have left the same: parameters, monitors, tables less times, evaluations."""
    mine, theirs = parameters(run / "team.zip"), parameters(other / "team.zip")
    assert mine.keys() == theirs.keys()
    for agent in mine:
        assert all(th.equal(mine[agent][key], theirs[agent][key]) for key in theirs[agent]), agent
    for name, skip in (("monitor.csv", 1), ("progress.csv", 0)):
        pattern = f"agents/**/*{name}"
        files = [name, *sorted(path.relative_to(other).as_posix() for path in other.glob(pattern))]
        assert files[1:] and files[1:] == sorted(path.relative_to(run).as_posix() for path in run.glob(pattern))
        for file in files:
            assert without_times(table(run / file, skip)) == without_times(table(other / file, skip)), file
    assert (run / "evaluations.npz").exists() == (other / "evaluations.npz").exists()
    if (other / "evaluations.npz").exists():
        with np.load(run / "evaluations.npz") as a, np.load(other / "evaluations.npz") as b:
            assert sorted(a) == sorted(b)
            for key in b:
                np.testing.assert_array_equal(a[key], b[key])
