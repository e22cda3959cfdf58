"""What the folder of a run tells, also if the run was killed, failed, or is damaged."""

import csv
import json
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sb3_belief.report.evaluations import read_evaluations
from sb3_belief.report.learning_curve import read_episodes, smooth
from sb3_belief.report.study_page.facts import DIAGNOSTICS, Series
from sb3_belief.zoo.run_files import is_tuning
from sb3_belief.zoo.run_folder import CONFIG, RECORD
from sb3_belief.zoo.run_lock import LOCK

ERROR = "error.txt"
# Status of a run whose record cannot be read, and of one whose process has gone without a word
DAMAGED, KILLED = "damaged", "killed"
# A traceback is read from its end
_MOST_ERROR = 20_000


@dataclass(frozen=True)
class RunData:
    """
    Record and configuration of a run.

    :param folder: Its folder
    :param status: ``"finished"``, ``"running"``, ``"interrupted"``, ``"failed"``, ``"killed"`` or ``"damaged"``
    :param algo: Its algorithm; that of its path if the record is damaged
    :param env: Id of its environment; likewise
    :param seed: Its seed; None if it is not known
    :param record: Its record; empty if it is damaged
    :param settings: Its settings, of ``config.yml``; empty if there are none
    """

    folder: Path
    status: str
    algo: str
    env: str
    seed: int | None
    record: dict[str, Any] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)

    @property
    def note(self) -> str:
        """How its algorithm is trained, if it is not decentralised; empty otherwise."""
        return str(self.record.get("note") or "")

    @property
    def joint_steps(self) -> int | None:
        """Joint steps that it has trained, as its record says or else the end of its table."""
        steps = self.record.get("timesteps")
        return steps if isinstance(steps, int) else _last_steps(self.folder / "progress.csv")

    @property
    def total_steps(self) -> int | None:
        """Joint steps that it shall train, or None if that is not known."""
        steps = self.record.get("total_timesteps")
        return steps if isinstance(steps, int) else None

    @property
    def error(self) -> str:
        """Its traceback, or else what its record says of its failure. Empty for none."""
        try:
            text = (self.folder / ERROR).read_text(encoding="utf-8", errors="replace").strip()
        except OSError:
            text = ""
        return text[-_MOST_ERROR:] or str(self.record.get("error") or "")


def run_folders(folder: Path) -> Iterator[Path]:
    """
    Iterate over the folders of runs in a folder, at any depth, without the runs of tunings: each has settings of its own, and
    is too short to be compared with others.

    :param folder: The folder, which may be that of a run itself, or of a tuning, whose runs are meant then
    :return: The folders, in the order of their paths
    """
    for path, folders, files in os.walk(folder):
        if path != str(folder) and is_tuning(Path(path)):
            folders.clear()
            continue
        # What was being written when the record was damaged or lost is still a run
        if RECORD in files or (CONFIG in files and "monitor.csv" in files):
            folders.clear()
            yield Path(path)
        folders[:] = sorted(name for name in folders if not name.startswith("."))


def read_run(folder: Path) -> RunData:
    """
    Read the record and the configuration of a run.

    :param folder: Its folder
    :return: What they say
    """
    settings = _settings(folder)
    try:
        record = json.loads((folder / RECORD).read_text(encoding="utf-8"))
        whole = isinstance(record, dict) and all(isinstance(record.get(name), str) for name in ("status", "algo", "env"))
    except (OSError, ValueError, RecursionError):
        record, whole = {}, False
    if not whole:
        env = next(iter(settings), folder.name.rpartition("_")[0] or folder.name)
        return RunData(folder, DAMAGED, folder.parent.name, str(env), None, {}, _of_env(settings, str(env)))
    status, seed = record["status"], record.get("seed")
    if status == "running" and not _is_alive(folder):
        status = KILLED
    known = seed if isinstance(seed, int) else None
    return RunData(folder, status, record["algo"], record["env"], known, record, _of_env(settings, record["env"]))


def evaluation_series(folder: Path, quantity: str) -> dict[str, Series]:
    """
    Return the curves of a run, as far as its files can be read.

    :param folder: Its folder
    :param quantity: ``"return"`` or ``"success"``
    :return: {name of the curve: its steps and values}
    """
    found: dict[str, Series] = {}
    column = 2 if quantity == "success" else 1
    try:
        evaluations = read_evaluations(folder)
        if evaluations is not None:
            values = evaluations.success_rates if quantity == "success" else evaluations.mean_returns
            found["evaluations, greedy"] = evaluations.steps, values
    except ValueError:
        # The page says so, see ``reporting``
        pass
    try:
        episodes = read_episodes(folder)
        window = max(1, min(500, len(episodes[0]) // 10))
        found[f"while learning, mean of {window} episodes"] = episodes[0], smooth(episodes[column], window)
    except (OSError, ValueError):
        pass
    return {name: (steps, values) for name, (steps, values) in found.items() if not np.isnan(values).all()}


def diagnostic_series(folder: Path) -> dict[str, dict[str, Series]]:
    """
    Return the diagnostics of the beliefs of a run's agents.

    :param folder: Folder of the run
    :return: {name of the diagnostic: {agent: its steps and values}}
    """
    found: dict[str, dict[str, Series]] = {}
    for path in sorted((folder / "agents").glob("*/progress.csv")):
        rows = _numbers(path)
        steps = np.array([row.get("time/total_timesteps", np.nan) for row in rows])
        for key in DIAGNOSTICS:
            values = np.array([row.get(key, np.nan) for row in rows])
            known = np.isfinite(values) & np.isfinite(steps)
            if known.any():
                found.setdefault(key, {})[path.parent.name] = steps[known], values[known]
    return found


def _numbers(path: Path) -> list[dict[str, float]]:
    """Read a table of SB3's, without what is no number. A row that was cut off is left out."""
    try:
        with open(path, newline="", encoding="utf-8", errors="replace") as file:
            lines = file.readlines()
        # Even a number that can be read may be the beginning of another one
        rows = [row for row in csv.reader(line for line in lines if line.endswith("\n")) if row]
    except (OSError, csv.Error):
        return []
    names = rows[0] if rows else []
    return [
        {name: number for name, text in zip(names, row, strict=True) if (number := _number(text)) is not None}
        for row in rows[1:]
        if len(row) == len(names)
    ]


def _number(text: str) -> float | None:
    try:
        number = float(text)
    except ValueError:
        return None
    return number if math.isfinite(number) else None


def _last_steps(path: Path) -> int | None:
    steps = [row["time/total_timesteps"] for row in _numbers(path) if "time/total_timesteps" in row]
    return int(steps[-1]) if steps else None


def _settings(folder: Path) -> dict[str, Any]:
    try:
        data = yaml.safe_load((folder / CONFIG).read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError, RecursionError):
        return {}
    return data if isinstance(data, dict) else {}


def _of_env(settings: dict[str, Any], env: str) -> dict[str, Any]:
    own = settings.get(env)
    return own if isinstance(own, dict) else {}


def _is_alive(folder: Path) -> bool:
    """Return whether a process holds the run, as far as the system tells."""
    try:
        import fcntl
    except ImportError:
        return (folder / LOCK).exists()
    try:
        with open(folder / LOCK, encoding="utf-8") as file:
            # Shared and only for a moment: whoever wants to hold it alone meanwhile is told that it is held
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False
