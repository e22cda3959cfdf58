"""Measure loops in turns within one run, so that whatever else the machine does affects all of them alike."""

import multiprocessing
import os
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

#: Does some steps and returns how many
Loop = Callable[[], int]


class Sample(NamedTuple):
    """
    One measurement.

    :param steps: Number of steps that were done
    :param cpu: CPU seconds that they took, of this process and its workers
    :param wall: Wall-clock seconds that passed
    """

    steps: int
    cpu: float
    wall: float


class Spread(NamedTuple):
    """
    Median and quartiles of several values.

    :param median: Half of the values are below it
    :param low: A quarter of the values are below it
    :param high: A quarter of the values are above it
    """

    median: float
    low: float
    high: float


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def cpu_seconds() -> float:
    """Return the CPU time so far of this process, of its children that have ended and (on Linux) of its live workers."""
    times = os.times()
    return time.process_time() + times.children_user + times.children_system + _workers_cpu_seconds()


def _workers_cpu_seconds() -> float:
    seconds = 0.0
    for process in multiprocessing.active_children():
        # The system adds a child's time to that of its parent only when the child has ended
        stat = Path(f"/proc/{process.pid}/stat")
        if stat.exists():
            # After the name, which may contain spaces: user and system time are fields 14 and 15 of the line
            user, system = stat.read_text().rpartition(")")[2].split()[11:13]
            seconds += (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")
    return seconds


def take(loop: Loop) -> Sample:
    """Call the loop once and return its measurement."""
    cpu, wall = cpu_seconds(), time.perf_counter()
    steps = loop()
    passed = time.perf_counter() - wall
    return Sample(steps, cpu_seconds() - cpu, passed)


def alternate(loops: Mapping[str, Loop], rounds: int, warmup: int = 1) -> dict[str, list[Sample]]:
    """
    Measure the loops in turns.

    :param loops: The loops to compare, by name
    :param rounds: Number of measurements of each loop
    :param warmup: Number of calls of each loop beforehand that are not measured
    :return: The measurements of each loop, one per round
    """
    for loop in loops.values():
        for _ in range(warmup):
            loop()
    samples: dict[str, list[Sample]] = {name: [] for name in loops}
    for i in range(rounds):
        # Back and forth, so that no loop always runs after the one that leaves the caches in the worst state
        for name in list(loops)[:: 1 if i % 2 == 0 else -1]:
            samples[name].append(take(loops[name]))
    return samples


def spread(values: Sequence[float]) -> Spread:
    """Return median and quartiles of at least one value."""
    if len(values) < 2:
        return Spread(values[0], values[0], values[0])
    low, median, high = statistics.quantiles(values, n=4, method="inclusive")
    return Spread(median, low, high)


def speeds(samples: Sequence[Sample], clock: str = "cpu") -> list[float]:
    """Return the steps per second of each sample, by the clock ``"cpu"`` or ``"wall"``."""
    # A worker's CPU clock is coarse: the shortest measurements may not take a single tick of it
    return [sample.steps / max(getattr(sample, clock), 1e-9) for sample in samples]


def ratio(of: Sequence[Sample], to: Sequence[Sample], clock: str = "cpu") -> Spread:
    """
    Compare the speeds of two loops round by round, since the machine changes more slowly than the loops take turns.

    :param of: Measurements of one loop
    :param to: Measurements of another loop, from the same rounds
    :param clock: ``"cpu"`` or ``"wall"``
    :return: Speed of the first loop divided by that of the second
    """
    return spread([a / b for a, b in zip(speeds(of, clock), speeds(to, clock), strict=True)])
