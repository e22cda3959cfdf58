"""What a run is asked for besides its configuration, and what comes out of it."""

import dataclasses
import os
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_type_hints

from sb3_belief.team import Team
from sb3_belief.zoo.errors import ConfigError, short

# What is asked for at each start: words of the command line, and whom the user trusts, which no file may say
_NOT_RECORDED = ("command", "extra_packages", "trust")


@dataclass(frozen=True)
class TrainOptions:
    """
    Options of a run that are not part of its configuration.

    :param seed: Seed of the team and its environments. None to draw one, which is recorded in ``run.json``
    :param log_folder: Folder of all runs
    :param tensorboard_log: Folder of the TensorBoard logs, or None for none
    :param eval_freq: Number of joint steps between evaluations, -1 for no evaluation
    :param eval_episodes: Number of episodes of an evaluation
    :param n_eval_envs: Number of environment copies of an evaluation
    :param save_freq: Number of joint steps between checkpoints, -1 for none by steps
    :param save_every: Seconds between checkpoints, -1 for none by time
    :param vec_env: ``"dummy"`` to step all environment copies in this process, ``"subproc"`` for a worker process per copy
    :param step_timeout: Seconds within which a worker process must answer, -1 for no limit
    :param restart_workers: How often each copy of the environment is made anew after a fault
    :param device: Device of all models: ``"auto"``, ``"cpu"``, ``"cuda"``, ...
    :param num_threads: Number of torch's threads, -1 for torch's default
    :param jobs: Number of processes, the main one included, in which the agents with on-policy algorithms learn. Each agent
        learns wholly in one of them. The result is the same for any number, to the bit on the CPU. See ``Team``
    :param on_nan: ``"raise"`` or ``"skip"``: what is done when loss or parameters are not finite. See ``Team``
    :param progress: Whether to show a progress bar
    :param track: Experiment tracker that the run is logged to, ``"wandb"`` or ``"mlflow"``; None for none
    :param track_project: Its project, or experiment; None for "sb3-belief"
    :param trained_agent: Folder of a run, or zip of a team, whose training is to be continued
    :param extra_packages: See ``names.resolve`` and ``Team.load`` (``allow_packages``)
    :param trust: Whether to load the saved team even if it could run any code
    :param verbose: 0 for no output, 1 for the team's tables, 2 for those of the agents too
    :param command: The words of the command line, recorded in ``run.json``
    """

    seed: int | None = None
    log_folder: str = "logs"
    tensorboard_log: str | None = None
    eval_freq: int = 25_000
    eval_episodes: int = 100
    n_eval_envs: int = 50
    save_freq: int = -1
    save_every: float = 600.0
    vec_env: str = "dummy"
    step_timeout: float = -1.0
    restart_workers: int = 0
    device: str = "auto"
    num_threads: int = 1
    jobs: int = 1
    on_nan: str = "raise"
    progress: bool = False
    track: str | None = None
    track_project: str | None = None
    trained_agent: str | None = None
    extra_packages: tuple[str, ...] = ()
    trust: bool = False
    verbose: int = 1
    command: list[str] = field(default_factory=lambda: list(sys.argv))

    @classmethod
    def defaults(cls, names: Iterable[str]) -> dict[str, Any]:
        """
        Return the values that options have if nothing is said.

        :param names: Their names
        :return: {name: value}
        """
        options = cls()
        return {name: getattr(options, name) for name in names}

    def to_record(self) -> dict[str, Any]:
        """
        Return the options as ``run.json`` holds them, from which the run can be continued.

        :return: {name: value}
        """
        recorded = {name: value for name, value in dataclasses.asdict(self).items() if name not in _NOT_RECORDED}
        # A run may be continued from another folder
        return {**recorded, "tensorboard_log": self.tensorboard_log and os.path.abspath(self.tensorboard_log)}

    @classmethod
    def from_record(cls, recorded: Mapping[str, Any], where: str, **given: Any) -> "TrainOptions":
        """
        Return the options that ``run.json`` holds.

        :param recorded: Its entry ``options``
        :param where: The file, for the error message
        :param given: Options that are given anew
        :return: The options
        :raises ConfigError: If an option is unknown or of another type than it can be
        """
        types = {name: each for name, each in get_type_hints(cls).items() if name not in _NOT_RECORDED}
        for name, value in recorded.items():
            if name not in types:
                raise ConfigError(f"{where}: options: there is no option {short(name)} in this version.")
            # A whole number of seconds is one, and True is no number
            allowed = types[name] | int if types[name] is float else types[name]
            if not isinstance(value, allowed) or (isinstance(value, bool) and types[name] is not bool):
                raise ConfigError(f"{where}: options: {name} cannot be {short(value)}: the file is damaged.")
        return cls(**{**recorded, **given})


@dataclass(frozen=True)
class TrainResult:
    """
    Result of a run.

    :param folder: Folder of the run
    :param team: The team
    :param exit_status: 0 if the training finished, otherwise what a shell shows of a program ended by that signal: 130 after
        Ctrl-C, 143 after SIGTERM, 129 after SIGHUP. Then the folder's ``team.zip`` is the last good state, and the team may
        have been stopped in the middle of a step
    """

    folder: Path
    team: Team
    exit_status: int = 0

    @property
    def finished(self) -> bool:
        """Whether the training finished."""
        return self.exit_status == 0
