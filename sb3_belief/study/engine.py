"""Running the cells of a study in processes of this machine, a process each."""

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Protocol

from sb3_belief.study.cell import BUSY
from sb3_belief.study.cell_record import FAILED, FINISHED, WAITING, Cell
from sb3_belief.zoo.endings import TRACEBACK, EndSignals, tell
from sb3_belief.zoo.errors import ConfigError

# Seconds between looks at the processes, and at cells that others run
_POLL, _POLL_OTHERS = 0.1, 1.0
#: How often the process of a cell may be killed, by the system for lack of memory for example, before the cell has failed
MOST_KILLS = 3
# How much of what a cell wrote is read if it failed without a record
_TAIL = 4000


class Display(Protocol):
    """What shows a study."""

    def tell(self, text: str) -> None:
        """
        Say what has happened.

        :param text: A line
        """

    def update(self) -> None:
        """Show how far the cells are."""


@dataclass
class EngineResult:
    """
    How the cells of a study ended.

    :param failures: Why cells failed whose record could not say so
    :param exit_status: 0, or 128 + the number of the signal that ended the study
    """

    failures: dict[Cell, str] = field(default_factory=dict)
    exit_status: int = 0


@dataclass
class _Running:
    """
    A cell's process.

    :param cell: The cell
    :param process: Its process
    :param output: What it writes
    """

    cell: Cell
    process: subprocess.Popen
    output: IO[bytes]


def start_cell(cell: Cell, extra_packages: tuple[str, ...], output: IO[bytes]) -> subprocess.Popen:
    """
    Start a cell in a process that ends, saving, when this process has ended.

    :param cell: The cell
    :param extra_packages: Packages that the user allows
    :param output: File that takes what it writes
    :return: The process; the pipe to its standard input must stay open for as long as it is to run
    """
    words = [sys.executable, "-m", "sb3_belief.study.cell", str(cell.folder.absolute()), "--with-parent"]
    if extra_packages:
        words += ["--allow-package", *extra_packages]
    # The same package as here, wherever this process found it
    root = str(Path(__file__).resolve().parents[2])
    path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
    return subprocess.Popen(
        words,
        stdin=subprocess.PIPE,
        stdout=output,
        stderr=subprocess.STDOUT,
        env={**os.environ, "PYTHONPATH": path},
        # A terminal sends Ctrl-C to its whole group, but this process decides when its cells end
        start_new_session=True,
    )


def output_end(output: IO[bytes]) -> str:
    """
    Return the end of what a cell has written.

    :param output: The file that took it
    :return: At most 4,000 bytes, as text
    """
    size = output.seek(0, os.SEEK_END)
    output.seek(max(size - _TAIL, 0))
    return output.read().decode(errors="replace").strip()


def run_local(cells: Sequence[Cell], jobs: int, display: Display, extra_packages: tuple[str, ...] = ()) -> EngineResult:
    """
    Run all cells that have neither finished nor failed, and wait for those that other processes run.

    :param cells: The cells
    :param jobs: Number of processes at the same time
    :param display: What shows the study
    :param extra_packages: Packages that the user allows
    :return: How they ended
    """
    pool = _Pool(cells, jobs, display, extra_packages)
    try:
        with EndSignals() as signals:
            try:
                pool.run()
            except BaseException:
                signals.hold()
                pool.end()
                raise
    except KeyboardInterrupt as error:
        pool.result.exit_status = getattr(error, "exit_status", 128 + signal.SIGINT)
    return pool.result


class _Pool:
    """
    Processes that run cells.

    :param cells: The cells
    :param jobs: Number of processes at the same time
    :param display: What shows the study
    :param extra_packages: Packages that the user allows
    """

    def __init__(self, cells: Sequence[Cell], jobs: int, display: Display, extra_packages: tuple[str, ...]):
        self._waiting = list(cells)
        self._jobs, self._display, self._extra_packages = jobs, display, extra_packages
        self._running: list[_Running] = []
        self._kills: dict[Cell, int] = {}
        self._look_at = -float("inf")
        self.result = EngineResult()

    def run(self) -> None:
        """Run the cells to their ends."""
        while self._waiting or self._running:
            for each in list(self._running):
                if each.process.poll() is not None:
                    self._running.remove(each)
                    self._ended(each)
            if self._waiting and len(self._running) < self._jobs and time.monotonic() >= self._look_at:
                self._start_some()
            self._display.update()
            if self._waiting or self._running:
                time.sleep(_POLL)

    def _start_some(self) -> None:
        for cell in list(self._waiting):
            if len(self._running) == self._jobs:
                return
            with cell.held() as free:
                status = cell.read()["status"] if free else None
            if status in (FINISHED, FAILED):
                self._waiting.remove(cell)
            elif free:
                self._waiting.remove(cell)
                self._start(cell)
        if self._waiting:
            # All that are left are run by others. They may be left behind, so that they are looked at again
            self._look_at = time.monotonic() + _POLL_OTHERS

    def _start(self, cell: Cell) -> None:
        output = tempfile.TemporaryFile()
        self._running.append(_Running(cell, start_cell(cell, self._extra_packages, output), output))
        self._display.tell(f"{cell.name}: started")

    def _ended(self, each: _Running) -> None:
        status, cell = each.process.returncode, each.cell
        assert each.process.stdin is not None
        each.process.stdin.close()
        with each.output as output:
            text = output_end(output)
        if status == BUSY:
            # Another study was quicker
            self._waiting.append(cell)
            self._look_at = time.monotonic() + _POLL_OTHERS
            return
        record = _status_of(cell)
        if record == FINISHED:
            self._display.tell(f"{cell.name}: finished")
        elif record == FAILED:
            self._display.tell(f"{cell.name}: failed")
        elif (status < 0 or status > 128) and self._kills.get(cell, 0) + 1 < MOST_KILLS:
            # It was killed or ended alone, and goes on from what it has saved
            self._kills[cell] = self._kills.get(cell, 0) + 1
            self._waiting.insert(0, cell)
            self._display.tell(f"{cell.name}: its process was ended ({_how(status)}), it is started again")
        else:
            why = (text.splitlines() or [""])[-1].removeprefix("Failed: ")
            self._fail(cell, f"its process ended: {_how(status)}{f': {why}' if why else ''}", text)

    def _fail(self, cell: Cell, why: str, text: str) -> None:
        """Note the failure of a cell whose process could not."""
        self.result.failures[cell] = why
        # The disk may be full
        with suppress(OSError, ConfigError), cell.held() as held:
            if held:
                cell.write({**cell.read(), "status": FAILED, "error": why})
                (cell.folder / TRACEBACK).write_text(f"{text}\n", encoding="utf-8")
        self._display.tell(f"{cell.name}: failed")

    def end(self) -> None:
        """Have all cells save and end, and wait for them."""
        if not self._running:
            return
        tell(f"Saving {len(self._running)} runs. Starting the study again goes on with them.")
        for each in self._running:
            assert each.process.stdin is not None
            # Which tells it as a signal would, and on Windows, too, where that would kill it
            with suppress(OSError):
                each.process.stdin.close()
        for each in self._running:
            each.process.wait()
            each.output.close()


def _status_of(cell: Cell) -> Any:
    try:
        return cell.read()["status"]
    except ConfigError:
        return WAITING


def _how(status: int) -> str:
    if status < 0:
        with suppress(ValueError):
            return f"by {signal.Signals(-status).name}"
    return f"with exit status {status}"
