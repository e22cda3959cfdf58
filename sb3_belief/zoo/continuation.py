"""Going on with a run that was interrupted, failed or killed (``--resume``), or with one that has finished (``--until``)."""

import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch as th

from sb3_belief.common.durable_files import sweep_temporary_files
from sb3_belief.common.safe_files.trust import Trust
from sb3_belief.common.threads import use_threads
from sb3_belief.common.versions import versions
from sb3_belief.team import Team, TeamVecEnv
from sb3_belief.zoo.config import RunConfig, load_config
from sb3_belief.zoo.endings import TRACEBACK, EndSignals
from sb3_belief.zoo.errors import ConfigError, cause
from sb3_belief.zoo.learning import RunCallbacks, learn_and_save
from sb3_belief.zoo.preflight import check_device
from sb3_belief.zoo.run_folder import (
    CHECKPOINTS,
    CONFIG,
    RECORD,
    RunRecord,
    check_record,
    read_record,
    run_of_record,
    whole_checkpoints,
    write_config,
)
from sb3_belief.zoo.run_lock import run_lock
from sb3_belief.zoo.tracking import ENTRY, Tracking, check_tracking
from sb3_belief.zoo.train import common_arguments, make_envs, track
from sb3_belief.zoo.train_options import TrainOptions, TrainResult

#: Words of the refusal to go on with a run of which no checkpoint can be loaded
NO_CHECKPOINT = "no checkpoint of"


@dataclass(frozen=True)
class Continuation:
    """
    What is asked for when a run is to go on.

    :param run: Folder of the run
    :param until: Number of joint steps at which it ends; None for the one that it had
    :param given: Options given anew, by name: those that do not change what is learned
    :param extra_packages: See ``names.resolve`` and ``Team.load`` (``allow_packages``)
    :param trust: Whether to load the checkpoint, and what the run's folder names, even if that could run any code
    :param command: The words of the command line, recorded in ``run.json``
    """

    run: str
    until: int | None = None
    given: dict[str, Any] | None = None
    extra_packages: tuple[str, ...] = ()
    trust: bool = False
    command: Sequence[str] = ()


def resume(asked: Continuation) -> TrainResult | None:
    """
    Go on with a run from its newest whole checkpoint, as if it had never been interrupted.

    It keeps its folder, its configuration and its options. Later rows of its logs are dropped, since they come again.

    :param asked: Which run, and until when
    :return: As ``train`` returns it; None if the run has finished already
    :raises ConfigError: If the run cannot go on. Nothing has been written then
    :raises RunFailed: If the training fails
    """
    folder = Path(asked.run)
    if not (folder / RECORD).is_file():
        raise ConfigError(f"--resume: {str(folder)!r} is not the folder of a run: it has no {RECORD}.")
    with ExitStack() as stack:
        signals = stack.enter_context(EndSignals())
        try:
            stack.enter_context(run_lock(folder))
        except OSError as error:
            raise ConfigError(f"--resume: cannot write to {str(folder)!r} ({error}).") from None
        record = read_record(folder)
        total = _total(record, folder, asked.until)
        if total is None:
            return None
        return _go_on(asked, folder, record, total, signals, stack)


def _total(record: dict[str, Any], folder: Path, until: int | None) -> int | None:
    """Return the number of joint steps at which the run ends; None if it has finished."""
    where = folder / RECORD
    for name in ("total_timesteps", "start_timesteps"):
        if not isinstance(record.get(name), int):
            raise ConfigError(
                f"--resume: {where} does not say {name!r}: an earlier version wrote it, or it is damaged. -i {folder} trains"
                " its team further, in a new run."
            )
    total = record["total_timesteps"]
    if until is not None:
        if until < total or (until == total and record.get("status") == "finished"):
            raise ConfigError(f"--until: the run {folder} goes to {total} joint steps: name more, not {until}.")
        return until
    if record.get("status") == "finished":
        print(f"{folder} has finished, at {record.get('timesteps')} joint steps. --until STEPS trains it further.")
        return None
    return total


def _go_on(
    asked: Continuation, folder: Path, before: dict[str, Any], total: int, signals: EndSignals, stack: ExitStack
) -> TrainResult:
    where = str(folder / RECORD)
    recorded = before.get("options")
    if not isinstance(recorded, dict):
        raise ConfigError(f"--resume: {where} does not hold the run's options: it is damaged.")
    options = TrainOptions.from_record(
        recorded,
        where,
        **(asked.given or {}),
        extra_packages=asked.extra_packages,
        trust=asked.trust,
        command=list(asked.command),
    )
    if options.seed is None:
        raise ConfigError(f"--resume: {where} does not hold the run's seed: it is damaged.")
    check_device(options.device)
    check_tracking(options)
    run = run_of_record(folder, before)
    if run is None:
        raise ConfigError(f"--resume: no {CONFIG} in {str(folder)!r}.")
    check_record(run, asked.extra_packages, trust=asked.trust)
    config = load_config(
        *run[:2],
        str(run[2]),
        extra_packages=asked.extra_packages,
        n_timesteps=total - before["start_timesteps"],
        run_folder=None if asked.trust else folder,
    )
    use_threads(options.num_threads)
    env, eval_env = make_envs(config, options, stack)
    for each in (folder, folder / CHECKPOINTS, *folder.glob("agents/*")):
        sweep_temporary_files(each)
    team, checkpoint = _load_newest(config, options, env, folder, signals)
    _say_what_differs(before)
    # Before the first step puts it back
    monitor = team.monitor_state
    callbacks = RunCallbacks.make(team, config, options, folder, eval_env, signals, checkpoint)
    tracking = Tracking.start(config, options, folder, before)
    write_config(folder, config)
    record = RunRecord(
        folder,
        options.command,
        before,
        total_timesteps=total,
        options={**recorded, **(asked.given or {})},
        device=str(options.device),
        num_threads=th.get_num_threads(),
        jobs=options.jobs,
        **({} if tracking is None else {ENTRY: tracking.to_record()}),
    )
    track(tracking, callbacks, record, stack)
    # Of what ended the run before, which the record has forgotten, too
    (folder / TRACEBACK).unlink(missing_ok=True)
    with record.failures():
        env.start_monitor(str(folder), continue_from=monitor)
        if options.verbose:
            print(f"Run folder: {folder}  (seed {options.seed}), from {checkpoint.name} to {total} joint steps")
        return learn_and_save(team, config, options, folder, record, callbacks, signals, False)


def _load_newest(
    config: RunConfig, options: TrainOptions, env: TeamVecEnv, folder: Path, signals: EndSignals
) -> tuple[Team, Path]:
    """Return the team of the newest checkpoint that can be loaded, and its file."""
    why = ""
    for path in whole_checkpoints(folder):
        try:
            trust = Trust.of(options.trust, options.extra_packages)._asdict()
            return Team.load(path, env=env, exact=True, **trust, **common_arguments(config, options, folder)), path
        # A damaged file makes zipfile, json and torch raise whatever they raise
        except Exception as error:
            signals.check()
            why = f" {cause(error)}"
            print(f"{path} cannot be loaded ({cause(error)}): an earlier checkpoint is looked for.", file=sys.stderr)
    raise ConfigError(
        f"--resume: {NO_CHECKPOINT} {folder} can be loaded.{why} A run that ended before its first one is begun anew; -i"
        " trains the team of a zip further, in a new run."
    )


def _say_what_differs(before: dict[str, Any]) -> None:
    recorded, now = before.get("versions"), versions()
    if isinstance(recorded, dict):
        changed = [f"{name} {recorded.get(name)} -> {now.get(name)}" for name in now if recorded.get(name) != now.get(name)]
        if changed:
            print(
                f"Not the versions of before ({', '.join(changed)}): what is learned may differ from an undisturbed run.",
                file=sys.stderr,
            )
