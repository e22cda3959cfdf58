"""The sections of a study's page that list its runs and explain its words."""

from collections.abc import Mapping, Sequence
from typing import Any

from sb3_belief.report.page.content import Column, PageSection, Table, unique_name
from sb3_belief.report.page.markup import tag
from sb3_belief.report.study_page.facts import RunFacts, StudyFacts


def runs_section(facts: StudyFacts, unit: str, run_pages: Mapping[str, str]) -> PageSection:
    """
    Return the section that lists all runs, also those that do not count.

    :param facts: What is known of the study
    :param unit: What a score is, in words
    :param run_pages: {folder of a run: relative address of its page}
    :return: The section
    """
    columns = [
        Column("run", "run", "link"),
        Column("arm", "algorithm"),
        Column("environment", "environment"),
        Column("seed", "seed", "count"),
        Column("status", "status", "status"),
        Column("joint_steps", "joint steps", "count"),
        Column("score", unit, "number"),
        Column("minutes", "minutes", "number", digits=1),
        Column("note", "note"),
    ]
    rows = [
        {
            "run": (str(run.folder), run_pages.get(str(run.folder), "")),
            "arm": run.arm,
            "environment": run.environment,
            "seed": run.seed,
            "status": run.status,
            "joint_steps": run.joint_steps,
            "score": run.score,
            "minutes": None if run.seconds is None else run.seconds / 60,
            "note": "; ".join(filter(None, (run.why_not, facts.trained.get(run.arm)))) or None,
        }
        for run in facts.runs
    ]
    text = "Each run has a page of its own, in the folder beside this page."
    return PageSection("runs", "Runs", [text, Table("runs", "All runs", columns, rows)])


def terms_section(facts: StudyFacts) -> PageSection:
    """
    Return the section that says what the page's words mean, and which versions ran.

    :param facts: What is known of the study
    :return: The section
    """
    terms = {
        "Interquartile mean (IQM)": "Mean of the middle half of the scores: less swayed by outliers than the mean, and less "
        "wasteful than the median.",
        "95 % interval": "Stratified bootstrap: seeds are drawn anew within each environment. The percentile interval is "
        "widened for few seeds, since it would be too narrow. One seed has no interval.",
        "Better, worse, undecided": "Better or worse than the baseline where the two intervals are disjoint; else "
        "undecided. Undecided is no evidence that there is no difference.",
        "Probability of improvement": "How often a run of the one scores higher than a run of the other, over all pairs of "
        "seeds; a tie counts half.",
        "Performance profile": "Share of the runs that score above a threshold.",
        "p (Holm)": "Two-sided p-value of a permutation test of the probability of improvement, after Holm's correction "
        "for the number of algorithms that are compared with the baseline. With three seeds none can be below 0.1.",
    }
    definitions = [element for term, text in terms.items() for element in (tag("dt", term), tag("dd", text))]
    versions = Table(
        "versions",
        "Versions of the packages in the runs",
        [Column("package", "package"), Column("version", "version")],
        [{"package": name, "version": ", ".join(found)} for name, found in facts.versions().items()],
    )
    blocks: list[Any] = [tag("dl", *definitions, class_="terms")]
    return PageSection("methods", "Terms and versions", [*blocks, *([versions] if versions.rows else [])], menu="Terms")


def run_names(runs: Sequence[RunFacts]) -> list[str]:
    """
    Return a name for each run's page, which no other has.

    :param runs: The runs
    :return: Names of files, without a suffix
    """
    taken: set[str] = set()
    return [unique_name(f"{run.arm}-{run.environment}-{'x' if run.seed is None else run.seed}", taken) for run in runs]
