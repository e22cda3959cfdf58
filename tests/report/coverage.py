"""
How often intervals contain the truth, and how often a verdict is wrong: ``python -m tests.report.coverage``.

Studies with known answers are repeated. The truth of an interquartile mean is that of the distributions the scores come from.
"""

import argparse
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from sb3_belief.report.resampling import METHODS, bootstrap_interval
from sb3_belief.report.statistics import interquartile_mean
from sb3_belief.report.verdicts import share_of_wins

#: Distributions of a run's score in environment e: like returns, like success rates, with a long tail, and of runs that either
#: find the way or do not
SHAPES: dict[str, Callable[[np.random.Generator, int, tuple[int, ...]], np.ndarray]] = {
    "normal": lambda rng, e, size: rng.normal(0.3 * e, 1 + 0.2 * e, size),
    "beta": lambda rng, e, size: rng.beta(4 - 0.3 * e, 2, size),
    "lognormal": lambda rng, e, size: rng.lognormal(0.1 * e, 0.7, size),
    "bimodal": lambda rng, e, size: (rng.random(size) < 0.6) * 1.0,
}


class Rates(NamedTuple):
    """Shares of the repetitions."""

    iqm: float
    improvement: float
    false_verdicts: float


def rates(
    shape: str, n_environments: int, n_seeds: int, method: str, repetitions: int = 1000, n_resamples: int = 1000
) -> Rates:
    """
    Repeat a study of two arms that are alike.

    :param shape: A key of ``SHAPES``
    :param n_environments: Number of environments
    :param n_seeds: Seeds of each arm in each environment
    :param method: Kind of intervals
    :param repetitions: Number of studies
    :param n_resamples: Resamples of each interval
    :return: How often the intervals of the interquartile mean and of the probability of improvement (1/2) contained the truth,
        and how often one arm was called better although they are alike
    """
    rng = np.random.default_rng([n_environments, n_seeds, len(shape)])
    draw = SHAPES[shape]
    truth = float(interquartile_mean(*(draw(rng, e, (500_000,)) for e in range(n_environments))))
    x, y = ([draw(rng, e, (repetitions, n_seeds)) for e in range(n_environments)] for _ in range(2))

    def interval(strata: list[np.ndarray], statistic: Callable[..., np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        # All repetitions at once
        found = bootstrap_interval(strata, statistic, method=method, n_resamples=n_resamples)
        assert found is not None
        return found

    (low, high), (other_low, other_high) = interval(x, interquartile_mean), interval(y, interquartile_mean)
    chance_low, chance_high = interval([*x, *y], share_of_wins)
    return Rates(
        float(np.mean((low <= truth) & (truth <= high))),
        float(np.mean((chance_low <= 0.5) & (chance_high >= 0.5))),
        float(np.mean((low > other_high) | (high < other_low))),
    )


def main() -> None:
    """Print the table of ``docs/statistics.md``: in percent, the lowest and the highest over the shapes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repetitions", type=int, default=1000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[2, 3, 4, 5, 10, 20])
    parser.add_argument("--environments", type=int, nargs="+", default=[1, 4])
    parser.add_argument("--shapes", nargs="+", choices=SHAPES, default=["normal", "beta", "lognormal"])
    arguments = parser.parse_args()
    kinds = " | ".join(METHODS)
    print(f"| environments | seeds | IQM: {kinds} | P(X > Y): {kinds} | wrongly decided: {kinds} |")
    print("|" + "---|" * (2 + 3 * len(METHODS)))
    for n_environments in arguments.environments:
        for n_seeds in arguments.seeds:
            # [methods, shapes, rates]
            found = 100 * np.array(
                [
                    [rates(shape, n_environments, n_seeds, method, arguments.repetitions) for shape in arguments.shapes]
                    for method in METHODS
                ]
            )
            low, high = found.min(axis=1).T.ravel(), found.max(axis=1).T.ravel()
            cells = " | ".join(f"{first:.1f} to {last:.1f}" for first, last in zip(low, high, strict=True))
            print(f"| {n_environments} | {n_seeds} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
