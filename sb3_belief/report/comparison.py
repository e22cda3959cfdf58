"""Learning curves of several runs in one plot."""

import itertools
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from sb3_belief.report.learning_curve import INK, check_quantity, new_axes, no_successes, read_episodes, save_figure

COLOURS = ("#1f6f8b", "#c8553d", "#7a8b3c", "#6b5b95", "#b8860b", "#555555")


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
    # 0 / 0 is NaN, which matplotlib draws as a gap
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
    Plot the learning curves of groups of runs.

    Each group has a line, the mean over its runs, and a band from its lowest to its highest run.

    :param runs: {name of the group: folders of its runs}
    :param output: Image file to write. Its suffix selects the format
    :param quantity: What to plot, ``"return"`` or ``"success"``
    :param n_bins: Number of bins into which the joint steps are divided. An episode counts in the bin in which it ended
    :param title: Title of the plot
    :return: Path of the image
    :raises ImportError: If matplotlib is not installed
    :raises ValueError: For another quantity, or if a run has finished no episode, or reports no successes although
        ``quantity`` is ``"success"``
    """
    check_quantity(quantity)
    curves = {}
    for name, folders in runs.items():
        curves[name] = [read_episodes(folder) for folder in folders]
        for folder, (_, _, successes) in zip(folders, curves[name], strict=True):
            if quantity == "success" and np.isnan(successes).any():
                raise no_successes(folder)

    figure, axes = new_axes(title, quantity)
    edges = np.linspace(0, max(steps[-1] for runs_of in curves.values() for steps, _, _ in runs_of), n_bins + 1)
    middles = (edges[1:] + edges[:-1]) / 2
    for (name, runs_of), colour in zip(curves.items(), itertools.cycle(COLOURS), strict=False):
        rows = np.array([binned(steps, returns if quantity == "return" else wins, edges) for steps, returns, wins in runs_of])
        axes.plot(middles, rows.mean(axis=0), color=colour, lw=1.8, label=name)
        axes.fill_between(middles, rows.min(axis=0), rows.max(axis=0), color=colour, alpha=0.15, lw=0)
    axes.set_xlim(0, edges[-1])
    axes.legend(frameon=False, loc="best", fontsize=9, labelcolor=INK)
    return save_figure(figure, output)
