"""The learning curve of one run."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

INK, CURVE, GREEDY = "#333333", "#1f6f8b", "#c8553d"
#: What a curve may show, and how its axis says so
QUANTITIES = {"return": "team return per episode", "success": "success rate"}


def read_monitor(folder: str | os.PathLike[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Read the team's ``monitor.csv``.

    :param folder: a run's folder
    :return: joint steps after which each episode ended (float [k], summed over copies), team returns [k], and successes [k]
        (0 or 1, or NaN where the environment does not say)
    :raises FileNotFoundError: if the run has no monitor file
    """
    # pandas, which SB3's own reader needs, is not worth a dependency for one file of numbers
    lines = (Path(folder) / "monitor.csv").read_text(encoding="utf-8").splitlines()
    names = lines[1].split(",")
    rows = [dict(zip(names, line.split(","), strict=True)) for line in lines[2:]]
    lengths = np.array([float(row["l"]) for row in rows])
    returns = np.array([float(row["r"]) for row in rows])
    says = {"True": 1.0, "False": 0.0}
    successes = np.array([says.get(row.get("is_success", ""), np.nan) for row in rows])
    return np.cumsum(lengths), returns, successes


def read_evaluations(folder: str | os.PathLike[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """
    Read ``evaluations.npz``, what SB3's ``EvalCallback`` wrote.

    :param folder: a run's folder
    :return: joint steps [k], mean returns [k] and success rates [k] (NaN where the environment does not say) of the greedy
        team, or None if it was never evaluated
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
    :param values: [k]
    :param window: number of values, at least 1
    :return: mean of each value and the ``window - 1`` before it [k]; over fewer at the beginning
    """
    sums = np.cumsum(np.concatenate([[0.0], values]))
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(ends - window, 0)
    return (sums[ends] - sums[starts]) / (ends - starts)


def read_episodes(folder: str | os.PathLike[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    :param folder: a run's folder
    :return: as ``read_monitor``
    :raises ValueError: if the run has not finished an episode
    """
    steps, returns, successes = read_monitor(folder)
    if not len(steps):
        raise ValueError(f"No episode ended in {os.fspath(folder)!r}: nothing to draw.")
    return steps, returns, successes


def new_axes(title: str, quantity: str) -> tuple[Any, Any]:
    """
    :param title: what stands above
    :param quantity: what the y axis shows, a key of ``QUANTITIES``
    :return: matplotlib's figure and axes for curves over joint steps
    :raises ImportError: if matplotlib is not installed
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError("Plots need matplotlib: pip install 'sb3-belief[plots]'.") from error
    # not pyplot: no global state and no backend, so it draws on any machine
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


def save(figure: Any, output: str | os.PathLike[str]) -> Path:
    """
    :param figure: matplotlib's
    :param output: picture to write; folders that are missing are made
    :return: its path
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
    Draw success rate (or return, where the environment tells no successes) over joint steps.

    :param folder: a run's folder
    :param output: picture to write; the ending says which format
    :param bars: {name: value} to draw as horizontal lines, in the unit of the y axis
    :param title: what stands above
    :return: the picture's path
    :raises ImportError: if matplotlib is not installed
    :raises ValueError: if the run has not finished an episode
    """
    steps, returns, successes = read_episodes(folder)
    tells_success = not np.isnan(successes).any()
    values = successes if tells_success else returns
    window = max(1, min(500, len(values) // 10))

    figure, axes = new_axes(title, "success" if tells_success else "return")
    axes.plot(steps, smooth(values, window), color=CURVE, lw=1.8, label=f"while learning (mean of {window} episodes)")
    evaluations = read_evaluations(folder)
    if evaluations is not None:
        greedy = evaluations[2] if tells_success else evaluations[1]
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
    return save(figure, output)
