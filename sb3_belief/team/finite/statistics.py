"""The running statistics of a normalised agent, which one observation or reward that is not finite spoils for good."""

from typing import Any

import numpy as np
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize


def running_means(statistics: VecNormalize) -> dict[str, RunningMeanStd]:
    """
    Return what an agent's normalisation has counted.

    :param statistics: The normalisation
    :return: Of its observations and its returns, by name
    """
    found: dict[str, RunningMeanStd] = {}
    for name in ("obs_rms", "ret_rms"):
        part = getattr(statistics, name, None)
        parts = {f"{name}[{key!r}]": each for key, each in part.items()} if isinstance(part, dict) else {name: part}
        found |= {key: each for key, each in parts.items() if isinstance(each, RunningMeanStd)}
    return found


def bad_statistics(statistics: VecNormalize | None) -> list[str]:
    """
    Return the names of statistics that are not finite.

    :param statistics: The normalisation of an agent, if it has one
    """
    if statistics is None:
        return []
    return [
        f"{name}.{part}"
        for name, each in running_means(statistics).items()
        for part in ("mean", "var", "count")
        if not np.isfinite(getattr(each, part)).all()
    ]


class KeptStatistics:
    """
    Keeps the last finite statistics of an agent.

    :param statistics: Its normalisation, if it has one
    """

    def __init__(self, statistics: Any):
        self._statistics = statistics
        self._kept: dict[str, tuple[np.ndarray, np.ndarray, float]] = {}

    def bad(self) -> list[str]:
        """Return the names of those that are not finite now."""
        return bad_statistics(self._statistics)

    def keep(self) -> None:
        """Keep the statistics as they are, if they are finite."""
        if self._statistics is not None and not self.bad():
            self._kept = {
                name: (np.copy(each.mean), np.copy(each.var), each.count)
                for name, each in running_means(self._statistics).items()
            }

    def put_back(self) -> list[str]:
        """
        Go back to the statistics that were kept last, if the present ones are not finite.

        :return: The names of those that were not
        """
        bad = self.bad()
        if bad and self._kept:
            for name, each in running_means(self._statistics).items():
                mean, var, each.count = self._kept[name]
                each.mean, each.var = mean.copy(), var.copy()
            # The sums of the rewards of the episodes at hand, of which the statistics of returns are made
            returns = getattr(self._statistics, "returns", None)
            if returns is not None:
                returns[~np.isfinite(returns)] = 0.0
        return bad
