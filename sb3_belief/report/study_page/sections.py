"""The page of a study."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sb3_belief.report.figures.curves import Curve, curves_spec
from sb3_belief.report.figures.intervals import Interval, intervals_spec
from sb3_belief.report.figures.theme import arm_colours, arm_dashes
from sb3_belief.report.page.content import Column, Figure, Page, PageSection, Table, unique_name
from sb3_belief.report.page.markup import tag
from sb3_belief.report.study_page.facts import DIAGNOSTICS, StudyFacts, curve_of, mean_of, thinned
from sb3_belief.report.study_page.findings import ArmFinding, Findings
from sb3_belief.report.study_page.runs import runs_section, terms_section
from sb3_belief.report.study_page.text import (
    OVERALL,
    ends,
    listed,
    method_paragraph,
    notices,
    result_sentences,
    sentence,
    sorted_arms,
    verdict_text,
)


class StudyPage:
    """
    Maker of a study's page.

    :param facts: What is known of the study
    :param findings: What was found
    :param made: When the page was made, and by which version, in words
    :param run_pages: {folder of a run: relative address of its page}
    :param measures: Sections of further measures, see ``study_page.adapting``
    """

    def __init__(
        self,
        facts: StudyFacts,
        findings: Findings,
        made: str,
        run_pages: Mapping[str, str],
        measures: Sequence[PageSection] = (),
    ) -> None:
        self.facts, self.findings, self.made, self.run_pages, self.measures = facts, findings, made, run_pages, measures
        self.colours = arm_colours(findings.arms, findings.baseline)
        self.dashes = arm_dashes(findings.arms, findings.baseline)
        # Those of the two tables that other functions make
        self._names = {"runs", "versions"}

    def page(self) -> Page:
        """
        Make the page.

        :return: The page
        """
        sections = [
            self._results(),
            self._curves(),
            self._profiles(),
            *self._ablations(),
            *self._diagnostics(),
            *self.measures,
            runs_section(self.facts, self.findings.unit, self.run_pages),
            terms_section(self.facts),
        ]
        return Page(
            title=self.facts.name,
            subtitle="Study" if self.facts.is_study else "Runs without a study",
            lead=result_sentences(self.findings),
            quote=method_paragraph(self.facts, self.findings),
            notices=notices(self.facts),
            sections=[section for section in sections if section.blocks],
            arms=self.colours,
            footer=self.made,
        )

    def _name(self, *parts: str) -> str:
        return unique_name("-".join(parts), self._names)

    def _places(self) -> dict[str, Mapping[str, ArmFinding]]:
        overall = {OVERALL: self.findings.overall} if self.findings.overall else {}
        return {**overall, **self.findings.environments}

    def _unit(self, place: str) -> str:
        normalised = place == OVERALL and self.findings.quantity == "return"
        return "normalised return" if normalised else self.findings.unit

    def _domain(self, place: str) -> tuple[float, float] | None:
        return (0.0, 1.0) if self.findings.quantity == "success" else None

    # ---- results
    def _results(self) -> PageSection:
        table = self._headline()
        figures = [
            Figure(
                self._name("scores", place),
                place,
                intervals_spec(
                    place,
                    {arm: _interval(arms[arm]) for arm in sorted_arms(arms, self.findings.arms)},
                    self.colours,
                    self._unit(place),
                ),
                f"Interquartile mean and 95 % interval of each algorithm on {place}; the numbers are in the table above",
            )
            for place, arms in self._places().items()
        ]
        blocks: list[Any] = [table, figures]
        others = self._others()
        return PageSection("results", "Results", [*blocks, *([others] if others.rows else [])])

    @property
    def _trained(self) -> list[Column]:
        """The column that says how algorithms were trained, where one of them is not decentralised."""
        return [Column("trained", "training")] if self.facts.trained else []

    def _headline(self) -> Table:
        baseline = self.findings.baseline
        columns = [
            Column("environment", "environment"),
            Column("arm", "algorithm"),
            *self._trained,
            Column("iqm", "IQM", "number", help=f"Interquartile mean of the {self.findings.unit} over the seeds"),
            Column("interval", "95 % interval", "interval", help="Stratified bootstrap over the seeds"),
            Column("seeds", "runs", "count"),
        ]
        if baseline is not None:
            columns += [
                Column("verdict", f"than {baseline}", "verdict", help="Better or worse where the intervals are disjoint"),
                Column(
                    "seeds_needed",
                    "seeds needed",
                    "count",
                    help="How many seeds would make the intervals disjoint, if means and spread stayed as they are",
                ),
                Column(
                    "improvement",
                    f"P(> {baseline})",
                    "number",
                    help=f"Probability that a run scores higher than one of {baseline}",
                ),
                Column("improvement_interval", "its 95 % interval", "interval", shown=False),
                Column("p_holm", "p (Holm)", "number", help="p-value, corrected for the number of comparisons after Holm"),
            ]
        rows = []
        for place, arms in self._places().items():
            for arm in sorted_arms(arms, self.findings.arms):
                each = arms[arm]
                row: dict[str, Any] = {
                    "environment": place,
                    "arm": arm,
                    "trained": self.facts.trained.get(arm),
                    "iqm": each.score.value,
                    "interval": ends(each.score),
                    "seeds": len(each.seeds),
                    "verdict": verdict_text(each),
                }
                if each.comparison is not None:
                    row.update(
                        seeds_needed=each.comparison.seeds_needed,
                        improvement=each.comparison.improvement.value,
                        improvement_interval=ends(each.comparison.improvement),
                        p_holm=each.comparison.p_holm,
                    )
                rows.append(row)
        return Table(self._name("results"), f"{sentence(self.findings.unit)} of each algorithm", columns, rows)

    def _others(self) -> Table:
        columns = [
            Column("environment", "environment"),
            Column("arm", "algorithm"),
            *self._trained,
        ]
        rows: dict[tuple[str, str], dict[str, Any]] = {}
        for each in self.findings.others:
            way = f"{each.checkpoint}, {'greedy' if each.deterministic else 'sampled'}"
            if way not in [column.key for column in columns]:
                columns += [Column(way, way, "number"), Column(f"{way} 95 %", "95 % interval", "interval", shown=False)]
            place = {"environment": each.environment, "arm": each.arm, "trained": self.facts.trained.get(each.arm)}
            row = rows.setdefault((each.environment, each.arm), place)
            row.update({way: each.score.value, f"{way} 95 %": ends(each.score)})
        order = list(self.findings.environments)
        by_place = sorted(rows.values(), key=lambda row: order.index(row["environment"]))
        caption = (
            "The same of the best and of the last team, with greedy and with sampled actions (intervals are in the CSV file)"
        )
        return Table(self._name("other-evaluations"), caption, columns, by_place)

    # ---- curves
    def _curves(self) -> PageSection:
        figures = [
            self._curve_figure(self._name("learning", environment), environment, curves)
            for environment, curves in self.findings.curves.items()
        ]
        if self.findings.overall_curves:
            name = self._name("learning", OVERALL)
            figures.insert(0, self._curve_figure(name, OVERALL, self.findings.overall_curves, x_title="share of the training"))
        where = "the episodes of the training" if self.facts.is_online else "the evaluations during training"
        text = (
            f"{sentence(self.findings.unit)} in {where}: the interquartile mean over the seeds, its 95 % interval as a band, "
            "and each seed as a thin line. Point at a line to read its seed and value; click an algorithm to hide it."
        )
        return PageSection("curves", "Learning curves", [text, figures] if figures else [])

    def _curve_figure(
        self, name: str, place: str, curves: Mapping[str, Curve], title: str = "", x_title: str = "joint steps"
    ) -> Figure:
        arms = sorted_arms(curves, self.findings.arms)
        spec = curves_spec(
            title or place,
            {arm: curves[arm] for arm in arms},
            self.colours,
            self.dashes,
            x_title=x_title,
            y_title=self._unit(place),
            y_domain=self._domain(place),
            x_format="~s" if x_title == "joint steps" else ".0%",
        )
        heights = [f"{arm} {_last(curves[arm]):.3g}" for arm in arms]
        return Figure(name, place, spec, f"{self._unit(place)} over joint steps on {place}; at the end: {listed(heights)}")

    def _profiles(self) -> PageSection:
        blocks: list[Any] = []
        profiles = [
            Figure(
                self._name("profile", place),
                place,
                curves_spec(
                    f"Performance profile, {place}",
                    {arm: curves[arm] for arm in sorted_arms(curves, self.findings.arms)},
                    self.colours,
                    self.dashes,
                    x_title=f"{self._unit(place)} τ",
                    y_title="share of runs above τ",
                    y_domain=(0, 1),
                    x_format=".3~g",
                ),
                f"Share of the runs of each algorithm whose score is above a threshold, over all thresholds, on {place}",
            )
            for place, curves in self.findings.profiles.items()
        ]
        if profiles:
            blocks += [
                "The share of runs that score above a threshold, for every threshold: higher is better, and curves that cross "
                "mean that neither algorithm is better throughout. Bands are 95 % intervals.",
                profiles,
            ]
        improvements = self._improvements()
        if improvements:
            blocks += [
                tag("h3", "Probability of improvement"),
                f"How likely a run of an algorithm scores higher than one of {self.findings.baseline}, with 95 % intervals. "
                "At 0.5 neither is better.",
                improvements,
            ]
        return PageSection("profiles", "Profiles and improvement", blocks, menu="Profiles")

    def _improvements(self) -> list[Figure]:
        figures = []
        for place, arms in self._places().items():
            intervals = {
                arm: Interval(each.value, each.low, each.high)
                for arm in sorted_arms(arms, self.findings.arms)
                if (comparison := arms[arm].comparison) is not None
                for each in [comparison.improvement]
            }
            if intervals:
                spec = intervals_spec(
                    f"P(better than {self.findings.baseline}), {place}",
                    intervals,
                    self.colours,
                    f"P(run > run of {self.findings.baseline})",
                    x_domain=(0, 1),
                    mark=0.5,
                )
                chances = [f"{arm} {each.value:.3g}" for arm, each in intervals.items()]
                figures.append(
                    Figure(self._name("improvement", place), place, spec, f"Probability of improvement: {listed(chances)}")
                )
        return figures

    # ---- ablations
    def _ablations(self) -> list[PageSection]:
        blocks: list[Any] = []
        for title, arms in self.facts.ablations.items():
            learning, final = [], []
            for environment, found in self.findings.environments.items():
                present = [arm for arm in arms if arm in found]
                if not present:
                    continue
                curves = {arm: self.findings.curves.get(environment, {}).get(arm) for arm in present}
                known = {arm: curve for arm, curve in curves.items() if curve is not None}
                if known:
                    name = self._name("ablation", title, environment, "learning")
                    learning.append(self._curve_figure(name, environment, known, f"{title}: {environment}"))
                spec = intervals_spec(
                    f"{title}: {environment}",
                    {arm: _interval(found[arm]) for arm in present},
                    self.colours,
                    self.findings.unit,
                )
                description = f"Interquartile mean and interval of {listed(present)} on {environment}"
                final.append(Figure(self._name("ablation", title, environment), environment, spec, description))
            if final:
                blocks += [tag("h3", title), *([learning] if learning else []), final]
        return [PageSection("ablations", "Ablations", blocks)] if blocks else []

    # ---- diagnostics of the belief
    def _diagnostics(self) -> list[PageSection]:
        blocks: list[Any] = []
        for key, (title, meaning) in DIAGNOSTICS.items():
            figures = []
            for environment in self.findings.environments:
                curves = self._diagnostic_curves(key, environment)
                if curves:
                    spec = curves_spec(f"{title}: {environment}", curves, self.colours, self.dashes, y_title=title.lower())
                    heights = [f"{arm} {_last(curve):.3g}" for arm, curve in curves.items()]
                    description = f"{title} over joint steps on {environment}; at the end: {listed(heights)}"
                    figures.append(Figure(self._name(key.replace("/", "-"), environment), environment, spec, description))
            if figures:
                blocks += [tag("h3", title), f"{sentence(meaning)}.", figures]
        if blocks:
            blocks.insert(
                0, "Means over the agents of a team, measured on steps not yet trained on: the line is the mean over seeds."
            )
        return [PageSection("belief", "The belief over training", blocks, menu="Belief")] if blocks else []

    def _diagnostic_curves(self, key: str, environment: str) -> dict[str, Curve]:
        found: dict[str, dict[int | str, tuple[np.ndarray, np.ndarray]]] = {}
        for run in self.facts.runs:
            if run.counts and run.environment == environment and key in run.diagnostics and run.seed is not None:
                found.setdefault(run.arm, {})[run.seed] = thinned(mean_of(run.diagnostics[key]))
        return {arm: curve_of(found[arm]) for arm in self.findings.arms if arm in found}


def _interval(finding: ArmFinding) -> Interval:
    return Interval(finding.score.value, finding.score.low, finding.score.high, finding.seeds)


def _last(curve: Curve) -> float:
    values = [float(value) for value in curve.centre if np.isfinite(value)]
    return values[-1] if values else float("nan")
