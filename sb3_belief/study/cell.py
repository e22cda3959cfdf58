"""
A cell of a study in a process of its own: ``python -m sb3_belief.study.cell FOLDER``.

It holds the folder's lock for as long as it lives, so that nobody else runs the same cell, whatever has become of the process
that started it.
"""

import argparse
import contextlib
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sb3_belief.common.durable_files import sweep_temporary_files
from sb3_belief.study.cell_record import CELL_CONFIG, FAILED, FINISHED, FREE_OPTIONS, RUNNING, WAITING, Cell
from sb3_belief.zoo.errors import ConfigError, RunFailed, cause
from sb3_belief.zoo.run_lock import run_lock

#: Exit status if another process runs the cell (EX_TEMPFAIL of sysexits.h)
BUSY = 75
# Seconds that a cell has for saving when its parent has gone, before it is killed
_PATIENCE = 120.0


def cell_main(argv: Sequence[str] | None = None) -> int:
    """
    Run a cell to its end, unless another process does.

    :param argv: The words after the name of the module. None for those of the process
    :return: Exit status: 0 if it has finished, 1 if it failed, ``BUSY`` if another process runs it, and 128 + the number of
        the signal that ended it
    """
    parser = argparse.ArgumentParser(prog="python -m sb3_belief.study.cell", description=__doc__, allow_abbrev=False)
    parser.add_argument("folder", help="folder of the cell")
    parser.add_argument("--allow-package", nargs="+", action="extend", default=[], help="as for train")
    parser.add_argument("--with-parent", action="store_true", help="end when the standard input is closed")
    args = parser.parse_args(argv)
    if args.with_parent:
        threading.Thread(target=_end_with_parent, name="ends-with-parent", daemon=True).start()
    cell = Cell(Path(args.folder))
    with contextlib.ExitStack() as stack:
        try:
            # Before anything slow is imported, since others look for cells that nobody has locked
            stack.enter_context(run_lock(cell.folder))
        except ConfigError as error:
            print(error, file=sys.stderr)
            return BUSY
        except OSError as error:
            print(f"Failed: {cell.folder} cannot be locked ({error.strerror}).", file=sys.stderr)
            return 1
        return _run(cell, tuple(args.allow_package))


def _end_with_parent() -> None:
    """Have this process save and end once its parent has, however that ended."""
    with contextlib.suppress(OSError):
        while os.read(0, 1):
            pass
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(_PATIENCE)
    if hasattr(os, "killpg") and os.getpgrp() == os.getpid():
        os.killpg(0, signal.SIGKILL)
    os._exit(1)


def _run(cell: Cell, extra_packages: tuple[str, ...]) -> int:
    # Imported here, as all that takes seconds, so that the lock is there before
    from sb3_belief.zoo.endings import TRACEBACK, EndSignals, Interrupted, write_traceback

    start = time.monotonic()
    record: dict[str, Any] | None = None
    status, what = 0, dict[str, Any]()
    with EndSignals() as signals:
        try:
            record = cell.read()
            if record["status"] == FINISHED:
                return 0
            sweep_temporary_files(cell.folder)
            (cell.folder / TRACEBACK).unlink(missing_ok=True)
            record.update(status=RUNNING, attempts=record["attempts"] + 1, error=None)
            cell.write(record)
            status, what = _train_and_evaluate(cell, record, extra_packages)
            signals.hold()
        except BaseException as caught:
            signals.hold()
            error = signals.cause_of(caught)
            if isinstance(error, KeyboardInterrupt):
                status = error.exit_status if isinstance(error, Interrupted) else 128 + signal.SIGINT
            else:
                # The run's own error tells more than that the run has failed
                shown = error.__cause__ if isinstance(error, RunFailed) and error.__cause__ is not None else error
                status, what = 1, {"error": cause(shown)}
                write_traceback(cell.folder, shown)
                print(f"Failed: {what['error']}", file=sys.stderr)
        # Within the context, so that a second signal does not end this
        return status if record is None else _write_down(cell, record, status, what, time.monotonic() - start)


def _write_down(cell: Cell, record: dict[str, Any], status: int, what: dict[str, Any], seconds: float) -> int:
    """Record how a cell has ended, and return its exit status."""
    record.update(what, status=FINISHED if status == 0 else FAILED if status == 1 else WAITING)
    record["seconds"] = round(record.get("seconds", 0.0) + seconds, 1)
    record["cpu_seconds"] = round(record.get("cpu_seconds", 0.0) + _cpu_seconds(), 1)
    try:
        cell.write(record)
    except OSError as error:
        print(f"Failed: {cell.path} could not be written ({error.strerror}).", file=sys.stderr)
        return 1 if status == 0 else status
    return status


def _cpu_seconds() -> float:
    """Return what this process and the workers that it has waited for have used."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def _train_and_evaluate(cell: Cell, record: dict[str, Any], extra_packages: tuple[str, ...]) -> tuple[int, dict[str, Any]]:
    """Return the exit status, and what comes into the record."""
    import pyarrow as pa

    from sb3_belief.common.threads import use_threads
    from sb3_belief.report.episodes import EPISODES, write_episodes_table
    from sb3_belief.study.final_evaluation import episode_rows
    from sb3_belief.zoo.config import load_config

    config = load_config(record["algo"], record["env"], str(cell.folder / CELL_CONFIG), extra_packages=extra_packages)
    status, run = _train(cell, record, config, extra_packages)
    if status:
        return status, {}
    # A run that had finished before has not set them
    use_threads(record["options"]["num_threads"])
    rows = episode_rows(record, config, run, extra_packages)
    write_episodes_table(pa.Table.from_pylist(rows, schema=EPISODES), cell.episodes)
    return 0, {"run": run.relative_to(cell.folder).as_posix()}


def _train(cell: Cell, record: dict[str, Any], config: Any, extra_packages: tuple[str, ...]) -> tuple[int, Path]:
    """Train the run of a cell, or go on with it. Return the exit status and its folder."""
    from sb3_belief.zoo.continuation import NO_CHECKPOINT, Continuation, resume
    from sb3_belief.zoo.run_folder import read_record, whole_checkpoints
    from sb3_belief.zoo.train import train
    from sb3_belief.zoo.train_options import TrainOptions

    command = ["python", "-m", "sb3_belief.study.cell", str(cell.folder)]
    run = cell.run_folder(record)
    if run is not None:
        if read_record(run).get("status") == "finished":
            return 0, run
        if next(whole_checkpoints(run), None) is not None:
            free = {name: record["options"][name] for name in FREE_OPTIONS}
            try:
                result = resume(Continuation(str(run), None, free, extra_packages, command=command))
            except ConfigError as error:
                # Some trainings cannot be continued exactly, and their checkpoints hold the models only
                if NO_CHECKPOINT not in str(error):
                    raise
            else:
                assert result is not None
                return result.exit_status, run
    # What has no checkpoint to go on from is begun anew, and is in the way of the folder's name
    shutil.rmtree(cell.folder / record["algo"], ignore_errors=True)
    options = TrainOptions(
        **record["options"],
        seed=record["seed"],
        log_folder=str(cell.folder),
        extra_packages=extra_packages,
        verbose=0,
        command=command,
    )
    result = train(config, options)
    return result.exit_status, result.folder


if __name__ == "__main__":
    sys.exit(cell_main())
