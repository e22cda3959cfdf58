"""The score of a single run, with what the number of its episodes leaves open."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sb3_belief.report.evaluations import read_evaluations
from sb3_belief.zoo.errors import ConfigError
from sb3_belief.zoo.run_folder import BEST_MODEL, TEAM

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
    Result of an evaluation of a run's team.

    :param joint_steps: Number of joint steps trained until then
    :param n_episodes: Number of its episodes
    :param returns: Mean return, with a bootstrap interval over the episodes
    :param spread: Standard deviation of the returns
    :param success: Share of episodes that succeeded, with Wilson's interval; None if the environment reports none
    :param file: Saved team that it tells of
    :param deterministic: Whether it acted greedily
    """

    joint_steps: int
    n_episodes: int
    returns: MeanWithInterval
    spread: float
    success: MeanWithInterval | None = None
    file: str = TEAM
    deterministic: bool = True


def run_scores(run: Path) -> tuple[RunScore, RunScore] | None:
    """
    Return the scores of a run's last evaluation, and of the one by which its best model was chosen.

    :param run: Folder of the run
    :return: The two scores; None if it was never evaluated
    :raises ConfigError: If its file cannot be read
    """
    try:
        evaluations = read_evaluations(run)
    except ValueError as error:
        raise ConfigError(f"{error}.") from error
    if evaluations is None:
        return None

    def score(row: int, file: str) -> RunScore:
        successes = None if evaluations.successes is None else evaluations.successes[row]
        return score_of_episodes(int(evaluations.steps[row]), evaluations.returns[row], successes, file)

    return score(-1, TEAM), score(evaluations.best, BEST_MODEL)


def score_of_episodes(
    joint_steps: int, returns: np.ndarray, successes: np.ndarray | None, file: str = TEAM, deterministic: bool = True
) -> RunScore:
    """
    Return the score of an evaluation.

    :param joint_steps: Number of joint steps trained until then
    :param returns: The return of each episode, float ``[k]``
    :param successes: Whether each succeeded, ``[k]``; None, or with a NaN, if that was not reported
    :param file: Saved team that played them
    :param deterministic: Whether it acted greedily
    :return: The score
    """
    success = None if successes is None or np.isnan(successes).any() else _share(successes)
    return RunScore(joint_steps, len(returns), mean_of_episodes(returns), float(returns.std()), success, file, deterministic)


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
