"""Learning curves of several runs beside each other."""

import itertools
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from sb3_belief.report.learning_curve import INK, QUANTITIES, new_axes, read_episodes, save

COLOURS = ("#1f6f8b", "#c8553d", "#7a8b3c", "#6b5b95", "#b8860b", "#555555")


def binned(steps: np.ndarray, values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """
    :param steps: joint steps after which each episode ended, [k]
    :param values: of these episodes, [k]
    :param edges: borders of the bins, rising, [n + 1]
    :return: mean of each bin's episodes, [n]; NaN where none ended
    """
    places = np.digitize(steps, edges, right=True) - 1
    inside = (places >= 0) & (places < len(edges) - 1)
    counts = np.bincount(places[inside], minlength=len(edges) - 1)
    sums = np.bincount(places[inside], weights=values[inside], minlength=len(edges) - 1)
    with np.errstate(invalid="ignore"):
        return sums / counts


def plot_comparison(
    runs: Mapping[str, Sequence[str | os.PathLike[str]]],
    output: str | os.PathLike[str],
    quantity: str = "return",
    n_bins: int = 40,
    title: str = "",
) -> Path:
    """
    Draw what was earned while learning: the mean over the runs of each name as a line, from the lowest to the highest run as
    a band.

    :param runs: {name: folders of its runs}
    :param output: picture to write; the ending says which format
    :param quantity: ``"return"`` or ``"success"``
    :param n_bins: into how many parts the joint steps are cut; each episode counts in the part in which it ended
    :param title: what stands above
    :return: the picture's path
    :raises ImportError: if matplotlib is not installed
    :raises ValueError: for another quantity, or if a run has not finished an episode or tells no successes
    """
    if quantity not in QUANTITIES:
        raise ValueError(f"quantity is {quantity!r}; it must be one of {', '.join(map(repr, QUANTITIES))}.")
    curves = {}
    for name, folders in runs.items():
        curves[name] = [read_episodes(folder) for folder in folders]
        for folder, (_, _, successes) in zip(folders, curves[name], strict=True):
            if quantity == "success" and np.isnan(successes).any():
                raise ValueError(f"{os.fspath(folder)!r} tells no successes; draw quantity='return'.")

    figure, axes = new_axes(title, quantity)
    edges = np.linspace(0, max(steps[-1] for runs_of in curves.values() for steps, _, _ in runs_of), n_bins + 1)
    middles = (edges[1:] + edges[:-1]) / 2
    for (name, runs_of), colour in zip(curves.items(), itertools.cycle(COLOURS), strict=False):
        rows = np.array([binned(steps, returns if quantity == "return" else wins, edges) for steps, returns, wins in runs_of])
        axes.plot(middles, rows.mean(axis=0), color=colour, lw=1.8, label=name)
        axes.fill_between(middles, rows.min(axis=0), rows.max(axis=0), color=colour, alpha=0.15, lw=0)
    axes.set_xlim(0, edges[-1])
    axes.legend(frameon=False, loc="best", fontsize=9, labelcolor=INK)
    return save(figure, output)
