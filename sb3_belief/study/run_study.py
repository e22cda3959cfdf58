"""Running a study: its checks, its folder, its cells, and the table of their episodes."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sb3_belief.study.cell_record import FAILED, Cell
from sb3_belief.study.checks import check_study
from sb3_belief.study.engine import EngineResult, run_local
from sb3_belief.study.live_table import StudyDisplay
from sb3_belief.study.specification import Study, load_study
from sb3_belief.study.study_folder import check_folder_of_study, planned_cells, prepare_folder, write_table
from sb3_belief.zoo.errors import ConfigError, short


@dataclass(frozen=True)
class StudyOptions:
    """
    What a study is asked for besides its file.

    :param file: The file
    :param log_folder: Folder of all studies
    :param jobs: Number of runs at the same time, a process each; None for one, or with Ray for as many as its nodes have
        room for
    :param envs: Ids of those of its environments whose runs are started, None for all
    :param retry: Whether runs that failed are started again
    :param dry_run: Whether to check everything and to write nothing
    :param engine: ``"local"`` for processes of this machine, ``"ray"`` for tasks of Ray
    :param address: Address of the Ray cluster, None for a local one
    :param extra_packages: See ``names.resolve``
    """

    file: str
    log_folder: str = "logs/studies"
    jobs: int | None = None
    envs: Sequence[str] | None = None
    retry: bool = False
    dry_run: bool = False
    engine: str = "local"
    address: str | None = None
    extra_packages: tuple[str, ...] = ()


def run_study(options: StudyOptions) -> int:
    """
    Run a study, or go on with it.

    :param options: What is asked for
    :return: Exit status: 0 if all runs have finished, 1 if some failed, 128 + the number of the signal that ended it
    :raises ConfigError: If anything does not fit. Nothing has been written then
    """
    if options.address is not None and options.engine != "ray":
        raise ConfigError("--address: names a Ray cluster: --engine ray.")
    study = load_study(Path(options.file))
    _check_envs(options.envs, study)
    folder = Path(options.log_folder, study.name)
    checked = check_study(study, folder, options.extra_packages, options.engine, options.dry_run)
    planned = planned_cells(study, folder, checked.configs)
    check_folder_of_study(study, folder, planned)
    print(checked.describe(), flush=True)
    if options.dry_run:
        if checked.missing:
            raise ConfigError(
                f"{study.source}: {'; '.join(checked.missing.values())}. All that does not need it has been checked."
            )
        print("Everything has been checked, and nothing was written.")
        return 0
    for line in prepare_folder(study, folder, planned, options.retry):
        print(line)
    cells = [each.cell for each in planned if options.envs is None or each.record["env"] in options.envs]
    jobs = 1 if options.jobs is None else options.jobs
    with StudyDisplay(study.name, cells, jobs) as display:
        if options.engine == "ray":
            from sb3_belief.study.ray_engine import run_on_ray

            result = run_on_ray(cells, folder, options.jobs, display, options.extra_packages, options.address)
        else:
            result = run_local(cells, jobs, display, options.extra_packages)
    failed = _say_failures(cells, result)
    try:
        print(f"Episodes: {write_table(folder, [each.cell for each in planned])}")
    except ConfigError as error:
        # The cells' own files are there, and starting the study again makes the table of them
        print(f"Failed: {error}", file=sys.stderr)
        failed += 1
    if result.exit_status:
        print("Interrupted. The same command goes on.", file=sys.stderr)
        return result.exit_status
    return 1 if failed else 0


def _check_envs(env_ids: Sequence[str] | None, study: Study) -> None:
    trained = dict.fromkeys(env_id for _, env_id in study.pairs())
    for env_id in env_ids or []:
        if env_id not in trained:
            raise ConfigError(f"--envs: {short(env_id)} is none of the environments of {study.source}: {', '.join(trained)}.")


def _say_failures(cells: Sequence[Cell], result: EngineResult) -> int:
    """Say why cells failed, a line each, and return how many did."""
    failures = dict(result.failures)
    for cell in cells:
        record = cell.read()
        if record["status"] == FAILED:
            failures[cell] = record["error"]
    for cell, why in failures.items():
        print(f"Failed: {cell.name}: {why}", file=sys.stderr)
    if failures:
        print(
            f"{len(failures)} runs failed: error.txt in their folders has the traceback, and --retry runs them again.",
            file=sys.stderr,
        )
    return len(failures)
