"""The page of a run."""

from collections.abc import Mapping
from typing import Any

from sb3_belief.report.figures.curves import Curve, curves_spec
from sb3_belief.report.figures.theme import arm_colours, arm_dashes
from sb3_belief.report.page.content import Column, Figure, Page, PageSection, Table, number_text, unique_name
from sb3_belief.report.page.markup import tag
from sb3_belief.report.study_page.facts import DIAGNOSTICS, RunFacts, curve_of, thinned
from sb3_belief.report.study_page.text import counted

SUCCESS_RATE = "success rate"


def run_page(run: RunFacts, unit: str, back: tuple[str, str], made: str, viewer: str | None = None) -> Page:
    """
    Make the page of a run: its curves, configuration, versions, and its error if it failed.

    :param run: What is known of the run
    :param unit: What a score is, in words
    :param back: Relative address and title of the page above
    :param made: When the page was made, and by which version, in words
    :param viewer: Relative address of the belief viewer; None if there is none
    :return: The page
    """
    seed = "" if run.seed is None else f", seed {run.seed}"
    blocks: list[Any] = []
    if viewer is not None:
        blocks.append(tag("p", tag("a", "Watch an episode in the belief viewer", href=viewer)))
    names: set[str] = {"run", "configuration", "versions"}
    sections = [
        PageSection("curves", "Curves", [*blocks, *_curves(run, unit, names)]),
        PageSection("belief", "The belief", _diagnostics(run, names)),
        PageSection("error", "Why it ended", [tag("pre", run.error)] if run.error else []),
        PageSection("configuration", "Configuration", _configuration(run)),
        PageSection("versions", "Versions", [_versions(run)] if run.versions else []),
    ]
    return Page(
        title=f"{run.arm} on {run.environment}{seed}",
        subtitle="Run",
        lead=_summary(run, unit),
        notices=[
            *([f"{run.algorithm} {run.trained}."] if run.trained else []),
            *([f"This run does not count in the comparison: {run.why_not or run.status}."] if not run.counts else []),
        ],
        arms=arm_colours(run.evaluations),
        sections=[section for section in sections if section.blocks],
        footer=made,
        back=back,
    )


def _summary(run: RunFacts, unit: str) -> str:
    steps = "an unknown number of joint steps" if run.joint_steps is None else f"{run.joint_steps:,} joint steps"
    of_total = f" of {run.total_steps:,}" if run.total_steps and (run.joint_steps or 0) < run.total_steps else ""
    time = "" if run.seconds is None else f" in {run.seconds / 60:,.1f} minutes"
    started = f", started {run.started}" if run.started else ""
    score = "" if run.score is None else f" Its {unit} is {number_text(run.score)}."
    return f"{run.algorithm} on {run.environment}: {run.status} after {steps}{of_total}{time}{started}.{score}"


def _curves(run: RunFacts, unit: str, names: set[str]) -> list[Any]:
    series = {name: thinned(each, 200) for name, each in run.evaluations.items()}
    curves = {name: Curve(*each) for name, each in series.items() if len(each[0])}
    if not curves:
        return []
    colours, dashes = arm_colours(run.evaluations), arm_dashes(list(run.evaluations))
    domain = (0.0, 1.0) if unit == SUCCESS_RATE else None
    spec = curves_spec("Learning curve", curves, colours, dashes, y_title=unit, y_domain=domain, of_what=("curve", ""))
    description = f"{unit} over joint steps: {', '.join(curves)}"
    return [[Figure(unique_name("learning", names), "Learning curve", spec, description)]]


def _diagnostics(run: RunFacts, names: set[str]) -> list[Any]:
    figures = []
    for key, (title, meaning) in DIAGNOSTICS.items():
        agents = {agent: thinned(series) for agent, series in run.diagnostics.get(key, {}).items()}
        known: Mapping[int | str, Any] = {agent: series for agent, series in agents.items() if len(series[0])}
        if known:
            spec = curves_spec(
                title,
                {"mean of the agents": curve_of(known)},
                {"mean of the agents": "var(--arm-1)"},
                {"mean of the agents": [1, 0]},
                y_title=title.lower(),
                of_what=("line", "agent"),
            )
            figures.append(
                Figure(unique_name(key.replace("/", "-"), names), title, spec, f"{title} over joint steps: {meaning}")
            )
    if not figures:
        return []
    return [
        "Thick lines are means over the agents, thin lines the agents. Point at a line to read its agent and value.",
        figures,
    ]


def _configuration(run: RunFacts) -> list[Any]:
    rows = {
        "folder": str(run.folder),
        "command": run.command,
        "status": run.status,
        "joint steps": "" if run.joint_steps is None else f"{run.joint_steps:,}",
        "time": "" if run.seconds is None else counted(round(run.seconds), "second"),
    }
    columns = [Column("what", "what"), Column("value", "value")]
    table = Table("run", "The run", columns, [{"what": key, "value": value} for key, value in rows.items() if value])
    return [table, *([tag("pre", run.config)] if run.config else [])]


def _versions(run: RunFacts) -> Table:
    rows = [{"package": package, "version": version} for package, version in run.versions.items()]
    return Table("versions", "Versions of the packages", [Column("package", "package"), Column("version", "version")], rows)
