"""
The tuning of hyper-parameters: trials in a folder, drawn by Optuna.

    tune.yml          the specification
    study.db          Optuna's storage
    trials/<number>/  the runs of a trial: ``seed_<s>/<algo>/<env>_1/``
    trials.csv        a row for each trial
    best.yml          the best trial's settings as a section that ``train.py -conf`` takes

Any number of processes may share the folder. Who trains a trial holds a lock on its folder, which the system lets go however
the process ends: a trial that is being trained and that nobody holds was killed. It counts as failed, and is repeated.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from sb3_belief.report.evaluations import read_evaluations
from sb3_belief.study.trials_table import write_best, write_trials
from sb3_belief.study.tuning_spec import TuningSpec
from sb3_belief.study.tuning_storage import Storage
from sb3_belief.zoo.errors import ConfigError, RunFailed, cause, reason_of
from sb3_belief.zoo.preflight import check_folder
from sb3_belief.zoo.run_lock import run_lock
from sb3_belief.zoo.train import train
from sb3_belief.zoo.train_options import TrainOptions

if TYPE_CHECKING:
    import optuna

# So many trials in a row that end by an error, with none that succeeded, say that the fault is not in what was drawn
_MOST_FAILURES = 5
# Seconds that a process waits for another one that draws a trial, which takes a fraction of one
_PATIENCE = 120.0


@dataclass
class Tally:
    """
    How the trials of one process ended.

    :param succeeded: Number of complete and pruned ones
    :param failed: Number of those that have failed in a row
    :param exit_status: That of the signal that has ended the process, or 0
    """

    succeeded: int = 0
    failed: int = 0
    exit_status: int = 0


def run_trials(
    spec: TuningSpec,
    folder: Path,
    extra_packages: tuple[str, ...] = (),
    tell: Callable[[str], object] = print,
    goes_on: Callable[[], bool] = lambda: True,
) -> int:
    """
    Train trials until the tuning has as many as it is to have.

    :param spec: The specification
    :param folder: Folder of the tuning, with its storage
    :param extra_packages: See ``names.resolve``
    :param tell: Takes a line about each trial
    :param goes_on: Whether to begin a further trial
    :return: Exit status: 0, or what a shell shows of a program ended by the signal that has ended this one
    :raises RunFailed: If the folder cannot be written, or if trials fail whatever is drawn
    """
    storage, tally = Storage(folder, spec), Tally()
    while goes_on() and tally.exit_status == 0:
        with ExitStack() as stack:
            stack.enter_context(storage.writing())
            with exclusive(folder):
                storage.give_up_killed()
                trial = storage.draw()
                if trial is None:
                    break
                own = storage.trial_folder(trial.number)
                try:
                    own.mkdir(parents=True, exist_ok=True)
                    check_folder(own, "-f")
                    stack.enter_context(run_lock(own))
                except (OSError, ConfigError) as error:
                    raise RunFailed(f"The tuning cannot go on: {error}") from error
                # It says which trial is being trained
                write_trials(folder, spec, storage.trials())
            _run(trial, spec, own, storage, extra_packages, tell, tally)
        update_results(folder, spec, extra_packages)
        if tally.failed >= _MOST_FAILURES and not tally.succeeded:
            error_text = storage.trials()[trial.number].user_attrs.get("error")
            raise RunFailed(f"The tuning has stopped: {tally.failed} trials in a row failed, and none succeeded: {error_text}")
    return tally.exit_status


def update_results(folder: Path, spec: TuningSpec, extra_packages: tuple[str, ...] = ()) -> None:
    """
    Write the table of the trials and the best one's settings.

    :param folder: Folder of the tuning
    :param spec: Its specification
    :param extra_packages: See ``names.resolve``
    """
    try:
        with exclusive(folder):
            trials = Storage(folder, spec).trials()
            write_trials(folder, spec, trials)
            write_best(folder, spec, trials, extra_packages)
    except OSError as error:
        raise RunFailed(f"The results of {folder} could not be written ({reason_of(error)}).") from error


@contextmanager
def exclusive(folder: Path) -> Iterator[None]:
    """
    Have no other process draw a trial, or write the results, meanwhile.

    :param folder: Folder of the tuning
    :raises RunFailed: If another process does for minutes
    """
    deadline = time.monotonic() + _PATIENCE
    with ExitStack() as stack:
        while True:
            try:
                stack.enter_context(run_lock(folder))
                break
            except ConfigError as error:
                if time.monotonic() > deadline:
                    raise RunFailed(f"The tuning cannot go on: {error}") from None
                time.sleep(0.05)
        yield


class _Stopped(Exception):
    """Raised to end all trials, since the fault is not in one of them."""


class ReportEvaluation(BaseCallback):
    """
    Callback that reports each evaluation of a run to Optuna, and ends the run if the trial is to be pruned.

    :param trial: The trial
    :param objective: ``"return"`` or ``"success"``
    :param n_before: Number of evaluations of the trial's earlier runs
    """

    def __init__(self, trial: "optuna.Trial", objective: str, n_before: int):
        super().__init__()
        self._trial, self._objective, self.n_reported = trial, objective, n_before
        self.pruned = self.has_no_success = False

    def state_dict(self) -> dict[str, Any]:
        """Return nothing: a run of a trial is never continued."""
        return {}

    def _on_step(self) -> bool:
        evaluation: Any = self.parent
        values = evaluation.evaluations_results[-1]
        if self._objective == "success":
            values = evaluation._is_success_buffer
            if len(values) == 0:
                self.has_no_success = True
                return False
        self.n_reported += 1
        self._trial.report(float(np.mean(values)), self.n_reported)
        self.pruned = self._trial.should_prune()
        return not self.pruned


def _run(
    trial: "optuna.Trial",
    spec: TuningSpec,
    folder: Path,
    storage: Storage,
    extra_packages: tuple[str, ...],
    tell: Callable[[str], object],
    tally: Tally,
) -> None:
    """Train a trial, and say and store how it ended."""
    start = time.monotonic()
    scores: list[float] = []
    try:
        pruned, tally.exit_status = _train_seeds(trial, spec, folder, extra_packages, scores)
    except _Stopped as error:
        storage.give_up(trial, str(error))
        raise RunFailed(f"The tuning has stopped: {error}") from error
    # What the environment or the algorithm refuses, or what broke the training, is this trial's fault alone
    except (ConfigError, RunFailed) as error:
        if isinstance(error.__cause__, OSError):
            storage.give_up(trial, cause(error))
            raise RunFailed(f"The tuning cannot go on: {cause(error)}") from error
        tally.failed += 1
        storage.fail(trial, cause(error))
        tell(f"Trial {trial.number} failed: {cause(error)}")
        return
    except BaseException as error:
        storage.give_up(trial, cause(error))
        raise
    if tally.exit_status:
        storage.give_up(trial, "interrupted")
        return
    tally.succeeded, tally.failed = tally.succeeded + 1, 0
    seconds = time.monotonic() - start
    value = storage.finish(trial, None if pruned else float(np.mean(scores)), scores, seconds)
    settings = ", ".join(f"{name} {_short_number(each)}" for name, each in trial.params.items())
    how = "pruned" if pruned else f"{spec.objective} {value:.4g}"
    tell(f"Trial {trial.number}: {how} ({seconds:.0f} s) with {settings}")


def _train_seeds(
    trial: "optuna.Trial", spec: TuningSpec, folder: Path, extra_packages: tuple[str, ...], scores: list[float]
) -> tuple[bool, int]:
    """Train a run with each seed, add their scores, and return whether the trial was pruned, and the status of a signal."""
    config = spec.config(trial.params, extra_packages)
    n_evaluations = 0
    for seed in spec.seeds:
        callback = ReportEvaluation(trial, spec.objective, n_evaluations)
        options = TrainOptions(
            seed=seed,
            log_folder=str(folder / f"seed_{seed}"),
            eval_freq=spec.evaluation["every"],
            eval_episodes=spec.evaluation["episodes"],
            n_eval_envs=spec.evaluation["copies"],
            save_every=-1,
            extra_packages=extra_packages,
            verbose=0,
            **spec.train,
        )
        result = train(config, options, after_eval=callback)
        if callback.has_no_success:
            raise _Stopped(f"{spec.env} reports no successes, so that objective: success has no value. Use objective: return.")
        if not result.finished:
            return False, result.exit_status
        if callback.pruned:
            return True, 0
        n_evaluations = callback.n_reported
        scores.append(_score(result.folder, spec))
    return False, 0


def _score(run: Path, spec: TuningSpec) -> float:
    evaluations = read_evaluations(run)
    assert evaluations is not None
    values = evaluations.mean_returns if spec.objective == "return" else evaluations.success_rates
    return float(np.mean(values[-spec.last_evaluations :]))


def _short_number(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
