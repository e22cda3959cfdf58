"""A study of seconds, and ways to run it."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import yaml

import sb3_belief
from sb3_belief.study.cell_record import all_cells
from sb3_belief.study.checks import check_study
from sb3_belief.study.specification import load_study
from sb3_belief.study.study_folder import planned_cells, prepare_folder

EASY = "traffic-junction-easy"
#: Five rollouts of 80 joint steps, and two evaluations
TINY: dict[str, Any] = {
    "name": "tiny",
    "environments": {EASY: {"n_envs": 4, "n_steps": 20, "batch_size": 40, "n_epochs": 1}},
    "algorithms": {"ippo": {"algo": "ppo", "params": {"policy": "MlpPolicy"}}},
    "seeds": 1,
    "n_timesteps": 400,
    "evaluation": {"every": 160, "episodes": 4, "copies": 2, "final_episodes": 6},
    "train": {"save_freq": 80, "device": "cpu"},
}


def waits(obs):
    """Wait, as a partner."""
    return 1


def write(folder, name="study.yml", **changes):
    """Write the file of the tiny study with some keys changed, and return its path."""
    path = Path(folder) / name
    path.write_text(yaml.safe_dump({**TINY, **changes}, sort_keys=False))
    return path


def prepared(tmp_path, **changes):
    """Return the cells of a tiny study whose folder has been made, without their being run."""
    study = load_study(write(tmp_path, **changes))
    folder = tmp_path / "logs" / study.name
    planned = planned_cells(study, folder, check_study(study, folder).configs)
    prepare_folder(study, folder, planned, retry=False)
    return [each.cell for each in planned]


def statuses(folder):
    return {cell.name: cell.read()["status"] for cell in all_cells(folder)}


def start(*words, **kwargs):
    """Start ``sb3-belief study`` in a process of its own."""
    root = str(Path(sb3_belief.__file__).parents[1])
    return subprocess.Popen(
        [sys.executable, "-m", "sb3_belief", "study", *map(str, words)],
        env={**os.environ, "PYTHONPATH": root},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        **kwargs,
    )


def record(cell):
    return json.loads(cell.path.read_text())
