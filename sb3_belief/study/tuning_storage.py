"""The storage of a tuning's trials, in SQLite, and what is drawn next."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sb3_belief.study.tuning_spec import TuningSpec
from sb3_belief.zoo.errors import ConfigError, RunFailed, cause
from sb3_belief.zoo.run_files import STORAGE
from sb3_belief.zoo.run_lock import run_lock

if TYPE_CHECKING:
    import optuna
    from optuna.trial import FrozenTrial

TRIALS = "trials"
#: Attributes of trials: whether its process ended before it did, of which trial it is a repetition, and which try that is
KILLED, REPEATS, ATTEMPT = "killed", "repeats", "attempt"
ERROR, SCORES, SECONDS = "error", "scores", "seconds"
#: How often a trial is begun. One that takes its machine down with it must not do so for ever
MOST_ATTEMPTS = 3
# Seconds that SQLite waits for a process that writes
_WAIT = 60.0


class Storage:
    """
    Trials of a tuning.

    What a trial is depends only on the specification, the trial's place and the results before it. So a tuning that was
    interrupted draws what it would have drawn undisturbed, if one process trains it.

    :param folder: Folder of the tuning, which exists
    :param spec: Its specification
    :raises ConfigError: If the storage is damaged
    """

    def __init__(self, folder: Path, spec: TuningSpec):
        import optuna
        import sqlalchemy

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        self._folder, self._spec = folder, spec
        url = sqlalchemy.URL.create("sqlite", database=str(folder / STORAGE)).render_as_string()
        try:
            self._storage = optuna.storages.RDBStorage(url, engine_kwargs={"connect_args": {"timeout": _WAIT}})
            self._study(0)
        except (sqlalchemy.exc.SQLAlchemyError, optuna.exceptions.OptunaError, AssertionError, RuntimeError) as error:
            reason = str(getattr(error, "orig", None) or cause(error))
            raise ConfigError(
                f"{folder / STORAGE}: cannot be used as Optuna's storage ({reason}): restore it, or give the tuning"
                " another name."
            ) from error

    @contextmanager
    def writing(self) -> Iterator[None]:
        """
        Say in one line that the storage cannot be written, for example because the disk is full.

        :raises RunFailed: If so. A trial that was being trained counts as killed from then on
        """
        import optuna
        import sqlalchemy

        try:
            yield
        except (sqlalchemy.exc.SQLAlchemyError, optuna.exceptions.StorageInternalError) as error:
            known = error if isinstance(error, sqlalchemy.exc.SQLAlchemyError) else error.__cause__ or error
            reason = str(getattr(known, "orig", None) or known).splitlines()[0]
            raise RunFailed(
                f"The tuning cannot go on: {self._folder / STORAGE} could not be written ({reason}). The same"
                " command continues it."
            ) from error

    def trial_folder(self, number: int) -> Path:
        """
        Return the folder of a trial.

        :param number: Its number
        """
        return self._folder / TRIALS / f"{number:04d}"

    def trials(self) -> "list[FrozenTrial]":
        """Return all trials, in the order of their numbers."""
        return self._study(0).get_trials(deepcopy=False)

    def draw(self) -> "optuna.Trial | None":
        """
        Begin a trial: one that was killed, or else a new one. No other process may draw meanwhile.

        :return: The trial; None if there are as many as there are to be
        """
        from optuna.trial import TrialState

        trials = self.trials()
        drawn = [each.number for each in trials if REPEATS not in each.user_attrs]
        # Optuna takes the first of those that wait, as the loop does
        waiting = next((each for each in trials if each.state == TrialState.WAITING), None)
        if waiting is None and len(drawn) >= self._spec.n_trials:
            return None
        place = len(drawn) if waiting is None else drawn.index(waiting.user_attrs[REPEATS])
        return self._study(place).ask({name: each.distribution() for name, each in self._spec.space.items()})

    def give_up_killed(self) -> None:
        """Count trials whose processes have ended as failed, and have them repeated. No other process may draw meanwhile."""
        from optuna.trial import TrialState

        for each in self.trials():
            if each.state == TrialState.RUNNING and not self._is_held(each.number):
                self._give_up(each.number, each._trial_id, "its process was killed")

    def give_up(self, trial: "optuna.Trial", why: str) -> None:
        """
        Count a trial as failed that was interrupted, and have it repeated.

        :param trial: The trial
        :param why: Why it ended
        """
        self._give_up(trial.number, trial._trial_id, why)

    def fail(self, trial: "optuna.Trial", error: str) -> None:
        """
        Count a trial as failed that would fail again.

        :param trial: The trial
        :param error: Why it failed
        """
        from optuna.trial import TrialState

        trial.set_user_attr(ERROR, error)
        self._study(0).tell(trial, state=TrialState.FAIL)

    def finish(self, trial: "optuna.Trial", value: float | None, scores: list[float], seconds: float) -> float:
        """
        Store the result of a trial.

        :param trial: The trial
        :param value: Its objective; None if it was pruned
        :param scores: The objectives of its runs
        :param seconds: How long it took
        :return: The objective, of a pruned trial that of its last evaluation
        """
        from optuna.trial import TrialState

        trial.set_user_attr(SCORES, scores)
        trial.set_user_attr(SECONDS, round(seconds, 1))
        study = self._study(0)
        told = study.tell(trial, value) if value is not None else study.tell(trial, state=TrialState.PRUNED)
        return float("nan") if told.value is None else told.value

    def _give_up(self, number: int, trial_id: int, why: str) -> None:
        from optuna.trial import TrialState

        study = self._study(0)
        known = study.get_trials(deepcopy=False)[number]
        attempt = known.user_attrs.get(ATTEMPT, 1)
        again = attempt < MOST_ATTEMPTS
        self._storage.set_trial_user_attr(trial_id, KILLED, True)
        error = why if again else f"{why}, as in {MOST_ATTEMPTS - 1} tries before"
        self._storage.set_trial_user_attr(trial_id, ERROR, error)
        study.tell(number, state=TrialState.FAIL)
        if again:
            first = known.user_attrs.get(REPEATS, number)
            study.enqueue_trial(known.params, user_attrs={REPEATS: first, ATTEMPT: attempt + 1})

    def _is_held(self, number: int) -> bool:
        folder = self.trial_folder(number)
        if not folder.is_dir():
            return False
        try:
            with run_lock(folder):
                return False
        except ConfigError:
            return True

    def _study(self, place: int) -> "optuna.Study":
        """Return Optuna's study, with a sampler for the trial at a place among those that are no repetitions."""
        import optuna

        sampler, pruner = self._spec.sampler, self._spec.pruner
        # A sampler that began anew with the same seed in each process would draw the same trials in each
        seed = int(np.random.SeedSequence([sampler["seed"], place]).generate_state(1)[0])
        chosen: optuna.samplers.BaseSampler
        if sampler["name"] == "tpe":
            chosen = optuna.samplers.TPESampler(seed=seed, n_startup_trials=sampler["startup_trials"], constant_liar=True)
        else:
            chosen = optuna.samplers.RandomSampler(seed=seed)
        prunes: optuna.pruners.BasePruner = optuna.pruners.NopPruner()
        if pruner["name"] == "median":
            # Evaluations count from 1, and at the number of warm-up steps itself Optuna does prune
            prunes = optuna.pruners.MedianPruner(pruner["startup_trials"], pruner["warmup_evaluations"] + 1)
        return optuna.create_study(
            study_name=self._spec.name,
            storage=self._storage,
            sampler=chosen,
            pruner=prunes,
            direction="maximize",
            load_if_exists=True,
        )
