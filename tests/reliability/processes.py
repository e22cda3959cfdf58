"""Trainings in processes that can be killed, and what is left of them."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
_ENVIRON = {
    **os.environ,
    "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
    "PYTHONWARNINGS": "ignore",
}


class Launcher:
    """
    Starts command lines of ``sb3-belief``.

    :param folder: Where their outputs go
    :param modules: What workers need beside the package
    :param temporary: Folder for temporary files; None for the system's
    """

    def __init__(self, folder: Path, *modules: str, temporary: Path | None = None):
        self._folder = folder
        self._environ = _ENVIRON if temporary is None else {**_ENVIRON, "TMPDIR": str(temporary)}
        self._count = 0
        self._warm = subprocess.Popen(
            [sys.executable, "-m", "tests.reliability.warm", *modules],
            cwd=ROOT,
            env=self._environ,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )
        self._server = self.ask("server")

    def ask(self, *command: Any) -> Any:
        """Return the answer of the process that forks."""
        assert self._warm.stdin is not None and self._warm.stdout is not None
        self._warm.stdin.write(f"{json.dumps(command)}\n".encode())
        self._warm.stdin.flush()
        line = self._warm.stdout.readline()
        assert line, "the process that forks has ended"
        return json.loads(line)

    def start(self, words: Sequence[str], anew: bool = False, limit: int | None = None) -> "Training":
        """
        Start a command line.

        :param words: The words after ``sb3-belief``
        :param anew: Whether to run ``python -m sb3_belief`` instead of forking a process that has imported everything
        :param limit: Largest size of a file in bytes
        """
        self._count += 1
        output = self._folder / f"output_{self._count}.txt"
        if not anew:
            pid = self.ask("start", list(words), str(output), limit)
            return Training(pid, lambda: self.ask("status", pid), output, self._server)
        with open(output, "wb") as file:
            process = subprocess.Popen(
                [sys.executable, "-m", "sb3_belief", *words],
                cwd=ROOT,
                env=self._environ,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        return Training(process.pid, process.poll, output, None)

    def close(self) -> None:
        """End the process that forks."""
        assert self._warm.stdin is not None and self._warm.stdout is not None
        self._warm.stdin.close()
        self._warm.wait(10)
        self._warm.stdout.close()


class Training:
    """
    A process that trains, whose session is its own.

    :param pid: Its number
    :param poll: Returns its exit status, negative for a signal, or None while it runs
    :param output: File of its output
    :param server: The process that forks its workers, if that is another's
    """

    def __init__(self, pid: int, poll: Callable[[], int | None], output: Path, server: int | None):
        self.pid, self.poll, self._output, self._server = pid, poll, output, server

    @property
    def output(self) -> str:
        """What it has printed."""
        return self._output.read_text(errors="replace")

    def send(self, signum: int) -> bool:
        """Send a signal to its process group; return False if it has ended."""
        try:
            os.killpg(self.pid, signum)
        except ProcessLookupError:
            return False
        return True

    def wait(self, seconds: float) -> int | None:
        """Wait for its end, and return its exit status; None if it has not ended then."""
        return wait_for(self.poll, seconds)

    def workers(self) -> list[int]:
        """Return its workers as far as they live, if another process forks them."""
        return [pid for pid, parent, _ in living_processes() if self._server is not None and parent == self._server]

    def descendants(self) -> list[int]:
        """Return the processes that it has started, and their own, as far as they live."""
        found = []
        for pid, parent, session in living_processes():
            # Workers lead process groups of their own, but stay in the session
            if pid != self.pid and (session == self.pid or (self._server is not None and parent == self._server)):
                found.append(pid)
        return found

    def has_left_none(self, seconds: float = 10.0) -> bool:
        """Return whether all processes that it has started end within some seconds."""
        return wait_for(lambda: not self.descendants() or None, seconds) is not None


def living_processes() -> list[tuple[int, int, int]]:
    """Return number, parent and session of each process that is not a zombie."""
    found = []
    for name in os.listdir("/proc"):
        if name.isdigit():
            try:
                fields = Path("/proc", name, "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if fields[0] not in ("Z", "X"):
                found.append((int(name), int(fields[1]), int(fields[3])))
    return found


def wait_for(condition: Callable[[], Any], seconds: float, pause: float = 0.01) -> Any:
    """Ask until the answer is not None, and return it; None if that takes longer."""
    deadline = time.monotonic() + seconds
    while (answer := condition()) is None and time.monotonic() < deadline:
        time.sleep(pause)
    return answer
