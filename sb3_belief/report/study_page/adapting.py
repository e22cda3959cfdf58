"""The sections of a study's page on adapting to partners and on cross-play, of the tables in its folder."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sb3_belief.report.adaptation import (
    ADAPTATION,
    ALL,
    NUMBERS,
    TEXTS,
    adaptation_figure,
    adaptation_points,
    adaptation_sentences,
    read_rows,
)
from sb3_belief.report.crossplay import (
    CROSSPLAY,
    CROSSPLAY_NUMBERS,
    CROSSPLAY_TEXTS,
    crossplay_cells,
    crossplay_figures,
    crossplay_sentences,
)
from sb3_belief.report.page.content import Column, Figure, PageSection, Table, unique_name
from sb3_belief.report.page.markup import tag
from sb3_belief.report.statistics import IntervalEstimate

_HOW = (
    "Weights are frozen, and agents meet partners that they have not met. The line is the mean over these partners with its "
    "95 % interval over repetitions, a thin line a single partner; dotted is who is blind to the partner, dashed who is told."
)


def adapting_sections(folder: Path) -> list[PageSection]:
    """
    Return the sections of what ``adapt`` and ``crossplay`` have measured.

    :param folder: Folder of the study, or of the runs, in which their tables lie at any depth
    :return: The sections; none without tables. A table that cannot be read is said to be damaged
    """
    sections = []
    for identifier, title, name, blocks_of in (
        ("adapting", "Adapting to partners", ADAPTATION, _adaptation),
        ("crossplay", "Cross-play", CROSSPLAY, _crossplay),
    ):
        taken: set[str] = set()
        blocks: list[Any] = []
        for path in sorted(folder.rglob(name)):
            label = path.parent.relative_to(folder).as_posix()
            try:
                blocks += [tag("h3", label), *blocks_of(path, unique_name(f"{identifier}-{label}", taken))]
            except ValueError as error:
                blocks.append(str(error))
        if blocks:
            sections.append(PageSection(identifier, title, [_HOW, *blocks] if identifier == "adapting" else blocks))
    return sections


def _adaptation(path: Path, name: str) -> list[Any]:
    rows = read_rows(path, TEXTS, NUMBERS)
    points = adaptation_points(rows)
    title = f"{rows[0]['run']}, {rows[0]['environment']}"
    figures = [Figure(name, title, adaptation_figure(rows, points, title), "Return over the steps observed since the swap")]
    if any(row["accuracy"] is not None for row in rows):
        spec = adaptation_figure(rows, points, title, skill=True)
        figures.append(Figure(f"{name}-skill", title, spec, "Accuracy above the base rate over the steps observed"))
    columns = [
        Column("partner", "partner"),
        Column("steps", "observed steps", "count"),
        *_estimated("return", "return", "Mean over repetitions"),
        *_estimated("share", "share of the gap", "Of the gap between blind and oracle, how much is closed"),
        *_estimated("regret", "regret", "By how much the oracle's return is higher"),
        *_estimated("skill", "skill", "Accuracy of the predictions above the base rate"),
    ]
    ends = {min(point.steps for point in points), max(point.steps for point in points)}
    table = [
        {
            "partner": "all partners" if point.partner == ALL else point.partner,
            "steps": point.steps,
            **_values("return", point.score),
            **_values("share", point.share),
            **_values("regret", point.regret),
            **_values("skill", point.skill),
        }
        for point in points
        if point.partner == ALL or point.steps in ends
    ]
    known = {key for row in table for key, value in row.items() if value is not None}
    shown = [column for column in columns if column.key in known]
    return [
        adaptation_sentences(rows, points),
        figures,
        Table(name, "The curve of adapting, and both of its ends of each partner", shown, table),
    ]


def _crossplay(path: Path, name: str) -> list[Any]:
    rows = read_rows(path, CROSSPLAY_TEXTS, CROSSPLAY_NUMBERS)
    what = "Mean return of the team in which one agent, of the run in the row, is among those of the run in the column"
    figures: Sequence[Figure] = [
        Figure(f"{name}-{key}", title, spec, what) for key, (title, spec) in crossplay_figures(rows).items()
    ]
    columns = [
        Column("run", "the agent is of"),
        Column("others", "all others are of"),
        Column("steps", "observed steps", "count"),
        *_estimated("return", "return", "Mean over repetitions"),
    ]
    table = [
        {"run": run, "others": others, "steps": steps, **_values("return", each)}
        for run, others, steps, each in crossplay_cells(rows)
    ]
    return [crossplay_sentences(rows), f"{what}.", figures, Table(name, "The cells of the matrices", columns, table)]


def _estimated(key: str, label: str, help: str) -> list[Column]:
    return [Column(key, label, "number", help=help), Column(f"{key}_95", "95 % interval", "interval", shown=key == "return")]


def _values(key: str, each: IntervalEstimate | None) -> dict[str, Any]:
    if each is None:
        return {}
    return {key: each.value, f"{key}_95": None if each.low is None else (each.low, each.high)}
