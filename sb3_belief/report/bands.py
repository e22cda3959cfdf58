"""Curves with pointwise bands: sample efficiency over training, and performance profiles."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from sb3_belief.report.resampling import RESAMPLES, bootstrap_interval
from sb3_belief.report.statistics import Scores, arms_of, interquartile_mean, rescaled, shared, strata_of

#: {environment: {arm: (joint steps [k], values [seeds, k], seeds)}}, as ``episodes.curves`` returns them
Curves: TypeAlias = Mapping[str, Mapping[str, tuple[np.ndarray, np.ndarray, list[int]]]]


class Band(NamedTuple):
    """
    A curve with a pointwise band: each of its intervals is one of its own, and says nothing of the curve as a whole.

    :param x: Positions, ``[k]``
    :param values: The curve, ``[k]``
    :param low: Lower ends of the intervals, ``[k]``. None if there is one seed only
    :param high: Upper ends of the intervals, or None
    :param n_seeds: Seeds of each environment; the fewest, if they are not equally many
    """

    x: np.ndarray
    values: np.ndarray
    low: np.ndarray | None
    high: np.ndarray | None
    n_seeds: int


def efficiency_curve(
    steps: np.ndarray,
    values: np.ndarray,
    *,
    method: str = "corrected",
    n_resamples: int = RESAMPLES,
    limits: tuple[float, float] | None = None,
) -> Band:
    """
    Return the interquartile mean over seeds at each evaluation of one arm in one environment.

    :param steps: Joint steps of the evaluations, ``[k]``
    :param values: The value of each seed at each evaluation, ``[seeds, k]``. Evaluations that a seed has not had are NaN; they
        are left out for all, since a mean over other seeds would be of something else
    :param method: Kind of interval, see ``resampling.bootstrap_interval``
    :param n_resamples: Number of resamples
    :param limits: Lowest and highest possible value, (0, 1) for success rates, if there are such; intervals end there
    :return: The curve in the environment's own unit, empty if the seeds have no evaluation in common
    """
    common = np.isfinite(values).all(axis=0)
    return _band(steps[common], [values[:, common].T], method, n_resamples, limits)


def overall_curves(
    curves: Curves,
    bounds: Mapping[str, tuple[float, float]],
    *,
    n_points: int = 51,
    method: str = "corrected",
    n_resamples: int = RESAMPLES,
    limits: tuple[float, float] | None = None,
) -> dict[str, Band]:
    """
    Return the interquartile mean over the seeds of all environments, over the share of the training that has passed.

    Between two evaluations a run's curve is a straight line. The share is that of the last evaluation that all runs of all
    arms have had in an environment.

    :param curves: The curves. Only the environments in which all arms have runs count
    :param bounds: {environment: (value that becomes 0, value that becomes 1)}, e.g. ``statistics.score_range(scores)`` of the
        final scores, or (0, 1) for success rates
    :param n_points: Number of positions between 0 and 1. Those before an environment's first evaluation are left out
    :param method: Kind of interval, see ``resampling.bootstrap_interval``
    :param n_resamples: Number of resamples
    :param limits: Lowest and highest possible value, (0, 1) for success rates, if there are such; intervals end there
    :return: {arm: curve of normalised values}, empty if no environment has all arms or an evaluation of all runs
    """
    arms = list(dict.fromkeys(arm for of_arms in curves.values() for arm in of_arms))
    grid = np.linspace(0, 1, n_points)
    strata: dict[str, list[np.ndarray]] = {arm: [] for arm in arms}
    first = 0.0
    for environment, of_arms in curves.items():
        if set(of_arms) != set(arms):
            continue
        known = {arm: (steps, values, np.isfinite(values).all(axis=0)) for arm, (steps, values, _) in of_arms.items()}
        if not all(common.any() for _, _, common in known.values()):
            continue
        end = min(steps[common][-1] for steps, _, common in known.values())
        for arm, (steps, values, common) in known.items():
            at, kept = steps[common] / end, rescaled(values[:, common], bounds[environment])
            first = max(first, at[0])
            strata[arm].append(np.array([np.interp(grid, at, row) for row in kept]).T)
    inside = grid >= first - 1e-12
    return {
        arm: _band(grid[inside], [each[inside] for each in of], method, n_resamples, limits)
        for arm, of in strata.items()
        if of
    }


def performance_profiles(
    scores: Scores,
    thresholds: Sequence[float] | np.ndarray | None = None,
    *,
    method: str = "corrected",
    n_resamples: int = RESAMPLES,
) -> dict[str, Band]:
    """
    Return for each arm the share of its runs with a score above each threshold (score distributions, Agarwal et al. 2021).

    :param scores: The scores, normalised if there are several environments. Only environments in which all arms have runs
        count
    :param thresholds: The thresholds, ascending. None for 101 from the lowest score, or 0 if that is above, to the highest,
        or 1 if that is below
    :param method: Kind of interval, see ``resampling.bootstrap_interval``
    :param n_resamples: Number of resamples
    :return: {arm: shares over thresholds}, empty if no environment has all arms
    """
    of_all = shared(scores)
    strata = {arm: strata_of(of_all, arm) for arm in arms_of(of_all)}
    if not strata:
        return {}
    if thresholds is None:
        pool = np.concatenate([each for of in strata.values() for each in of])
        thresholds = np.linspace(min(0.0, pool.min()), max(1.0, pool.max()), 101)
    taus = np.asarray(thresholds, dtype=np.float64)
    found = {}
    for arm, of_arm in strata.items():
        above = [(each > taus[:, None]).astype(np.float64) for each in of_arm]
        values = pooled_mean(*above, axis=-1)
        interval = bootstrap_interval(above, pooled_mean, method=method, n_resamples=n_resamples, limits=(0.0, 1.0))
        low, high = interval or (None, None)
        found[arm] = Band(taus, values, low, high, min(map(len, of_arm)))
    return found


def pooled_mean(*strata: np.ndarray, axis: int = -1) -> np.ndarray:
    """
    Return the mean of all values, those of all strata in one pool.

    :param strata: Values of each stratum
    :param axis: The axis to reduce over
    :return: The mean
    """
    return np.concatenate(strata, axis=axis).mean(axis=axis)


def _band(x: np.ndarray, strata: list[np.ndarray], method: str, n_resamples: int, limits: tuple[float, float] | None) -> Band:
    """Return the band of strata ``[k, n]``."""
    interval = bootstrap_interval(strata, interquartile_mean, method=method, n_resamples=n_resamples, limits=limits)
    low, high = interval or (None, None)
    return Band(x, interquartile_mean(*strata), low, high, min(each.shape[-1] for each in strata))
