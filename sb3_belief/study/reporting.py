"""The report of a study, a tuning or a folder of runs: a page, a page for each run, and all figures and tables as files."""

import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import yaml

from sb3_belief.common.durable_files import make_folder, replaced_file
from sb3_belief.common.versions import __version__
from sb3_belief.report.episodes import write_episodes_table
from sb3_belief.report.figures.drawing import check_drawing, vega_bundle
from sb3_belief.report.page.content import Page
from sb3_belief.report.page.files import files_folder, write_page
from sb3_belief.report.page.render import render_page
from sb3_belief.report.study_page.adapting import adapting_sections
from sb3_belief.report.study_page.facts import RunFacts, StudyFacts
from sb3_belief.report.study_page.findings import Findings, default_quantity, findings_of
from sb3_belief.report.study_page.run_page import run_page
from sb3_belief.report.study_page.runs import run_names
from sb3_belief.report.study_page.sections import StudyPage
from sb3_belief.report.study_page.text import result_sentences
from sb3_belief.report.tuning_page.page import tuning_page
from sb3_belief.report.tuning_page.text import outcome_sentences
from sb3_belief.study.cell_record import EPISODES_FILE
from sb3_belief.study.reported import Reported, ReportedRun
from sb3_belief.study.reported_logs import reported_logs
from sb3_belief.study.reported_study import is_study, reported_study
from sb3_belief.study.reported_tuning import reported_tuning
from sb3_belief.study.run_reading import diagnostic_series, evaluation_series
from sb3_belief.zoo.errors import ConfigError, reason_of, short, unknown_setting
from sb3_belief.zoo.run_files import is_tuning
from sb3_belief.zoo.run_folder import VIEWER

RUNS, BUNDLE = "runs", "vega.js"


@dataclass(frozen=True)
class ReportOptions:
    """
    Options of a report.

    :param source: Folder of a study, of a tuning, or of runs
    :param output: HTML file to write. None for ``report.html`` in that folder
    :param quantity: ``"return"`` or ``"success"``. None for successes if all environments report them
    :param baseline: The arm that the others are compared with. None for that of the study, or ``ippo``
    """

    source: str
    output: str | None = None
    quantity: str | None = None
    baseline: str | None = None


def write_report(options: ReportOptions) -> tuple[Path, str]:
    """
    Write the report of a study, of a tuning, or of the runs in a folder.

    :param options: The options
    :return: The page, and what was found, in a few sentences
    :raises ConfigError: If there is nothing to report, an option does not fit, or the page cannot be written
    """
    source = Path(options.source)
    if not os.path.isdir(source):
        raise ConfigError(
            f"report: no folder {short(options.source)}: give the folder of a study or a tuning, or one with runs."
        )
    output = source / "report.html" if options.output is None else Path(options.output)
    if output.suffix.lower() not in (".html", ".htm"):
        raise ConfigError(f"-o: {short(str(output))} must end in .html.")
    check_drawing()
    if is_tuning(source) and not is_study(source):
        return output, _write_tuning(options, output)
    reported = reported_study(source) if is_study(source) else reported_logs(source)
    baseline = _baseline(reported, options.baseline)
    try:
        # Before the work, not after it
        make_folder(files_folder(output) / RUNS)
    except OSError as error:
        raise ConfigError(f"-o: cannot make the folder {short(str(files_folder(output)))} ({reason_of(error)}).") from None
    quantity = options.quantity or default_quantity(reported.table)
    try:
        findings = findings_of(reported.table, reported.arms, baseline, quantity)
    except ValueError as error:
        raise ConfigError(f"report: {error}") from None
    facts = _facts(reported, findings)
    try:
        if reported.is_study and reported.table.num_rows:
            write_episodes_table(reported.table, source / EPISODES_FILE)
        _write(facts, findings, source, output)
    except OSError as error:
        raise ConfigError(f"-o: cannot write {short(str(output))} ({reason_of(error)}).") from None
    return output, result_sentences(findings)


def _write_tuning(options: ReportOptions, output: Path) -> str:
    """Write the report of a tuning, and return what was found."""
    for flag, given in (("--quantity", options.quantity), ("--baseline", options.baseline)):
        if given is not None:
            raise ConfigError(
                f"{flag}: {short(options.source)} is a tuning, which has one objective and compares no algorithms: leave"
                f" {flag} out."
            )
    facts = reported_tuning(Path(options.source))
    try:
        write_page(tuning_page(facts, _made()), output, vega_bundle())
    except OSError as error:
        raise ConfigError(f"-o: cannot write {short(str(output))} ({reason_of(error)}).") from None
    return outcome_sentences(facts)


def _made() -> str:
    return f"Made {time.strftime('%Y-%m-%d %H:%M %z')} by sb3-belief {__version__}."


def _baseline(reported: Reported, given: str | None) -> str | None:
    if given is None:
        return reported.baseline
    if given not in reported.arms:
        raise unknown_setting("--baseline", "algorithm", given, reported.arms)
    return given


def _facts(reported: Reported, findings: Findings) -> StudyFacts:
    scores = {
        (environment, arm): found.seeds for environment, arms in findings.environments.items() for arm, found in arms.items()
    }
    return StudyFacts(
        name=reported.name,
        runs=[
            _run_facts(run, reported.folder, findings.quantity, scores.get((run.data.env, run.arm), {}))
            for run in reported.runs
        ],
        is_study=reported.is_study,
        evaluation_every=reported.evaluation_every,
        evaluation_episodes=reported.evaluation_episodes,
        final_episodes=reported.final_episodes,
        is_online=reported.is_online,
        ablations=reported.ablations,
        trained=_trained(reported),
        notices=[*_notes(reported), *reported.notices],
    )


def _run_facts(run: ReportedRun, source: Path, quantity: str, scores: Mapping[int | str, float]) -> RunFacts:
    data = run.data
    versions, seconds = data.record.get("versions"), data.record.get("seconds")
    viewer = data.folder / VIEWER
    has_score = not run.why_not and data.seed is not None
    return RunFacts(
        arm=run.arm,
        algorithm=data.algo,
        environment=data.env,
        seed=data.seed,
        status=data.status,
        folder=Path(os.path.relpath(data.folder, source)),
        counts=not run.why_not,
        why_not=run.why_not,
        joint_steps=data.joint_steps,
        total_steps=data.total_steps,
        seconds=float(seconds) if isinstance(seconds, int | float) else None,
        started=str(data.record.get("started", "")),
        command=str(data.record.get("command", "")),
        config=yaml.safe_dump({data.env: data.settings}, sort_keys=False, allow_unicode=True) if data.settings else "",
        versions={str(name): str(version) for name, version in versions.items()} if isinstance(versions, dict) else {},
        error=run.error or data.error,
        score=scores.get(data.seed) if has_score and data.seed is not None else None,
        evaluations=evaluation_series(data.folder, quantity),
        diagnostics=diagnostic_series(data.folder),
        viewer=viewer.resolve() if viewer.is_file() else None,
        trained=data.note,
    )


def _write(facts: StudyFacts, findings: Findings, source: Path, output: Path) -> None:
    made, files = _made(), files_folder(output)
    bundle = vega_bundle()
    runs = files / RUNS
    with replaced_file(files / BUNDLE, "w", encoding="utf-8") as file:
        file.write(bundle)
    pages: dict[str, str] = {}
    for run, name in zip(facts.runs, run_names(facts.runs), strict=True):
        path = runs / f"{name}.html"
        viewer = None if run.viewer is None else os.path.relpath(run.viewer, runs.resolve())
        _write_run_page(run_page(run, findings.unit, (f"../../{output.name}", facts.name), made, viewer), path)
        pages[str(run.folder)] = f"{files.name}/{RUNS}/{path.name}"
    page = StudyPage(facts, findings, made, pages, adapting_sections(source)).page()
    write_page(page, output, bundle)


def _write_run_page(page: Page, path: Path) -> None:
    # They share one script, which is as large as all else of many pages
    text = render_page(page, None, bundle_file=f"../{BUNDLE}")
    with replaced_file(path, "w", encoding="utf-8") as file:
        file.write(text)


def _trained(reported: Reported) -> dict[str, str]:
    """Return what has to be said of algorithms that are not decentralised, as their runs have noted it."""
    notes = {run.arm: run.data.note for run in reported.runs}
    return {arm: notes[arm] for arm in reported.arms if notes.get(arm)}


def _notes(reported: Reported) -> list[str]:
    return [f"{arm} {note}." for arm, note in _trained(reported).items()]
