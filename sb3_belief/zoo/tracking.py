"""
Logging of a run to an experiment tracker, by SB3's convention: a further output of its loggers.

The team's table is logged under its own keys, and that of each agent under ``agents/<agent>/``. The run's folder holds all of
it too, so a tracker that fails is warned of, and ends nothing.
"""

import shutil
import warnings
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from numbers import Number
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, filter_excluded_keys

from sb3_belief.common.versions import versions
from sb3_belief.zoo.config import RunConfig
from sb3_belief.zoo.errors import ConfigError, cause, unknown_setting
from sb3_belief.zoo.trackers import TRACKERS, TrackedRun, Tracker
from sb3_belief.zoo.train_options import TrainOptions

PROJECT = "sb3-belief"
#: Entry of ``run.json`` that says where the run is logged
ENTRY = "tracking"


def check_tracking(options: TrainOptions) -> None:
    """
    Check that the tracker that is asked for is there.

    :param options: Options of the run
    :raises ConfigError: If it is not
    """
    if options.track is None:
        if options.track_project is not None:
            raise ConfigError(f"--track-project: says where --track logs to: add --track {' or --track '.join(TRACKERS)}.")
        return
    if options.track not in TRACKERS:
        raise unknown_setting("--track", "tracker", options.track, TRACKERS)
    spec = find_spec(options.track)
    # Without an origin it is no package but a folder of that name, such as wandb makes for its files
    if spec is None or spec.origin is None:
        name = TRACKERS[options.track][0]
        raise ConfigError(f"--track: {name} needs {options.track}: pip install 'sb3-belief[track]'.")


class Tracking:
    """
    A run's log in a tracker. After the first failure there is a warning, and nothing more is logged.

    :param tracker: The run in the tracker
    :param name: Name of the tracker
    :param project: Where it logs to
    """

    def __init__(self, tracker: Tracker, name: str, project: str):
        self._tracker, self._name, self._project = tracker, name, project
        self._failed = False

    @classmethod
    def start(
        cls, config: RunConfig, options: TrainOptions, folder: Path, before: Mapping[str, Any] | None = None
    ) -> "Tracking | None":
        """
        Begin to log a run, or go on with its log.

        :param config: Configuration of the run
        :param options: Options of the run
        :param folder: Folder of the run
        :param before: The run's record, if it is continued
        :return: The log; None if none is asked for
        :raises ConfigError: If the tracker cannot begin
        """
        if options.track is None:
            return None
        name, tracker_class = TRACKERS[options.track]
        entry = (before or {}).get(ENTRY)
        run_id = entry.get("run") if isinstance(entry, Mapping) and entry.get("tracker") == options.track else None
        run = TrackedRun(
            folder,
            options.track_project or PROJECT,
            f"{config.algo}/{folder.name}",
            {"algo": config.algo, "env": config.env_id, "seed": options.seed, **config.settings},
            versions(),
            run_id if isinstance(run_id, str) else None,
        )
        existed = {path.name for path in folder.iterdir()}
        try:
            return cls(tracker_class(run), options.track, run.project)
        # What a package, a server or a network fails with may be anything
        except Exception as error:
            for path in folder.iterdir():
                if path.name not in existed and path.is_dir():
                    shutil.rmtree(path, ignore_errors=True)
            offline = " Without a network: WANDB_MODE=offline." if options.track == "wandb" else ""
            raise ConfigError(f"--track: {name} cannot log this run: {cause(error)}{offline}") from error

    def to_record(self) -> dict[str, str]:
        """Return the run's entry in ``run.json``, by which ``start`` finds its log again."""
        return {"tracker": self._name, "project": self._project, "run": self._tracker.run_id}

    def log(self, values: Mapping[str, float], step: int) -> None:
        """
        Log values.

        :param values: Numbers by key
        :param step: Number of joint steps
        """
        if not self._failed:
            self._try(lambda: self._tracker.log(values, step))

    def finish(self, status: str) -> None:
        """
        Say how the run has ended, also if logging has failed.

        :param status: As ``Tracker.finish`` takes it
        """
        self._try(lambda: self._tracker.finish(status))

    def _try(self, action: Callable[[], None]) -> None:
        try:
            action()
        except Exception as error:
            if not self._failed:
                warnings.warn(
                    f"{TRACKERS[self._name][0]} failed ({cause(error)}), and gets no more of this run. The training goes on,"
                    " and its folder holds all logs.",
                    stacklevel=2,
                )
            self._failed = True


class TrackerOutput(KVWriter):
    """
    Output of SB3's loggers that logs numbers to a tracker.

    Keys that are kept from TensorBoard, such as the number of steps, which is the axis, are kept from it too.

    :param tracking: The run's log
    :param prefix: Text before each key
    """

    def __init__(self, tracking: Tracking, prefix: str = ""):
        self._tracking, self._prefix = tracking, prefix

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        numbers = {
            f"{self._prefix}{key}": float(value)  # type: ignore[arg-type]
            for key, value in filter_excluded_keys(key_values, key_excluded, "tensorboard").items()
            if isinstance(value, (Number, np.number)) and not isinstance(value, complex)
        }
        if numbers:
            self._tracking.log(numbers, step)

    def close(self) -> None:
        """Do nothing: the run's log ends with the run."""


class TrackingCallback(BaseCallback):
    """
    Callback that adds a tracker to the outputs of the team's logger and of its agents'.

    :param tracking: The run's log
    """

    def __init__(self, tracking: Tracking):
        super().__init__()
        self._tracking = tracking

    def state_dict(self) -> dict[str, Any]:
        """Return nothing: what has been logged is in the tracker."""
        return {}

    def load_state_dict(self, _: dict[str, Any]) -> None:
        """Do nothing."""

    def _on_training_start(self) -> None:
        team: Any = self.model
        self.logger.output_formats.append(TrackerOutput(self._tracking))
        for agent, model in team.agents.items():
            model.logger.output_formats.append(TrackerOutput(self._tracking, f"agents/{agent}/"))

    def _on_step(self) -> bool:
        return True
