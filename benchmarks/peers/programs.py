"""Programs that train in processes of their own, one iteration at a time, on request."""

import json
import os
import subprocess
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.measure import Sample

ROOT = Path(__file__).resolve().parents[2]


class ProgramError(RuntimeError):
    """Error for a program that did not answer."""


def tree_cpu_seconds(pid: int) -> float:
    """
    Return the CPU time so far of a process, of all its descendants, and of those among them that have ended.

    It is read from /proc, in ticks of 10 ms, so on Linux only.
    """
    children: dict[int, list[int]] = {}
    times: dict[int, int] = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            # After the name, which may contain spaces: field 4 of the line is the parent, fields 14 to 17 are times
            fields = path.read_text().rpartition(")")[2].split()
        except (FileNotFoundError, ProcessLookupError):
            continue
        each = int(path.parent.name)
        children.setdefault(int(fields[1]), []).append(each)
        times[each] = sum(map(int, fields[11:15]))
    ticks, waiting = 0, [pid]
    while waiting:
        each = waiting.pop()
        ticks += times.get(each, 0)
        waiting += children.get(each, [])
    return ticks / os.sysconf("SC_CLK_TCK")


class Program:
    """
    Process that answers in the way of ``benchmarks.peers.child``.

    :param name: Name in the report
    :param command: Command that starts it
    :param seconds: How long an answer may take. After that the process is ended
    """

    def __init__(self, name: str, command: Sequence[str], seconds: float = 300) -> None:
        self.name = name
        self.command = list(command)
        self.seconds = seconds
        #: The first answer: versions, and the work that the first iteration did
        self.about: dict[str, Any] = {}
        self.samples: list[Sample] = []
        #: Why the program was stopped, if it was
        self.error: str | None = None
        self._process: subprocess.Popen[str] | None = None
        self._errors = tempfile.TemporaryFile("w+")
        # CPU seconds that it took, and wall-clock seconds that passed, while other programs had their turns
        self._idle = [0.0, 0.0]
        self._last = (0.0, 0.0)

    def start(self) -> None:
        """Start the process and wait for its first answer. After a failure, here or in a turn, ``error`` says why."""
        if self.error is not None:
            return
        threads = {name: "1" for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
        try:
            self._process = subprocess.Popen(
                self.command,
                cwd=ROOT,
                env={**os.environ, **threads},
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                text=True,
            )
            self.about = self._answer(self._process)
            self._last = (tree_cpu_seconds(self._process.pid), time.perf_counter())
        except (OSError, ProgramError) as error:
            self._fail(error)

    def turn(self) -> int:
        """Let the program train for one iteration, add a sample, and return the number of joint steps."""
        process = self._process
        if process is None or process.stdin is None or self.error is not None:
            return 0
        before = tree_cpu_seconds(process.pid), time.perf_counter()
        try:
            process.stdin.write("go\n")
            process.stdin.flush()
            steps = self._answer(process)["steps"]
        except (OSError, ProgramError) as error:
            self._fail(error)
            return 0
        passed = time.perf_counter() - before[1]
        after = tree_cpu_seconds(process.pid)
        self.samples.append(Sample(steps, after - before[0], passed))
        self._idle = [total + now - then for total, now, then in zip(self._idle, before, self._last, strict=True)]
        self._last = (after, before[1] + passed)
        return steps

    @property
    def idle_share(self) -> float:
        """Share of a core that the program takes while others have their turns."""
        return self._idle[0] / max(self._idle[1], 1e-9)

    def stop(self) -> None:
        """End the process."""
        process = self._process
        if process is None:
            return
        assert process.stdin is not None and process.stdout is not None
        try:
            process.stdin.close()
            process.wait(timeout=30)
        except (OSError, subprocess.TimeoutExpired):
            process.kill()
            process.wait()
        process.stdout.close()
        self._process = None

    def _answer(self, process: "subprocess.Popen[str]") -> dict[str, Any]:
        assert process.stdout is not None
        timer = threading.Timer(self.seconds, process.kill)
        timer.start()
        line = process.stdout.readline()
        timer.cancel()
        if not line:
            late = "no answer in time: " if process.wait() < 0 else ""
            raise ProgramError(late + self._last_words())
        return json.loads(line)

    def _fail(self, error: Exception) -> None:
        self.error = str(error) or type(error).__name__
        self.stop()

    def _last_words(self) -> str:
        self._errors.seek(0)
        lines = [line.strip() for line in self._errors if line.strip()]
        return lines[-1] if lines else "it ended without a message"
