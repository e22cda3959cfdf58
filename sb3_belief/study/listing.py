"""The list of runs in a folder."""

import os
import sys
import time
from datetime import datetime
from pathlib import Path

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from sb3_belief.report.evaluations import read_evaluations
from sb3_belief.report.learning_curve import read_episodes
from sb3_belief.study.groups import LENGTH, labels
from sb3_belief.study.run_reading import DAMAGED, RunData, read_run, run_folders
from sb3_belief.study.tuning_folder import tuning_folders
from sb3_belief.zoo.errors import ConfigError, short

_COLUMNS = ("run", "algorithm", "environment", "seed", "status", "joint steps", "last score", "age", "training")
_STYLES = {"finished": "green", "running": "cyan", "failed": "red", DAMAGED: "red"}
_LAST_EPISODES = 100


def print_runs(folder: str) -> None:
    """
    Print the runs in a folder, at any depth: a table on a terminal, and lines with tabs elsewhere.

    :param folder: The folder
    :raises ConfigError: If there is no such folder
    """
    if not os.path.isdir(folder):
        raise ConfigError(f"runs: no folder {short(folder)}: give one with runs, such as that of train -f (default: logs).")
    runs = [read_run(path) for path in run_folders(Path(folder))]
    rows = [_row(run, label, Path(folder)) for run, label in zip(runs, labels(runs, ignored=LENGTH), strict=True)]
    for tuning in tuning_folders(Path(folder)):
        print(f"The trials of the tuning {tuning} are not listed here: sb3-belief runs {tuning} does.", file=sys.stderr)
    console = Console()
    if not console.is_terminal:
        for row in (_COLUMNS, *rows):
            # Names of folders may hold anything
            print("\t".join(" ".join(cell.split()) for cell in row))
        return
    table = Table(box=SIMPLE_HEAD, title=f"{len(rows)} runs in {folder}", title_justify="left")
    for name in _COLUMNS:
        table.add_column(
            name, justify="right" if name in ("seed", "joint steps", "last score", "age") else "left", overflow="fold"
        )
    for row in rows:
        styled = [
            f"[{_STYLES.get(cell, 'yellow')}]{cell}[/]" if name == "status" else cell.replace("[", "\\[")
            for name, cell in zip(_COLUMNS, row, strict=True)
        ]
        table.add_row(*styled)
    console.print(table)


def _row(run: RunData, label: str, folder: Path) -> tuple[str, ...]:
    steps, total = run.joint_steps, run.total_steps
    progress = "-" if steps is None else f"{steps:,}"
    if run.status != "finished" and total:
        progress += f" of {total:,}"
    return (
        os.path.relpath(run.folder, folder),
        label,
        run.env,
        "-" if run.seed is None else str(run.seed),
        run.status,
        progress,
        _last_score(run.folder),
        _age(run),
        run.note or ("decentralised" if run.record else "-"),
    )


def _last_score(folder: Path) -> str:
    """Return the mean of the last evaluation, or else that of the last episodes of the training."""
    try:
        evaluations = read_evaluations(folder)
        if evaluations is not None:
            return _score(evaluations.mean_returns[-1], evaluations.success_rates[-1], "")
        _, returns, successes = read_episodes(folder)
    except (OSError, ValueError) as error:
        return "damaged" if "damaged" in str(error) else "-"
    return _score(returns[-_LAST_EPISODES:].mean(), successes[-_LAST_EPISODES:].mean(), " (learning)")


def _score(mean_return: float, success: float, words: str) -> str:
    return f"return {mean_return:.4g}{words}" if np.isnan(success) else f"success {success:.3f}{words}"


def _age(run: RunData) -> str:
    """Return how long ago a run started, or its folder was last changed if its record does not say."""
    try:
        then = datetime.strptime(str(run.record.get("started")), "%Y-%m-%dT%H:%M:%S%z").timestamp()
    except ValueError:
        then = run.folder.stat().st_mtime
    seconds = max(time.time() - then, 0.0)
    for unit, length in (("d", 86400), ("h", 3600), ("m", 60)):
        if seconds >= length:
            return f"{int(seconds / length)}{unit}"
    return f"{int(seconds)}s"
