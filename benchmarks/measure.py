"""Measure several loops in turn within one run: what the machine does besides is then unfair to none of them."""

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

    :param steps: how many were done
    :param cpu: seconds of CPU time that they took, of this process and its workers
    :param wall: seconds that passed
    """

    steps: int
    cpu: float
    wall: float


class Spread(NamedTuple):
    """
    :param median: half of the values are below
    :param low: a quarter of them are below
    :param high: a quarter of them are above
    """

    median: float
    low: float
    high: float


def cores() -> int:
    """
    :return: how many this process may use
    """
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def cpu_seconds() -> float:
    """
    :return: CPU time of this process so far, of the children that it has waited for, and (on Linux) of the workers that live
    """
    times = os.times()
    return time.process_time() + times.children_user + times.children_system + _workers_cpu_seconds()


def _workers_cpu_seconds() -> float:
    seconds = 0.0
    for process in multiprocessing.active_children():
        # A process is counted among the children that were waited for only when it has ended
        stat = Path(f"/proc/{process.pid}/stat")
        if stat.exists():
            # Behind the name, which may hold blanks: user and system time are the 14th and 15th field of all
            user, system = stat.read_text().rpartition(")")[2].split()[11:13]
            seconds += (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")
    return seconds


def take(loop: Loop) -> Sample:
    """
    :param loop: what to measure
    :return: one measurement of it
    """
    cpu, wall = cpu_seconds(), time.perf_counter()
    steps = loop()
    passed = time.perf_counter() - wall
    return Sample(steps, cpu_seconds() - cpu, passed)


def alternate(loops: Mapping[str, Loop], rounds: int, warmup: int = 1) -> dict[str, list[Sample]]:
    """
    :param loops: what to compare, by name
    :param rounds: measurements of each
    :param warmup: runs of each beforehand that do not count
    :return: the measurements of each, round by round
    """
    for loop in loops.values():
        for _ in range(warmup):
            loop()
    samples: dict[str, list[Sample]] = {name: [] for name in loops}
    for i in range(rounds):
        # Back and forth, so that nobody always comes after the one that spoils the caches
        for name in list(loops)[:: 1 if i % 2 == 0 else -1]:
            samples[name].append(take(loops[name]))
    return samples


def spread(values: Sequence[float]) -> Spread:
    """
    :param values: at least one
    :return: their median and quartiles
    """
    if len(values) < 2:
        return Spread(values[0], values[0], values[0])
    low, median, high = statistics.quantiles(values, n=4, method="inclusive")
    return Spread(median, low, high)


def speeds(samples: Sequence[Sample], clock: str = "cpu") -> list[float]:
    """
    :param samples: measurements of one loop
    :param clock: ``"cpu"`` or ``"wall"``
    :return: steps per second of each
    """
    # A worker's clock is coarse, and the shortest measurements may take no tick of it
    return [sample.steps / max(getattr(sample, clock), 1e-9) for sample in samples]


def ratio(of: Sequence[Sample], to: Sequence[Sample], clock: str = "cpu") -> Spread:
    """
    :param of: measurements of one loop
    :param to: of another, in the same rounds
    :param clock: ``"cpu"`` or ``"wall"``
    :return: the speed of the one over that of the other; round by round, since the machine changes more slowly than the loops
        take turns
    """
    return spread([a / b for a, b in zip(speeds(of, clock), speeds(to, clock), strict=True)])
