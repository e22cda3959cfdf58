"""What can be reported of a study or of a folder of runs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pyarrow as pa

from sb3_belief.study.run_reading import RunData


@dataclass(frozen=True)
class ReportedRun:
    """
    A run, or a cell of a study whose run has perhaps not begun.

    :param data: What its folder tells
    :param arm: Its arm
    :param why_not: Why it does not count in the comparison. Empty if it does
    :param error: Its traceback, of its cell. Empty for that of the run itself
    """

    data: RunData
    arm: str
    why_not: str = ""
    error: str = ""


@dataclass(frozen=True)
class Reported:
    """
    A study, or a folder of runs.

    :param name: Its name
    :param folder: Its folder
    :param is_study: Whether it is a study
    :param arms: Its arms, in order
    :param baseline: The arm that the others are compared with, or None
    :param runs: Its runs
    :param table: The episodes of the runs that count
    :param evaluation_every: Joint steps between evaluations; None if they differ or are not known
    :param evaluation_episodes: Episodes of an evaluation; None likewise
    :param final_episodes: Episodes of a final evaluation; None likewise
    :param is_online: Whether the episodes of the trainings themselves count, instead of evaluations
    :param ablations: {title of a panel: its arms}
    :param notices: Further things that the reader must know
    """

    name: str
    folder: Path
    is_study: bool
    arms: Sequence[str]
    baseline: str | None
    runs: Sequence[ReportedRun]
    table: pa.Table
    evaluation_every: int | None = None
    evaluation_episodes: int | None = None
    final_episodes: int | None = None
    is_online: bool = False
    ablations: Mapping[str, Sequence[str]] = field(default_factory=dict)
    notices: Sequence[str] = ()
