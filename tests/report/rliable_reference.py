"""
Statistics of some scores by rliable 1.2.0, with which ours are compared: its output is ``rliable_reference.json``.

It runs in an environment that has rliable and need not have this package.
"""

import json
import sys

import numpy as np

#: Resamples of rliable's bootstraps
RESAMPLES = 4_000
#: Thresholds of the profiles
THRESHOLDS = [-0.5, 0.0, 0.25, 0.5, 0.75, 1.0, 2.0]


def score_pairs() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return scores ``[runs, tasks]`` of two algorithms for each case."""
    rng = np.random.default_rng(2021)
    return {
        "one task, five runs": (rng.normal(0.5, 0.3, (5, 1)), rng.normal(0.3, 0.3, (5, 1))),
        "three tasks, five runs": (rng.normal([0, 0.5, 2], 0.5, (5, 3)), rng.normal([0.2, 0.2, 2.5], 0.5, (5, 3))),
        "two tasks, three runs": (rng.beta(4, 2, (3, 2)), rng.beta(2, 2, (3, 2))),
        "four tasks, ten and seven runs": (rng.lognormal(-1, 0.7, (10, 4)), rng.lognormal(-1.2, 0.7, (7, 4))),
        "success rates that tie": (rng.integers(4, 9, (8, 2)) / 8, rng.integers(3, 9, (6, 2)) / 8),
        "one is always above": (rng.uniform(0.6, 1, (5, 2)), rng.uniform(0, 0.5, (5, 2))),
    }


def main(n_resamples: int) -> None:
    """Print the scores and the statistics as JSON."""
    from rliable import library, metrics

    aggregates = {
        "iqm": metrics.aggregate_iqm,
        "mean": metrics.aggregate_mean,
        "median": metrics.aggregate_median,
        "optimality_gap": metrics.aggregate_optimality_gap,
    }
    # Its bootstrap draws from numpy's global generator
    np.random.seed(0)
    cases = {}
    for name, (x, y) in score_pairs().items():
        points, intervals = library.get_interval_estimates(
            {"x": x, "y": y}, lambda scores: np.array([each(scores) for each in aggregates.values()]), reps=n_resamples
        )
        chance, interval = library.get_interval_estimates(
            {"x,y": [x, y]}, metrics.probability_of_improvement, reps=n_resamples
        )
        profiles, bands = library.create_performance_profile({"x": x, "y": y}, THRESHOLDS, reps=n_resamples)
        cases[name] = {
            "scores": {"x": x.T.tolist(), "y": y.T.tolist()},
            "aggregates": {
                arm: {
                    key: {"value": points[arm][i], "interval": intervals[arm][:, i].tolist()}
                    for i, key in enumerate(aggregates)
                }
                for arm in ("x", "y")
            },
            "improvement": {"value": float(chance["x,y"]), "interval": interval["x,y"].ravel().tolist()},
            "profiles": {arm: {"values": profiles[arm].tolist(), "bands": bands[arm].tolist()} for arm in ("x", "y")},
        }
    json.dump({"thresholds": THRESHOLDS, "cases": cases}, sys.stdout, indent=1)
    print()


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else RESAMPLES)
