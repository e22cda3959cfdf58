"""The command ``tune``: it begins a tuning of hyper-parameters or goes on with it, in one process or in several."""

import contextlib
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path

from sb3_belief.common.durable_files import make_folder, replaced_file
from sb3_belief.study.trials_table import BEST, best_trial
from sb3_belief.study.tuning import exclusive, run_trials, update_results
from sb3_belief.study.tuning_spec import TuningSpec, load_tuning
from sb3_belief.study.tuning_storage import MOST_ATTEMPTS, Storage
from sb3_belief.zoo.errors import ConfigError, RunFailed, reason_of
from sb3_belief.zoo.preflight import check_device, check_folder
from sb3_belief.zoo.run_files import SPEC, STORAGE, TABLE

# Seconds that workers have to save after they were asked to end
_TO_END = 60.0


@dataclass(frozen=True)
class TuneOptions:
    """
    What is asked for besides the specification.

    :param file: YAML file of the tuning
    :param log_folder: Folder of all tunings
    :param jobs: Number of processes, each of which trains a trial at a time
    :param extra_packages: See ``names.resolve``
    """

    file: str
    log_folder: str = "logs/tuning"
    jobs: int = 1
    extra_packages: tuple[str, ...] = ()


def tune(options: TuneOptions) -> int:
    """
    Tune hyper-parameters, or go on with a tuning that has begun, and print what was found.

    :param options: What is asked for
    :return: Exit status: 0, or what a shell shows of a program ended by the signal that has ended the tuning
    :raises ConfigError: If the specification does not fit. Nothing has been written then
    :raises RunFailed: If trials cannot be trained
    """
    if find_spec("optuna") is None:
        raise ConfigError("tune: the search needs Optuna: pip install 'sb3-belief[tune]'.")
    spec = load_tuning(options.file)
    check_device(spec.train["device"])
    spec.check(options.extra_packages)
    folder = Path(options.log_folder, spec.name)
    check_folder(folder, "-f")
    begin(spec, folder)
    print(f"Tuning: {folder}  ({spec.n_trials} trials of {spec.algo} on {spec.env})", flush=True)
    if options.jobs == 1:
        status = run_trials(spec, folder, options.extra_packages, _say)
    else:
        status = _run_workers(folder, options)
    update_results(folder, spec, options.extra_packages)
    _tell_best(folder, spec)
    return status


def begin(spec: TuningSpec, folder: Path) -> None:
    """
    Make the folder of a tuning with its specification and storage, unless it is there.

    :param spec: The specification
    :param folder: The folder
    :raises ConfigError: If the folder is that of another tuning, if its storage is damaged, or if it cannot be written
    """
    before = load_tuning(folder / SPEC) if (folder / SPEC).is_file() else None
    if before is not None:
        changed = [
            name for name, value in vars(spec).items() if name not in ("n_trials", "source") and value != getattr(before, name)
        ]
        if changed:
            raise ConfigError(
                f"{spec.source}: {', '.join(changed)}: the tuning in {str(folder)!r} began with something else, and its trials"
                " could not be compared. Give this one another name; n_trials alone may be changed."
            )
    elif (folder / STORAGE).exists():
        raise ConfigError(f"-f: {str(folder)!r} holds a {STORAGE} and no {SPEC}: restore it, or give the tuning another name.")
    try:
        make_folder(folder)
        with exclusive(folder):
            # Optuna makes its tables only here, where no other process does
            Storage(folder, spec)
            with replaced_file(folder / SPEC, "w", encoding="utf-8") as file:
                file.write(spec.to_yaml())
    except OSError as error:
        raise ConfigError(f"-f: cannot write in {str(folder)!r} ({reason_of(error)}): name one that can be written.") from None


def work(folder: Path, extra_packages: tuple[str, ...]) -> int:
    """
    Train trials of a tuning that has begun, as one of several processes.

    :param folder: Folder of the tuning
    :param extra_packages: See ``names.resolve``
    :return: Exit status, as of ``run_trials``
    """
    return run_trials(replace(load_tuning(folder / SPEC), source=str(folder / SPEC)), folder, extra_packages, _say)


def _say(line: str) -> None:
    print(line, flush=True)


def _run_workers(folder: Path, options: TuneOptions) -> int:
    command = [sys.executable, "-m", "sb3_belief.study.tuning_worker", str(folder), *options.extra_packages]

    def start() -> subprocess.Popen[bytes]:
        # A worker ends when this process does, which closes the pipe however it ends
        return subprocess.Popen(command, stdin=subprocess.PIPE)

    workers = [start() for _ in range(options.jobs)]
    n_restarts = 0
    try:
        while workers:
            time.sleep(0.1)
            for worker in [each for each in workers if each.poll() is not None]:
                workers.remove(worker)
                status = worker.returncode
                if status in (1, 2):
                    raise RunFailed("A process of the tuning has failed, as it said above.")
                if status in (129, 130, 143):
                    return status
                if status != 0:
                    # Killed, perhaps for want of memory. Its trial is repeated
                    n_restarts += 1
                    if n_restarts > MOST_ATTEMPTS * options.jobs:
                        raise RunFailed(f"Processes of the tuning were killed {n_restarts} times: give them more memory.")
                    _say("A process of the tuning was killed; its trial is repeated.")
                    workers.append(start())
        return 0
    finally:
        _end(workers)


def _end(workers: list["subprocess.Popen[bytes]"]) -> None:
    for worker in workers:
        with contextlib.suppress(OSError):
            if worker.stdin is not None:
                worker.stdin.close()
    deadline = time.monotonic() + _TO_END
    for worker in workers:
        try:
            worker.wait(max(deadline - time.monotonic(), 0.1))
        except subprocess.TimeoutExpired:
            worker.kill()
            worker.wait()


def _tell_best(folder: Path, spec: TuningSpec) -> None:
    trials = Storage(folder, spec).trials()
    running = sum(each.state.name == "RUNNING" for each in trials)
    if running:
        print(f"{running} trials are still being trained by another process.")
    best = best_trial(trials)
    if best is None:
        print(f"No trial is complete yet. Trials: {folder / TABLE}")
        return
    print(f"Best: trial {best.number} with a mean {spec.objective} of {best.value:.6g}. Trials: {folder / TABLE}")
    print(f"To train with it: sb3-belief train --algo {spec.algo} --env {spec.env} -conf {folder / BEST}")
