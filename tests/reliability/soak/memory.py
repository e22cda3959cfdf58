"""The memory of a long training."""

import re
import signal
import statistics
import time
from collections.abc import Sequence
from pathlib import Path

from tests.reliability.processes import Launcher
from tests.reliability.soak.report import Report
from tests.zoo.runs import record_of

#: What may be added after the first ten minutes
MOST_GROWTH = 0.05
_MIB = 1024.0


def growth(samples: Sequence[tuple[float, float]], after: float) -> tuple[float, float, float] | None:
    """
    Return how memory grew: what it was after a while and at the end, and the growth as a share of the first.

    Both are medians over a tenth of the samples.

    :param samples: Pairs of seconds and memory, in the order of time
    :param after: Seconds at the beginning that do not count
    :return: None if there are no two samples to compare
    """
    sizes = [size for seconds, size in samples if seconds >= after]
    if len(sizes) < 2:
        return None
    count = max(len(sizes) // 10, 1)
    start, end = statistics.median(sizes[:count]), statistics.median(sizes[-count:])
    return start, end, end / start - 1


class LongTraining:
    """
    A training that runs while others are disturbed, with checkpoints and evaluations.

    :param launcher: Starts it
    :param folder: Its log folder
    """

    def __init__(self, launcher: Launcher, folder: Path):
        self._folder = folder
        words = [
            *("train", "--algo", "belief_ppo", "--env", "traffic-junction-easy", "-n", "100000000", "--seed", "1"),
            *("-f", str(folder), "--verbose", "0", "--save-every", "20s", "--eval-freq", "10000", "--eval-episodes", "20"),
            *("--n-eval-envs", "10", "-params", "n_envs:8", "history_length:200", "n_epochs:2"),
        ]
        self._training = launcher.start(words, anew=True)
        self._start = time.monotonic()
        self.samples: list[tuple[float, float]] = []

    def sample(self) -> None:
        """Note the memory that it has now."""
        try:
            text = Path(f"/proc/{self._training.pid}/status").read_text()
        except OSError:
            return
        match = re.search(r"VmRSS:\s+(\d+) kB", text)
        # Not while it imports
        if match is not None and next(self._folder.glob("*/*/checkpoints/*.zip"), None) is not None:
            self.samples.append((time.monotonic() - self._start, int(match[1]) / _MIB))

    def end(self, report: Report) -> None:
        """End it by a signal, and report."""
        passed = time.monotonic() - self._start
        report.check("the long training runs", self._training.poll() is None, self._training.output)
        self._training.send(signal.SIGTERM)
        report.check("exit status", self._training.wait(60) == 143, f"the long training: {self._training.output}")
        # Ten minutes, or a third of a short soak
        after = min(600.0, passed / 3)
        found = growth(self.samples, after)
        if found is None:
            report.notes["too short to see memory grow"] += 1
        else:
            first, last, grown = found
            steps = record_of(next(self._folder.glob("*/*/run.json")).parent)["timesteps"]
            report.memory = {"first": first, "after": after / 60, "last": last, "growth": grown, "steps": steps}
            report.check("memory grows by less than 5 %", grown < MOST_GROWTH, f"{first:.1f} to {last:.1f} MiB")
        report.check("no process is left", self._training.has_left_none(), f"{self._training.descendants()}")
