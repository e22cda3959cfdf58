"""The score of a single run, with what the number of its episodes leaves open."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sb3_belief.zoo.errors import ConfigError, cause
from sb3_belief.zoo.run_folder import EVALUATIONS

#: Share of repetitions in which an interval is to contain the mean
LEVEL = 0.95
_RESAMPLES = 10_000


@dataclass(frozen=True)
class MeanWithInterval:
    """
    Mean over episodes, with a 95 % interval over episodes of the same team: other seeds of the training are not in it.

    :param mean: The mean
    :param low: Lower end of the interval, None for a single episode
    :param high: Upper end
    """

    mean: float
    low: float | None = None
    high: float | None = None

    def __str__(self) -> str:
        ends = "" if self.low is None or self.high is None else f" [{self.low:.3g}, {self.high:.3g}]"
        return f"{self.mean:.3g}{ends}"


@dataclass(frozen=True)
class RunScore:
    """
    Result of an evaluation during a run's training.

    :param joint_steps: Number of joint steps trained until then
    :param n_episodes: Number of its episodes
    :param returns: Mean return, with a bootstrap interval over the episodes
    :param spread: Standard deviation of the returns
    :param success: Share of episodes that succeeded, with Wilson's interval; None if the environment reports none
    """

    joint_steps: int
    n_episodes: int
    returns: MeanWithInterval
    spread: float
    success: MeanWithInterval | None = None


def run_scores(run: Path) -> tuple[RunScore, RunScore] | None:
    """
    Return the scores of a run's last evaluation, and of the one by which its best model was chosen.

    :param run: Folder of the run
    :return: The two scores; None if it was never evaluated
    :raises ConfigError: If its file cannot be read
    """
    path = run / EVALUATIONS
    if not path.is_file():
        return None
    try:
        with np.load(path, allow_pickle=False) as data:
            steps, results = data["timesteps"], np.asarray(data["results"], dtype=np.float64)
            successes = np.asarray(data["successes"], dtype=np.float64) if "successes" in data else None
        if len(steps) == 0 or len(steps) != len(results):
            return None
    # A damaged file makes zipfile and numpy raise whatever they raise
    except Exception as error:
        raise ConfigError(f"{path}: cannot be read ({cause(error)}): it is damaged.") from error
    # As SB3's EvalCallback chooses it: the first of equal ones
    best = int(np.argmax(results.mean(axis=1)))

    def score(row: int) -> RunScore:
        # An evaluation during which the environment had not reported any yet has none
        success = None if successes is None or len(successes) != len(results) else _share(successes[row])
        returns = results[row]
        return RunScore(int(steps[row]), len(returns), mean_of_episodes(returns), float(returns.std()), success)

    return score(-1), score(best)


def mean_of_episodes(values: np.ndarray) -> MeanWithInterval:
    """
    Return the mean over episodes with its bootstrap interval.

    :param values: The value of each episode, float ``[k]``
    :return: The mean, and a percentile interval, the same for the same values
    """
    from scipy import stats

    if len(values) < 2 or np.ptp(values) == 0:
        mean = float(np.mean(values))
        return MeanWithInterval(mean, *((mean, mean) if len(values) > 1 else ()))
    found = stats.bootstrap(
        (values,),
        np.mean,
        confidence_level=LEVEL,
        n_resamples=_RESAMPLES,
        method="percentile",
        rng=np.random.default_rng(0),
        batch=1000,
    ).confidence_interval
    return MeanWithInterval(float(np.mean(values)), float(found.low), float(found.high))


def _share(successes: np.ndarray) -> MeanWithInterval:
    from scipy import stats

    # Resampling episodes of which none, or each, succeeded would leave nothing open
    found = stats.binomtest(int(successes.sum()), len(successes)).proportion_ci(LEVEL, method="wilson")
    return MeanWithInterval(float(successes.mean()), float(found.low), float(found.high))
