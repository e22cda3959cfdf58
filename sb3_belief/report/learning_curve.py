"""Learning curve of one run."""

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sb3_belief.report.evaluations import read_evaluations

INK, CURVE, GREEDY = "#333333", "#1f6f8b", "#c8553d"
#: The quantities that a curve can show, with the labels of their axes
QUANTITIES = {"return": "team return per episode", "success": "success rate"}


def read_monitor(folder: str | os.PathLike[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Read the episodes in the team's ``monitor.csv``.

    The last line of a run that was killed, or still runs, may be cut off. It is left out.

    :param folder: Folder of a run
    :return: Joint steps after which each episode ended (float ``[k]``, summed over the copies), team returns ``[k]`` and
        successes ``[k]`` (0 or 1, or NaN if the environment does not report them)
    :raises FileNotFoundError: If the run has no monitor file
    :raises ValueError: If another line than the last one is damaged. The message has its number
    """
    path = Path(folder) / "monitor.csv"
    if not os.path.isfile(path):
        raise FileNotFoundError(f"No monitor.csv in {os.fspath(folder)!r}: give the folder of a run, which has one.")
    # SB3's own reader needs pandas, which is too large a dependency for one file of numbers. Bytes that are no text are left
    # in the line that is then found to be damaged
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines(keepends=True)
    # Even a number that can be read may be the beginning of another one
    if lines and not lines[-1].endswith("\n"):
        lines.pop()
    # The first line is a comment with SB3's metadata
    names = lines[1].strip().split(",") if len(lines) > 1 else []
    rows, lengths, returns = [], np.zeros(max(len(lines) - 2, 0)), np.zeros(max(len(lines) - 2, 0))
    for index, line in enumerate(lines[2:]):
        try:
            rows.append(dict(zip(names, line.strip().split(","), strict=True)))
            lengths[index], returns[index] = float(rows[-1]["l"]), float(rows[-1]["r"])
        except (KeyError, ValueError) as error:
            raise ValueError(f"{path}, line {index + 3}: {line.strip()!r} is not an episode: the file is damaged.") from error
    numbers = {"True": 1.0, "False": 0.0}
    successes = np.array([numbers.get(row.get("is_success", ""), np.nan) for row in rows])
    return np.cumsum(lengths), returns, successes


class Part(NamedTuple):
    """
    Part of a training that was continued.

    :param folder: Folder of the run
    :param start: Joint step at which it starts
    :param end: Joint step at which the next run continues it, infinite for the last one
    """

    folder: Path
    start: float
    end: float


def parts_of_run(folder: str | os.PathLike[str]) -> list[Part]:
    """
    Return the runs whose training a run continues, and the run itself.

    :param folder: Folder of a run
    :return: The runs, from the first one on. Those that are no longer where they were are left out
    """
    parts: list[Part] = []
    path: Path | None = Path(folder)
    while path is not None and path not in [part.folder for part in parts]:
        start, trained = _start_of(path)
        parts.insert(0, Part(path, start, parts[0].start if parts else math.inf))
        # A checkpoint lies one folder deeper than the final team
        above = list(Path(trained).parents)[:2] if start and trained else []
        # os.path, because Path.is_file raises for a name that is too long
        path = next((each for each in above if os.path.isfile(each / "monitor.csv")), None)
    return parts


def _start_of(folder: Path) -> tuple[float, str]:
    """Return the joint step at which a run starts, and the team that it continues. 0 and an empty text for none."""
    try:
        record = json.loads((folder / "run.json").read_text(encoding="utf-8"))
        start, trained = float(record["start_timesteps"]), record["trained_agent"]
    # A curve needs no record: without one that can be read, the run is taken for one that continues nothing
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
        return 0.0, ""
    return (start, trained) if isinstance(trained, str) and 0 < start < math.inf else (0.0, "")


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
    Read the episodes of a run, and of the runs that it continues, and check that there are any.

    :param folder: Folder of a run
    :return: The arrays that ``read_monitor`` returns, for all of these runs on one axis of joint steps
    :raises FileNotFoundError: If the run has no monitor file
    :raises ValueError: If no episode has ended
    """
    read = []
    for part in parts_of_run(folder):
        steps, returns, successes = read_monitor(part.folder)
        # A run that is continued from a checkpoint may have gone on itself
        kept = steps + part.start <= part.end
        read.append((steps[kept] + part.start, returns[kept], successes[kept]))
    steps, returns, successes = (np.concatenate(arrays) for arrays in zip(*read, strict=True))
    if not len(steps):
        raise ValueError(f"No episode ended in {os.fspath(folder)!r}: nothing to draw.")
    return steps, returns, successes


def binned(steps: np.ndarray, values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """
    Return the mean value of the episodes that ended in each bin of joint steps.

    :param steps: Joint steps after which each episode ended, ``[k]``
    :param values: Values of these episodes, ``[k]``
    :param edges: Edges of the bins in ascending order, ``[n + 1]``. A bin includes its right edge
    :return: Mean of each bin, ``[n]``. NaN for a bin in which no episode ended
    """
    bins = np.digitize(steps, edges, right=True) - 1
    inside = (bins >= 0) & (bins < len(edges) - 1)
    counts = np.bincount(bins[inside], minlength=len(edges) - 1)
    sums = np.bincount(bins[inside], weights=values[inside], minlength=len(edges) - 1)
    # 0 / 0 is NaN, which is drawn as a gap
    with np.errstate(invalid="ignore"):
        return sums / counts


def plot_learning_curve(
    folder: str | os.PathLike[str],
    output: str | os.PathLike[str],
    bars: Mapping[str, float] | None = None,
    title: str = "",
    quantity: str | None = None,
) -> Path:
    """
    Plot a run's success rate or return over joint steps. A run that continues others is drawn with these, on one axis.

    :param folder: Folder of the run
    :param output: Image file to write. Its suffix selects the format
    :param bars: {name: value} of horizontal lines to compare with, in the unit of the y axis
    :param title: Title of the plot
    :param quantity: What to plot, ``"return"`` or ``"success"``. None for successes if the environment reports them, and
        returns otherwise
    :return: Path of the image
    :raises ImportError: If matplotlib is not installed
    :raises ValueError: If the run has finished no episode, for another quantity, or for successes that are not reported
    """
    if quantity is not None and quantity not in QUANTITIES:
        raise ValueError(f"quantity is {quantity!r}; it must be one of {', '.join(map(repr, QUANTITIES))}.")
    steps, returns, successes = read_episodes(folder)
    has_successes = not np.isnan(successes).any()
    if quantity == "success" and not has_successes:
        raise ValueError(f"{os.fspath(folder)!r} reports no successes; draw quantity='return'.")
    of_success = has_successes if quantity is None else quantity == "success"
    values = successes if of_success else returns
    # A tenth of the run, so that short runs show a trend too
    window = max(1, min(500, len(values) // 10))

    figure, axes = _new_axes(title, "success" if of_success else "return")
    axes.plot(steps, smooth(values, window), color=CURVE, lw=1.8, label=f"while learning (mean of {window} episodes)")
    label: str | None = "greedy, on other episodes"
    for part in parts_of_run(folder):
        evaluations = read_evaluations(part.folder)
        if evaluations is not None:
            # SB3 counts the joint steps of evaluations on from those of the run before
            kept = evaluations.steps <= part.end
            greedy = (evaluations.success_rates if of_success else evaluations.mean_returns)[kept]
            axes.plot(evaluations.steps[kept], greedy, color=GREEDY, marker="o", ms=4.5, lw=1.2, label=label)
            label = None
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
    path = Path(output)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    return path


def _new_axes(title: str, quantity: str) -> tuple[Any, Any]:
    """Return an empty plot for curves over joint steps: its figure and axes."""
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
