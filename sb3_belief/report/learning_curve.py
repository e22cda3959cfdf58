"""Learning curve of one run."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

INK, CURVE, GREEDY = "#333333", "#1f6f8b", "#c8553d"
#: The quantities that a curve can show, with the labels of their axes
QUANTITIES = {"return": "team return per episode", "success": "success rate"}


def read_monitor(folder: str | os.PathLike[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Read the episodes in the team's ``monitor.csv``.

    :param folder: Folder of a run
    :return: Joint steps after which each episode ended (float ``[k]``, summed over the copies), team returns ``[k]`` and
        successes ``[k]`` (0 or 1, or NaN if the environment does not report them)
    :raises FileNotFoundError: If the run has no monitor file
    """
    # SB3's own reader needs pandas, which is too large a dependency for one file of numbers
    lines = (Path(folder) / "monitor.csv").read_text(encoding="utf-8").splitlines()
    # The first line is a comment with SB3's metadata
    names = lines[1].split(",")
    rows = [dict(zip(names, line.split(","), strict=True)) for line in lines[2:]]
    lengths = np.array([float(row["l"]) for row in rows])
    returns = np.array([float(row["r"]) for row in rows])
    numbers = {"True": 1.0, "False": 0.0}
    successes = np.array([numbers.get(row.get("is_success", ""), np.nan) for row in rows])
    return np.cumsum(lengths), returns, successes


def read_evaluations(folder: str | os.PathLike[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """
    Read ``evaluations.npz``, which SB3's ``EvalCallback`` writes.

    :param folder: Folder of a run
    :return: Joint steps ``[k]``, mean returns ``[k]`` and success rates ``[k]`` (NaN if the environment does not report
        them) of the team when it acts greedily. None if it was never evaluated
    """
    path = Path(folder) / "evaluations.npz"
    if not path.is_file():
        return None
    with np.load(path) as data:
        returns = data["results"].mean(axis=1)
        successes = data["successes"].mean(axis=1) if "successes" in data else np.full(len(returns), np.nan)
        return data["timesteps"].astype(float), returns, successes


def smooth(values: np.ndarray, window: int) -> np.ndarray:
    """
    Return the moving average of a series.

    :param values: The series, ``[k]``
    :param window: Number of values to average, at least 1
    :return: Mean of each value and the ``window - 1`` before it, ``[k]``. At the beginning the mean is over fewer values
    """
    sums = np.cumsum(np.concatenate([[0.0], values]))
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(ends - window, 0)
    return (sums[ends] - sums[starts]) / (ends - starts)


def read_episodes(folder: str | os.PathLike[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Read the episodes of a run and check that there are any.

    :param folder: Folder of a run
    :return: The arrays that ``read_monitor`` returns
    :raises FileNotFoundError: If the run has no monitor file
    :raises ValueError: If the run has finished no episode
    """
    steps, returns, successes = read_monitor(folder)
    if not len(steps):
        raise ValueError(f"No episode ended in {os.fspath(folder)!r}: nothing to draw.")
    return steps, returns, successes


def new_axes(title: str, quantity: str) -> tuple[Any, Any]:
    """
    Make an empty plot for curves over joint steps.

    :param title: Title of the plot, or an empty string for none
    :param quantity: What the y axis shows, a key of ``QUANTITIES``
    :return: Figure and axes of matplotlib
    :raises ImportError: If matplotlib is not installed
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError("Plots need matplotlib: pip install 'sb3-belief[plots]'.") from error
    # pyplot has global state and needs a backend. A figure of its own draws on machines without a screen too
    figure = Figure(figsize=(8.0, 4.5), dpi=130, layout="constrained")
    axes = figure.subplots()
    axes.set_xlabel("joint steps of the team")
    axes.set_ylabel(QUANTITIES[quantity])
    if quantity == "success":
        axes.set_ylim(-0.02, 1.02)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value / 1000:g}k" if value >= 1000 else f"{value:g}")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", alpha=0.2)
    if title:
        axes.set_title(title, loc="left", fontsize=11, color=INK)
    return figure, axes


def save_figure(figure: Any, output: str | os.PathLike[str]) -> Path:
    """
    Write a figure to an image file.

    :param figure: Figure of matplotlib
    :param output: Image file to write. Its folder is created if necessary
    :return: Path of the image
    """
    path = Path(output)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    return path


def plot_learning_curve(
    folder: str | os.PathLike[str],
    output: str | os.PathLike[str],
    bars: Mapping[str, float] | None = None,
    title: str = "",
) -> Path:
    """
    Plot a run's success rate over joint steps, or its return if the environment does not report successes.

    :param folder: Folder of the run
    :param output: Image file to write. Its suffix selects the format
    :param bars: {name: value} of horizontal lines to compare with, in the unit of the y axis
    :param title: Title of the plot
    :return: Path of the image
    :raises ImportError: If matplotlib is not installed
    :raises ValueError: If the run has finished no episode
    """
    steps, returns, successes = read_episodes(folder)
    has_successes = not np.isnan(successes).any()
    values = successes if has_successes else returns
    # A tenth of the run, so that short runs show a trend too
    window = max(1, min(500, len(values) // 10))

    figure, axes = new_axes(title, "success" if has_successes else "return")
    axes.plot(steps, smooth(values, window), color=CURVE, lw=1.8, label=f"while learning (mean of {window} episodes)")
    evaluations = read_evaluations(folder)
    if evaluations is not None:
        greedy = evaluations[2] if has_successes else evaluations[1]
        axes.plot(evaluations[0], greedy, color=GREEDY, marker="o", ms=4.5, lw=1.2, label="greedy, on other episodes")
    for name, value in (bars or {}).items():
        axes.axhline(value, color=INK, lw=0.9, ls=(0, (5, 4)), alpha=0.6, zorder=0)
        axes.annotate(
            f"{name}  {value:.2f}",
            xy=(1.0, value),
            xycoords=("axes fraction", "data"),
            xytext=(5, 0),
            textcoords="offset points",
            va="center",
            fontsize=9,
            color=INK,
        )
    axes.set_xlim(0, steps[-1])
    axes.legend(frameon=False, loc="best", fontsize=9)
    return save_figure(figure, output)
