"""Statistics over seeds and environments: interquartile means and other aggregates, with intervals."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from sb3_belief.report.resampling import LEVEL, RESAMPLES, Statistic, bootstrap_interval

#: {environment: {arm: {seed: score of the run}}}, as ``episodes.scores`` returns them; higher is better
Scores: TypeAlias = Mapping[str, Mapping[str, Mapping[int, float]]]


class IntervalEstimate(NamedTuple):
    """
    A statistic with its interval.

    :param value: The statistic
    :param low: Lower end of the interval. None if there is one seed only
    :param high: Upper end of the interval, or None
    :param n_seeds: Seeds of each environment; the fewest, if they are not equally many
    """

    value: float
    low: float | None
    high: float | None
    n_seeds: int


def interquartile_mean(*strata: np.ndarray, axis: int = -1) -> np.ndarray:
    """
    Return the mean of the middle half of all values, those of all strata in one pool (Agarwal et al. 2021).

    A quarter of the values is left out at each end, rounded down, as in ``scipy.stats.trim_mean`` and rliable. So nothing is
    left out of 3 values, and the mean of the middle three is taken of 5.

    :param strata: Values of each stratum. The axes before the last one are alike
    :param axis: The axis to reduce over
    :return: The interquartile mean
    """
    pool = np.moveaxis(np.concatenate(strata, axis=axis), axis, -1)
    n_values = pool.shape[-1]
    cut = n_values // 4
    # Half as much work as to sort, where there are many
    kept = np.partition(pool, (cut, n_values - cut - 1), axis=-1)[..., cut : n_values - cut] if cut else pool
    return kept.mean(axis=-1)


def mean_of_means(*strata: np.ndarray, axis: int = -1) -> np.ndarray:
    """
    Return the mean over environments of the mean over seeds.

    :param strata: Values of each environment
    :param axis: The axis to reduce over
    :return: The mean
    """
    return np.mean([each.mean(axis=axis) for each in strata], axis=0)


def median_of_means(*strata: np.ndarray, axis: int = -1) -> np.ndarray:
    """
    Return the median over environments of the mean over seeds. In one environment it is the mean.

    :param strata: Values of each environment
    :param axis: The axis to reduce over
    :return: The median
    """
    return np.median([each.mean(axis=axis) for each in strata], axis=0)


def optimality_gap(*strata: np.ndarray, axis: int = -1) -> np.ndarray:
    """
    Return how far the values fall short of 1 in the mean; what is above 1 counts as 1. Lower is better.

    :param strata: Normalised values of each environment
    :param axis: The axis to reduce over
    :return: The gap
    """
    return 1 - np.minimum(np.concatenate(strata, axis=axis), 1).mean(axis=axis)


#: The aggregates by name
AGGREGATES: dict[str, Statistic] = {
    "iqm": interquartile_mean,
    "mean": mean_of_means,
    "median": median_of_means,
    "optimality_gap": optimality_gap,
}


def estimate(
    strata: Sequence[np.ndarray],
    aggregate: str = "iqm",
    *,
    method: str = "corrected",
    level: float = LEVEL,
    n_resamples: int = RESAMPLES,
    limits: tuple[float, float] | None = None,
) -> IntervalEstimate:
    """
    Return an aggregate of scores with its stratified bootstrap interval.

    :param strata: Scores of each environment, one a seed
    :param aggregate: A key of ``AGGREGATES``
    :param method: Kind of interval, see ``resampling.bootstrap_interval``
    :param level: Share of repetitions in which the interval is to contain the truth
    :param n_resamples: Number of resamples
    :param limits: Lowest and highest possible value, (0, 1) for success rates, if there are such; intervals end there
    :return: The estimate; without an interval if an environment has one seed only
    :raises ValueError: For another aggregate or method, or if there is no score
    """
    if aggregate not in AGGREGATES:
        raise ValueError(f"aggregate is {aggregate!r}; it must be one of {', '.join(map(repr, AGGREGATES))}.")
    values = [np.asarray(each, dtype=np.float64) for each in strata]
    if not values or min(len(each) for each in values) == 0:
        raise ValueError("There is no score to aggregate: each environment needs at least one seed.")
    statistic = AGGREGATES[aggregate]
    value = float(statistic(*values, axis=-1))
    interval = bootstrap_interval(values, statistic, method=method, level=level, n_resamples=n_resamples, limits=limits)
    return with_interval(value, interval, values)


def with_interval(
    value: float, interval: tuple[np.ndarray, np.ndarray] | None, strata: Sequence[np.ndarray]
) -> IntervalEstimate:
    """
    Return a statistic with its interval as plain numbers.

    :param value: The statistic
    :param interval: Its interval, or None
    :param strata: The values that it is of
    :return: The estimate
    """
    n_seeds = min(each.shape[-1] for each in strata)
    low, high = (None, None) if interval is None else (float(interval[0]), float(interval[1]))
    return IntervalEstimate(value, low, high, n_seeds)


def arms_of(scores: Scores) -> list[str]:
    """
    Return the arms that occur, in the order of their first occurrence.

    :param scores: The scores
    :return: Their names
    """
    return list(dict.fromkeys(arm for arms in scores.values() for arm in arms))


def strata_of(scores: Scores, arm: str) -> list[np.ndarray]:
    """
    Return the scores of an arm in each environment that has it.

    :param scores: The scores
    :param arm: Name of the arm
    :return: An array for each environment, with the seeds ascending
    """
    found = [arms[arm] for arms in scores.values() if arms.get(arm)]
    return [np.array([seeds[seed] for seed in sorted(seeds)], dtype=np.float64) for seeds in found]


def shared(scores: Scores, arms: Sequence[str] | None = None) -> dict[str, dict[str, dict[int, float]]]:
    """
    Return the scores in the environments in which all arms have runs, since only over these can arms be compared.

    :param scores: The scores
    :param arms: The arms to keep. None for all
    :return: Their scores in these environments, perhaps none
    """
    kept = arms_of(scores) if arms is None else list(arms)
    return {
        environment: {arm: dict(found[arm]) for arm in kept}
        for environment, found in scores.items()
        if all(found.get(arm) for arm in kept)
    }


def score_range(scores: Scores) -> dict[str, tuple[float, float]]:
    """
    Return the lowest and the highest score of any run in each environment, for ``normalized_scores``.

    :param scores: The scores, of all arms that are compared
    :return: {environment: (lowest, highest)}
    """
    found = {}
    for environment, arms in scores.items():
        values = [value for seeds in arms.values() for value in seeds.values()]
        found[environment] = (float(min(values)), float(max(values)))
    return found


def normalized_scores(
    scores: Scores, bounds: Mapping[str, tuple[float, float]] | None = None
) -> dict[str, dict[str, dict[int, float]]]:
    """
    Return scores in which 0 and 1 are the bounds of each environment, so that environments can be averaged.

    :param scores: The scores
    :param bounds: {environment: (score that becomes 0, score that becomes 1)}, such as a random and a perfect team's; for
        success rates (0, 1) leaves them as they are. For environments that are not in it, and for None, it is the lowest and
        the highest score of any run there. Then the aggregates depend on which arms are compared, and the intervals take
        these bounds as given
    :return: The normalised scores; 0.5 where both bounds are equal, as then no run differs
    :raises ValueError: If a lower bound is above the upper one
    """
    of_all = {**score_range(scores), **(bounds or {})}
    return {
        environment: {
            arm: {seed: rescaled(value, of_all[environment]) for seed, value in seeds.items()} for arm, seeds in arms.items()
        }
        for environment, arms in scores.items()
    }


def rescaled(value: Any, bounds: tuple[float, float]) -> Any:
    """
    Return a value as a share of the way between two bounds.

    :param value: The value, or an array of values
    :param bounds: What becomes 0, and what becomes 1
    :return: The share; it may be below 0 or above 1. 0.5 if both bounds are equal
    :raises ValueError: If the lower bound is above the upper one
    """
    low, high = bounds
    if low > high:
        raise ValueError(f"The bounds of a score are {low} and {high}; the first must not be above the second.")
    return 0 * value + 0.5 if low == high else (value - low) / (high - low)


def estimates_by_environment(
    scores: Scores,
    aggregate: str = "iqm",
    *,
    method: str = "corrected",
    n_resamples: int = RESAMPLES,
    limits: tuple[float, float] | None = None,
) -> dict[str, dict[str, IntervalEstimate]]:
    """
    Return the aggregate over seeds of each arm in each environment, in the environment's own unit.

    :param scores: The scores
    :param aggregate: A key of ``AGGREGATES``
    :param method: Kind of interval, see ``resampling.bootstrap_interval``
    :param n_resamples: Number of resamples
    :param limits: Lowest and highest possible value, (0, 1) for success rates, if there are such; intervals end there
    :return: {environment: {arm: estimate}}
    """
    return {
        environment: {
            arm: estimate([np.array(list(seeds.values()))], aggregate, method=method, n_resamples=n_resamples, limits=limits)
            for arm, seeds in arms.items()
            if seeds
        }
        for environment, arms in scores.items()
    }


def overall_estimates(
    scores: Scores,
    aggregate: str = "iqm",
    *,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    method: str = "corrected",
    n_resamples: int = RESAMPLES,
    limits: tuple[float, float] | None = None,
) -> dict[str, IntervalEstimate]:
    """
    Return the aggregate of each arm over the seeds of all environments, of normalised scores.

    :param scores: The scores. Only the environments in which all arms have runs count, see ``shared``
    :param aggregate: A key of ``AGGREGATES``
    :param bounds: Bounds of the normalisation, see ``normalized_scores``
    :param method: Kind of interval, see ``resampling.bootstrap_interval``
    :param n_resamples: Number of resamples
    :param limits: Lowest and highest possible value, (0, 1) for success rates, if there are such; intervals end there
    :return: {arm: estimate}, empty if no environment has all arms
    """
    of_all = normalized_scores(shared(scores), bounds)
    return {
        arm: estimate(strata_of(of_all, arm), aggregate, method=method, n_resamples=n_resamples, limits=limits)
        for arm in arms_of(of_all)
    }
