"""What a study shows while it runs: a table of its cells in a terminal, and lines elsewhere."""

import sys
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from sb3_belief.study.cell_record import FAILED, FINISHED, RUNNING, Cell, steps_done
from sb3_belief.zoo.errors import ConfigError

# Seconds between looks at the folders of the cells
_EVERY = 2.0


@dataclass
class CellState:
    """
    How far a cell is.

    :param arm: Label of the algorithm
    :param env_id: Id of the environment
    :param seed: Seed of the run
    :param status: As its record has it
    :param steps: Joint steps that are done
    :param total: Joint steps of the run
    :param seconds: Seconds that it took, if it has finished
    """

    arm: str
    env_id: str
    seed: int
    status: str
    steps: int
    total: int
    seconds: float


def cell_state(cell: Cell) -> CellState | None:
    """
    Read how far a cell is.

    :param cell: The cell
    :return: Its state, None if its record cannot be read
    """
    try:
        record = cell.read()
    except ConfigError:
        return None
    steps = steps_done(cell, record)
    seconds = float(record.get("seconds", 0.0))
    return CellState(record["arm"], record["env"], record["seed"], record["status"], steps, record["n_timesteps"], seconds)


class TimeLeft:
    """
    Estimate of the time that a study still takes.

    It takes the speed of the finished cells of the same algorithm and environment, else that of all that was done since the
    study was started.

    :param jobs: Number of cells that run at the same time
    """

    def __init__(self, jobs: int):
        self._jobs = jobs
        self._start = time.monotonic()
        self._done_before: int | None = None

    def estimate(self, states: Sequence[CellState]) -> float | None:
        """
        Return how many seconds are left.

        :param states: Of all cells
        :return: Seconds, or None if nothing is known yet
        """
        speeds: dict[tuple[str, str], list[float]] = defaultdict(list)
        for each in states:
            if each.status == FINISHED and each.seconds > 0:
                speeds[each.arm, each.env_id].append(each.total / each.seconds)
        done = sum(each.steps for each in states)
        if self._done_before is None:
            self._done_before = done
        elapsed = time.monotonic() - self._start
        left = sum(each.status not in (FINISHED, FAILED) for each in states)
        # Other processes and nodes may run some, too
        running = max(min(self._jobs, left), sum(each.status == RUNNING for each in states), 1)
        # Of one process, as those of the finished cells are
        overall = (done - self._done_before) / elapsed / running if elapsed > 0 else 0.0
        known = [speed for each in speeds.values() for speed in each]
        seconds = 0.0
        for each in states:
            if each.status in (FINISHED, FAILED):
                continue
            own = speeds.get((each.arm, each.env_id)) or known or [overall]
            speed = sum(own) / len(own)
            if speed <= 0:
                return None
            seconds += (each.total - each.steps) / speed
        return seconds / running


def duration_text(seconds: float) -> str:
    """
    Return a time in words.

    :param seconds: How long
    :return: Such as ``2 h 05 min``, ``12 min`` or ``40 s``
    """
    if seconds < 60:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"


def matrix_table(name: str, states: Sequence[CellState], left: float | None) -> Group:
    """
    Return the table of cells, a row for each algorithm and a column for each environment, under a line for all.

    :param name: Name of the study
    :param states: Of all cells
    :param left: Seconds that are left, None if unknown
    :return: What rich prints
    """
    arms, envs = (list(dict.fromkeys(getattr(each, key) for each in states)) for key in ("arm", "env_id"))
    table = Table()
    table.add_column("")
    for env_id in envs:
        table.add_column(env_id, overflow="fold")
    for arm in arms:
        table.add_row(arm, *(_cell_text([s for s in states if (s.arm, s.env_id) == (arm, env_id)]) for env_id in envs))
    return Group(Text(f"{name}: {summary(states, left)}"), table)


def _cell_text(states: Sequence[CellState]) -> str:
    if not states:
        return "-"
    counts = {status: sum(each.status == status for each in states) for status in (FINISHED, FAILED)}
    parts = [f"[green]{counts[FINISHED]}[/]/{len(states)} done"]
    running = [each for each in states if each.status == RUNNING]
    if running:
        shares = ", ".join(f"{100 * each.steps / each.total:.0f} %" for each in running)
        parts.append(f"[cyan]running: {shares}[/]")
    if counts[FAILED]:
        parts.append(f"[red]{counts[FAILED]} failed[/]")
    return "  ".join(parts)


def summary(states: Sequence[CellState], left: float | None) -> str:
    """
    Return in one line how far a study is.

    :param states: Of all cells
    :param left: Seconds that are left, None if unknown
    :return: The line
    """
    counts = {status: sum(each.status == status for each in states) for status in (FINISHED, RUNNING, FAILED)}
    done, total = sum(each.steps for each in states), sum(each.total for each in states)
    parts = [f"{counts[FINISHED]} of {len(states)} runs done"]
    parts += [f"{counts[RUNNING]} running"] if counts[RUNNING] else []
    parts += [f"{counts[FAILED]} failed"] if counts[FAILED] else []
    parts.append(f"{done:,} of {total:,} joint steps")
    if left is not None and counts[FINISHED] + counts[FAILED] < len(states):
        parts.append(f"about {duration_text(left)} left")
    return ", ".join(parts)


class StudyDisplay:
    """
    Shows a study while it runs.

    :param name: Name of the study
    :param cells: Its cells
    :param jobs: Number of cells that run at the same time
    :param console: Where to show it; None for the standard output
    """

    def __init__(self, name: str, cells: Sequence[Cell], jobs: int, console: Console | None = None):
        self._name, self._cells = name, cells
        self._console = Console() if console is None else console
        self._left = TimeLeft(jobs)
        self._looked = -float("inf")
        self._live: Live | None = None
        self._known: dict[Cell, CellState] = {}
        self._states: list[CellState] = []

    def __enter__(self) -> "StudyDisplay":
        self._look()
        if self._console.is_terminal:
            self._live = Live(self._table(), console=self._console, refresh_per_second=2)
            self._live.__enter__()
        else:
            self._print(f"{self._name}: {self._line()}")
        return self

    def __exit__(self, *error: Any) -> None:
        self._look()
        if self._live is not None:
            self._live.update(self._table(), refresh=True)
            self._live.__exit__(*error)
        else:
            self._print(f"{self._name}: {self._line()}")

    def tell(self, text: str) -> None:
        """
        Say what has happened to a cell.

        :param text: A line
        """
        self._look()
        if self._live is not None:
            self._console.print(text, markup=False, highlight=False)
        else:
            self._print(f"{text} ({self._line()})")

    def update(self) -> None:
        """Show how far the cells are, if that has not been done a moment ago."""
        if self._live is not None and time.monotonic() - self._looked >= _EVERY:
            self._look()
            self._live.update(self._table())

    def _table(self) -> Group:
        return matrix_table(self._name, self._states, self._left.estimate(self._states))

    def _line(self) -> str:
        return summary(self._states, self._left.estimate(self._states))

    def _look(self) -> None:
        self._looked = time.monotonic()
        for cell in self._cells:
            # Nothing changes any more of one that has finished
            if cell not in self._known or self._known[cell].status != FINISHED:
                state = cell_state(cell)
                if state is not None:
                    self._known[cell] = state
        self._states = [self._known[cell] for cell in self._cells if cell in self._known]

    @staticmethod
    def _print(text: str) -> None:
        print(text, flush=True, file=sys.stdout)
