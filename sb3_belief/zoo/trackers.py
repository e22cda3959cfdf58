"""Experiment trackers to which a run can be logged: Weights & Biases and MLflow."""

import re
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# Key of the number of joint steps, as wandb names it where it reads TensorBoard's files
STEP = "global_step"
# The most that MLflow takes at once, and the longest value of a parameter
_MOST_METRICS, _MOST_PARAMS, _LONGEST = 1000, 100, 6000


@dataclass(frozen=True)
class TrackedRun:
    """
    What a tracker is told of a run at its start.

    :param folder: Folder of the run
    :param project: Project of wandb, or experiment of MLflow
    :param name: Name of the run
    :param config: Algorithm, environment, seed and settings, nested
    :param versions: Versions of the packages
    :param run_id: The tracker's own id of the run, if it is continued; None for a new one
    """

    folder: Path
    project: str
    name: str
    config: Mapping[str, Any]
    versions: Mapping[str, str]
    run_id: str | None = None


class Tracker(ABC):
    """
    A run in an experiment tracker. Whatever the tracker raises is raised on.

    :param run: What it is told of the run
    """

    #: The tracker's own id of the run
    run_id: str

    @abstractmethod
    def __init__(self, run: TrackedRun): ...

    @abstractmethod
    def log(self, values: Mapping[str, float], step: int) -> None:
        """
        Log values.

        :param values: Numbers by key
        :param step: Number of joint steps
        """

    @abstractmethod
    def finish(self, status: str) -> None:
        """
        Say how the run has ended.

        :param status: ``"finished"``, ``"interrupted"`` or ``"failed"``
        """


class WandbTracker(Tracker):
    """
    A run in Weights & Biases, as its own environment variables say (``WANDB_MODE=offline``, ``WANDB_ENTITY``, ...).

    :param run: What it is told of the run
    """

    def __init__(self, run: TrackedRun):
        import wandb

        self._run = wandb.init(
            project=run.project,
            name=run.name,
            id=run.run_id,
            resume="allow",
            dir=str(run.folder),
            config={**run.config, "versions": dict(run.versions)},
            group=f"{run.config['algo']} {run.config['env']}",
            # Beside a run of the user's own in the same process, which stays as it is
            reinit="create_new",
            # The output is the run's own, and a table is not logged twice
            settings=wandb.Settings(console="off"),
        )
        self.run_id = self._run.id
        self._run.define_metric(STEP)
        self._run.define_metric("*", step_metric=STEP)

    def log(self, values: Mapping[str, float], step: int) -> None:
        # Not as wandb's own step: that one may not fall, as it does where a run is continued from a checkpoint
        self._run.log({**values, STEP: step})

    def finish(self, status: str) -> None:
        self._run.summary["status"] = status
        self._run.finish(exit_code=0 if status == "finished" else 1)


class MlflowTracker(Tracker):
    """
    A run in MLflow, where its own environment variables say (``MLFLOW_TRACKING_URI``, ...).

    :param run: What it is told of the run
    """

    def __init__(self, run: TrackedRun):
        from mlflow import MlflowClient
        from mlflow.entities import Param
        from mlflow.exceptions import MlflowException

        # Not through mlflow's functions, which would use, or end, a run of the user's own in the same process
        self._client = MlflowClient()
        if run.run_id is not None:
            try:
                self._client.update_run(run.run_id, status="RUNNING")
                self.run_id = run.run_id
                return
            except MlflowException:
                # The store is another one than before, which has no such run
                pass
        experiment = self._client.get_experiment_by_name(run.project)
        experiment_id = self._client.create_experiment(run.project) if experiment is None else experiment.experiment_id
        tags = {f"version.{_key(name)}": version for name, version in run.versions.items()}
        self.run_id = self._client.create_run(experiment_id, run_name=run.name, tags=tags).info.run_id
        params = [Param(_key(name), str(value)[:_LONGEST]) for name, value in flat(run.config).items()]
        for some in _parts(params, _MOST_PARAMS):
            self._client.log_batch(self.run_id, params=some)

    def log(self, values: Mapping[str, float], step: int) -> None:
        from mlflow.entities import Metric

        now = int(time.time() * 1000)
        metrics = [Metric(_key(name), value, now, step) for name, value in values.items()]
        for some in _parts(metrics, _MOST_METRICS):
            self._client.log_batch(self.run_id, metrics=some)

    def finish(self, status: str) -> None:
        self._client.set_terminated(self.run_id, {"finished": "FINISHED", "interrupted": "KILLED"}.get(status, "FAILED"))


#: The trackers by name, with what users call them
TRACKERS: dict[str, tuple[str, type[Tracker]]] = {
    "wandb": ("Weights & Biases", WandbTracker),
    "mlflow": ("MLflow", MlflowTracker),
}


def flat(nested: Mapping[str, Any]) -> dict[str, Any]:
    """
    Return nested settings with dotted names.

    :param nested: The settings
    :return: {name: value}
    """
    found: dict[str, Any] = {}
    for key, value in nested.items():
        if isinstance(value, Mapping) and value:
            found.update({f"{key}.{name}": inner for name, inner in flat(value).items()})
        else:
            found[key] = value
    return found


def _key(name: str) -> str:
    """Return a name with all characters replaced that MLflow does not take."""
    return re.sub(r"[^\w\-. /]", "_", name, flags=re.ASCII)[:250]


def _parts(items: Sequence[Any], most: int) -> Iterator[Sequence[Any]]:
    for start in range(0, len(items), most):
        yield items[start : start + most]
