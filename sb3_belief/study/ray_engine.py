"""
Running the cells of a study as tasks of a Ray cluster, a task each.

All nodes need this package, in the same version, and the folder of the study at the same path (a network file system). A task
starts the cell in a process of its own, as on one machine. Ray repeats a task whose node is lost on another one, where the
cell goes on from its last checkpoint.
"""

import platform
import secrets
import signal
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from sb3_belief.common.durable_files import replaced_file
from sb3_belief.study.cell import BUSY
from sb3_belief.study.cell_record import FAILED, FINISHED, Cell
from sb3_belief.study.engine import Display, EngineResult, output_end, start_cell
from sb3_belief.zoo.endings import EndSignals
from sb3_belief.zoo.errors import ConfigError

#: File by which a node shows that it sees the folder of the study
TOKEN_FILE = ".shared"
# How often Ray repeats a task whose node or worker is lost
_RETRIES = 10
# Seconds between looks at the tasks, and at a cell that another process runs
_POLL, _POLL_OTHERS = 0.5, 2.0


def run_on_ray(
    cells: Sequence[Cell],
    folder: Path,
    jobs: int | None,
    display: Display,
    extra_packages: tuple[str, ...] = (),
    address: str | None = None,
) -> EngineResult:
    """
    Run all cells that have neither finished nor failed as tasks of Ray, and wait for them.

    :param cells: The cells
    :param folder: Folder of the study, which all nodes must see at this path
    :param jobs: Number of tasks at the same time; None for as many as the cluster has room for
    :param display: What shows the study
    :param extra_packages: Packages that the user allows
    :param address: Address of the cluster; None to start one of this machine
    :return: How they ended
    :raises ConfigError: If there is no such cluster
    """
    import ray

    result = EngineResult()
    token = secrets.token_hex(16)
    with replaced_file(folder / TOKEN_FILE, "w", encoding="utf-8") as file:
        file.write(token)
    started = not ray.is_initialized()
    if started:
        try:
            ray.init(address=address, log_to_driver=False, configure_logging=False, include_dashboard=False)
        # Ray raises whatever it raises for an address that is none
        except Exception as error:
            reason = " ".join(str(error).split())[:200]
            raise ConfigError(f"--address: Ray cannot be reached at {address!r} ({reason}): is the cluster up?") from None
    try:
        with EndSignals():
            _wait_for(cells, folder.absolute(), token, jobs, display, extra_packages, result)
    except KeyboardInterrupt as error:
        result.exit_status = getattr(error, "exit_status", 128 + signal.SIGINT)
    finally:
        if started:
            # Tasks that run end with their driver, and the cells with them, which save first
            ray.shutdown()
    return result


def _wait_for(
    cells: Sequence[Cell],
    folder: Path,
    token: str,
    jobs: int | None,
    display: Display,
    extra_packages: tuple[str, ...],
    result: EngineResult,
) -> None:
    import ray

    waiting = [cell for cell in cells if cell.read()["status"] not in (FINISHED, FAILED)]
    tasks: dict[Any, Cell] = {}
    remote = ray.remote(run_cell_in_task)
    while waiting or tasks:
        while waiting and (jobs is None or len(tasks) < jobs):
            cell = waiting.pop(0)
            options = cell.read()["options"]
            task = remote.options(
                name=f"{cell.name}",
                num_cpus=max(options["jobs"], options["num_threads"], 1),
                num_gpus=1 if str(options["device"]).startswith("cuda") else 0,
                max_retries=_RETRIES,
            )
            tasks[task.remote(str(cell.folder.absolute()), str(folder), token, extra_packages)] = cell
        done, _ = ray.wait(list(tasks), timeout=_POLL)
        for reference in done:
            cell = tasks.pop(reference)
            try:
                why = ray.get(reference)
            # An error of the task, or of Ray after all retries
            except Exception as error:
                why = " ".join(str(error).split())[-300:]
            if why is not None:
                result.failures[cell] = why
            display.tell(f"{cell.name}: {'finished' if why is None else 'failed'}")
        display.update()


def run_cell_in_task(cell_folder: str, folder: str, token: str, extra_packages: tuple[str, ...]) -> str | None:
    """
    Run a cell on the node of a task.

    :param cell_folder: Folder of the cell
    :param folder: Folder of the study
    :param token: What the study has written there
    :param extra_packages: Packages that the user allows
    :return: Why the cell failed, or None
    """
    seen = None
    with suppress(OSError):
        seen = (Path(folder) / TOKEN_FILE).read_text(encoding="utf-8")
    if seen != token:
        return (
            f"the node {platform.node()} does not see the folder {folder} of the study: all nodes must share it, at the same"
            " path, such as by a network file system."
        )
    cell = Cell(Path(cell_folder))
    while True:
        with tempfile.TemporaryFile() as output:
            process = start_cell(cell, extra_packages, output)
            status = process.wait()
            lines = output_end(output).splitlines()
        if status != BUSY:
            break
        # Of a lost node, whose cell still saves, or of another study
        time.sleep(_POLL_OTHERS)
    record = cell.read()
    if record["status"] == FINISHED:
        return None
    return record["error"] or (lines or [f"its process ended with status {status}"])[-1].removeprefix("Failed: ")
