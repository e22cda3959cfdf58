"""The sections of a tuning's page."""

from collections.abc import Sequence
from typing import Any

from sb3_belief.report.figures.trials import TRIAL_COLOURS, TrialPoint, evaluations_spec, objectives_spec, setting_spec
from sb3_belief.report.page.content import Column, Figure, Kind, Page, PageSection, Table, number_text, unique_name
from sb3_belief.report.page.markup import copy_button, tag
from sb3_belief.report.tuning_page.facts import COMPLETE, SearchedSetting, TrialFacts, TuningFacts
from sb3_belief.report.tuning_page.text import TOO_HIGH, outcome_sentences, range_text, search_paragraph, trial_notices

_KINDS: dict[str, Kind] = {"integer": "count", "number": "significant", "choice": "text"}


def tuning_page(facts: TuningFacts, made: str) -> Page:
    """
    Make the page of a tuning.

    :param facts: What is known of it
    :param made: When the page was made, and by which version, in words
    :return: The page
    """
    sections = [_best(facts), _search(facts), _progress(facts), _settings(facts), _trials(facts), _specification(facts)]
    return Page(
        title=facts.name,
        subtitle="Tuning",
        lead=outcome_sentences(facts),
        quote=search_paragraph(facts),
        notices=trial_notices(facts),
        sections=[section for section in sections if section.blocks],
        arms=dict(reversed(TRIAL_COLOURS.items())),
        footer=made,
    )


def _best(facts: TuningFacts) -> PageSection:
    best = facts.best
    if best is None or best.value is None or not facts.best_settings:
        return PageSection("best", "Best settings", [])
    blocks = [
        tag("p", f"Those of trial {best.number}, with a {facts.unit} of {number_text(best.value)}. ", tag("strong", TOO_HIGH)),
        tag("pre", facts.best_settings, id="best-settings"),
        tag("p", copy_button("best-settings", "Copy these settings")),
    ]
    return PageSection("best", "Best settings", blocks, menu="Best")


def _search(facts: TuningFacts) -> PageSection:
    columns = [
        Column("setting", "setting"),
        Column("searched", "drawn from"),
        *([Column("best", "best trial", help="What was drawn in the best complete trial")] if facts.best else []),
    ]
    drawn = facts.best.settings if facts.best else {}
    rows = [
        {"setting": each.name, "searched": range_text(each), "best": _cell(each, drawn.get(each.name))}
        for each in facts.settings
    ]
    return PageSection("search", "What was searched", [Table("search", "Searched settings", columns, rows)], menu="Search")


def _cell(setting: SearchedSetting, value: Any) -> str:
    return Column(setting.name, setting.name, _KINDS[setting.kind], digits=4).text(value)


def _progress(facts: TuningFacts) -> PageSection:
    points = _points(facts)
    if not points:
        return PageSection("progress", "Trials so far", [])
    objective = Figure(
        "objective",
        "Objective by trial",
        objectives_spec(f"{facts.name}: objective by trial", points, facts.unit),
        f"{facts.unit} of each trial, and the best complete one so far; the numbers are in the table of trials",
    )
    evaluations = Figure(
        "evaluations",
        "Evaluations of each trial",
        evaluations_spec(f"{facts.name}: evaluations of each trial", points, facts.unit),
        f"{facts.unit} in each evaluation of each trial; pruned trials end with a cross",
    )
    text = (
        "First the objective of each trial, and the best complete one so far as a line; of a pruned trial it is that of its "
        "last evaluation. Then the evaluations of each trial: the best one is thick, and a cross ends one that was pruned. "
        "Point at a trial to read its number and value; click a word to hide its trials."
    )
    return PageSection("progress", "Trials so far", [text, [objective, evaluations]], menu="Progress")


def _settings(facts: TuningFacts) -> PageSection:
    points = _points(facts)
    taken = {"objective", "evaluations"}
    figures = []
    for each in facts.settings:
        drawn = {trial.number: trial.settings.get(each.name) for trial in facts.trials}
        known = [
            TrialPoint(point.number, point.kind, point.value, setting=drawn[point.number])
            for point in points
            if drawn[point.number] is not None
        ]
        if known:
            spec = setting_spec(each.name, known, facts.unit, each.choices, each.ends, each.is_log)
            description = f"{facts.unit} of each trial over {each.name}; the numbers are in the table of trials"
            figures.append(Figure(unique_name(f"setting-{each.name}", taken), each.name, spec, description))
    text = (
        "What was drawn of each setting, and what came out. All settings vary at once, so that a picture shows only what "
        "stands out in spite of the others; the sampler also looks more often where it has found good values."
    )
    return PageSection("settings", "Each setting", [text, figures] if figures else [], menu="Settings")


def _trials(facts: TuningFacts) -> PageSection:
    searched = [
        Column(f"search/{each.name}", each.name, _KINDS[each.kind], digits=4, help=range_text(each)) for each in facts.settings
    ]
    columns = [
        Column("trial", "trial", "count"),
        Column("state", "state", "status"),
        Column("value", facts.unit, "number", help="The objective; of a pruned trial that of its last evaluation"),
        *searched,
        Column("evaluations", "evaluations", "count", help="How many evaluations it had, over all its runs"),
        Column("seconds", "seconds", "number", digits=1),
        Column("repeats", "repeats trial", "count", shown=any(each.repeats is not None for each in facts.trials)),
        Column("started", "started", shown=False),
        Column("error", "error", shown=any(each.error for each in facts.trials)),
    ]
    rows = [
        {
            "trial": each.number,
            "state": each.state,
            "value": each.value,
            **{f"search/{name}": value for name, value in each.settings.items()},
            "evaluations": len(each.evaluations),
            "seconds": each.seconds,
            "repeats": each.repeats,
            "started": each.started or None,
            "error": each.error or None,
        }
        for each in facts.trials
    ]
    return PageSection("trials", "All trials", [Table("trials", "All trials", columns, rows)], menu="Trials")


def _specification(facts: TuningFacts) -> PageSection:
    blocks: list[Any] = []
    if facts.specification:
        blocks = ["The file of the tuning, by which it can be repeated.", tag("pre", facts.specification)]
    return PageSection("specification", "Specification", blocks)


def _points(facts: TuningFacts) -> list[TrialPoint]:
    length = _evaluations_of_a_run(facts.trials)
    best = facts.best
    return [
        TrialPoint(
            each.number,
            "best" if each is best else each.state,
            each.value,
            [each.evaluations[first : first + length] for first in range(0, len(each.evaluations), length)],
        )
        for each in facts.trials
        if each.has_value and each.value is not None
    ]


def _evaluations_of_a_run(trials: Sequence[TrialFacts]) -> int:
    """Return how many evaluations each run has that is trained to its end: as complete trials have had them."""
    known = [len(each.evaluations) // len(each.seed_values) for each in trials if each.state == COMPLETE and each.seed_values]
    return max([*known, 1]) if known else max([len(each.evaluations) for each in trials] + [1])
