"""Bootstrap intervals with strata: the seeds of each environment are resampled among themselves."""

from collections.abc import Callable, Sequence

import numpy as np

try:
    from scipy import stats
except ImportError as error:
    raise ImportError("Statistics need scipy: pip install 'sb3-belief[study]'.") from error

#: Kinds of intervals. ``"percentile"`` is rliable's; ``"corrected"`` is wider for few seeds, see ``widening``
METHODS = ("corrected", "percentile")
#: The share of repetitions of a study in which an interval is to contain the truth
LEVEL = 0.95
#: Resamples of an interval; the same table always gives the same interval, since the generator is seeded alike each time
RESAMPLES = 10_000
# Numbers that are held at a time
_BATCH = 4_000_000

Statistic = Callable[..., np.ndarray]


def widening(sizes: Sequence[int], level: float = LEVEL) -> float:
    """
    Return the factor by which the two sides of a percentile interval are stretched for few seeds.

    Resampling n seeds shows too small a spread, by the factor sqrt((n - 1) / n), and a percentile interval is as wide as if
    that spread were known and not estimated. So the factor is ``sqrt(n / (n - 1)) * t / z`` with the quantiles of Student's t
    with ``sum(n - 1)`` degrees of freedom and of the normal distribution. It is 2.7 for 3 seeds in one environment, 1.6 for
    5, 1.2 for 10, and goes to 1.

    :param sizes: Number of seeds in each stratum, each at least 2. n is the smallest of them
    :param level: Share of repetitions in which the interval is to contain the truth
    :return: The factor, at least 1
    """
    fewest = min(sizes)
    return float(np.sqrt(fewest / (fewest - 1)) * student(sizes, level) / stats.norm.ppf((1 + level) / 2))


def student(sizes: Sequence[int], level: float = LEVEL) -> float:
    """
    Return the quantile of Student's t that belongs to a two-sided interval, with ``sum(n - 1)`` degrees of freedom.

    :param sizes: Number of seeds in each stratum
    :param level: Share of repetitions in which the interval is to contain the truth
    :return: The quantile
    """
    return float(stats.t.ppf((1 + level) / 2, sum(size - 1 for size in sizes)))


def bootstrap_interval(
    strata: Sequence[np.ndarray],
    statistic: Statistic,
    *,
    method: str = "corrected",
    level: float = LEVEL,
    n_resamples: int = RESAMPLES,
    limits: tuple[float, float] | None = None,
) -> tuple[np.ndarray, np.ndarray] | None:
    """
    Return a stratified bootstrap interval of a statistic.

    :param strata: For each stratum its values, ``[n]`` or ``[k, n]`` for k statistics at once. The last axis is resampled,
        for the k statistics alike, and in each stratum on its own
    :param statistic: Function of the strata and of ``axis``, over which it reduces; it takes further axes before the last one
    :param method: ``"percentile"`` as in rliable, or ``"corrected"``: its sides stretched by ``widening``
    :param level: Share of repetitions in which the interval is to contain the truth
    :param n_resamples: Number of resamples
    :param limits: The lowest and the highest value that the statistic can take, if it has such; the interval ends there
    :return: Lower and upper ends, of the statistic's shape. None if a stratum has one seed only, which says nothing of spread
    :raises ValueError: For another method
    """
    if method not in METHODS:
        raise ValueError(f"method is {method!r}; it must be one of {', '.join(map(repr, METHODS))}.")
    samples = [np.asarray(each, dtype=np.float64) for each in strata]
    sizes = [each.shape[-1] for each in samples]
    if not sizes or min(sizes) < 2:
        return None
    value = np.asarray(statistic(*samples, axis=-1))
    if value.size == 0:
        return value, value
    # With several samples scipy resamples each on its own, which is what a bootstrap with strata does
    interval = stats.bootstrap(
        samples,
        statistic,
        n_resamples=n_resamples,
        batch=max(1, _BATCH // sum(each.size for each in samples)),
        vectorized=True,
        axis=-1,
        confidence_level=level,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    low, high = np.asarray(interval.low), np.asarray(interval.high)
    if method == "corrected":
        factor = widening(sizes, level)
        # A skewed distribution's percentiles may lie on one side of the value: that side is left as it is
        low, high = value - factor * np.maximum(value - low, 0), value + factor * np.maximum(high - value, 0)
    if limits is not None:
        low, high = np.maximum(low, limits[0]), np.minimum(high, limits[1])
    return low, high
