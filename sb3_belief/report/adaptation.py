"""How a team adapts to partners: the table of what was measured, and what it says."""

import csv
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sb3_belief.common.durable_files import replaced_file
from sb3_belief.report.figures.curves import Curve, curves_spec
from sb3_belief.report.figures.theme import arm_colours
from sb3_belief.report.resampling import bootstrap_interval
from sb3_belief.report.statistics import IntervalEstimate, estimate

#: Name of the table in the folder of a measurement, and of the one with its means and intervals
ADAPTATION, CURVE = "adaptation.csv", "adaptation_curve.csv"
#: Whom rows are about: the team that is measured, and those between whom the gap lies
TEAM, BLIND, ORACLE = "team", "blind", "oracle"
TEXTS = ("role", "run", "environment", "partner", "type", "agent")
NUMBERS = ("repetition", "steps", "episodes", "return", "success", "accuracy", "base_rate")
#: What stands for the mean over all partners
ALL = "all"

_DASHES = {TEAM: [1, 0], BLIND: [2, 2], ORACLE: [6, 3]}

#: A row of a table: texts, and numbers or None
Row = Mapping[str, Any]


@dataclass(frozen=True)
class AdaptationPoint:
    """
    Where the curve of adapting is after a number of steps, with 95 % intervals over repetitions of the same partners.

    :param partner: The partner, or ``ALL`` for the mean over them
    :param steps: Steps observed since the swap
    :param score: Mean return
    :param share: Share of the gap between blind and oracle that is closed; None without both, or without a gap
    :param regret: By how much the oracle's return is higher; None without an oracle
    :param skill: Accuracy of the predictions above the base rate; None without predictions
    """

    partner: str
    steps: int
    score: IntervalEstimate
    share: IntervalEstimate | None
    regret: IntervalEstimate | None
    skill: IntervalEstimate | None

    def columns(self) -> dict[str, Any]:
        """Return it as a row of a table."""
        row: dict[str, Any] = {"partner": self.partner, "steps": self.steps}
        for name, each in (("return", self.score), ("share", self.share), ("regret", self.regret), ("skill", self.skill)):
            for suffix, value in zip(("", "_low", "_high"), (None,) * 3 if each is None else each[:3], strict=True):
                row[name + suffix] = value
        return row


def write_rows(rows: Sequence[Row], path: Path) -> None:
    """
    Write a table as CSV, with empty fields for None.

    :param rows: At least one row; all have the same columns
    :param path: The file
    """
    with replaced_file(path, "w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def read_rows(path: str | os.PathLike[str], texts: Sequence[str], numbers: Sequence[str]) -> list[dict[str, Any]]:
    """
    Read a table as it was written.

    :param path: The file
    :param texts: Its columns of texts
    :param numbers: Its columns of numbers
    :return: The rows
    :raises ValueError: If it is damaged
    """
    try:
        with open(path, newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        if not rows:
            raise ValueError("it has no row")
        return [
            {**{name: row[name] for name in texts}, **{name: float(row[name]) if row[name] else None for name in numbers}}
            for row in rows
        ]
    # What is missing is None, and a strange field may be anything
    except (KeyError, TypeError, ValueError, OSError, csv.Error) as error:
        raise ValueError(
            f"{os.fspath(path)} is damaged, or no table of this kind ({type(error).__name__}: {error})."
        ) from None


def by_partner(rows: Iterable[Row], role: str, steps: float, value: str = "return") -> dict[str, np.ndarray]:
    """
    Return the values of each partner.

    :param rows: The table
    :param role: Whose
    :param steps: After how many steps; blind and oracle do not adapt, and are there at 0
    :param value: Name of a column, or ``"skill"``
    :return: {partner: the value of each repetition, a mean over agents}; without partners that lack a value
    """
    found: dict[str, dict[float, list[float]]] = {}
    for row in rows:
        if row["role"] != role or row["steps"] != steps:
            continue
        if value == "skill":
            number = None if row["accuracy"] is None else row["accuracy"] - row["base_rate"]
        else:
            number = row[value]
        if number is not None:
            found.setdefault(row["partner"], {}).setdefault(row["repetition"], []).append(number)
    return {partner: np.array([np.mean(of[each]) for each in sorted(of)], dtype=np.float64) for partner, of in found.items()}


def adaptation_points(rows: Sequence[Row]) -> list[AdaptationPoint]:
    """
    Return the curve of adapting: over all partners, then of each.

    :param rows: The table
    :return: Its points, in the order of the steps
    """
    steps = sorted({row["steps"] for row in rows if row["role"] == TEAM})
    blind, oracle = by_partner(rows, BLIND, 0), by_partner(rows, ORACLE, 0)
    owns = {n: by_partner(rows, TEAM, n) for n in steps}
    skills = {n: by_partner(rows, TEAM, n, "skill") for n in steps}
    partners = list(owns[steps[0]])
    points = []
    for name, of in [(ALL, partners), *((partner, [partner]) for partner in partners)]:
        for n in steps:
            own, skill = owns[n], skills[n]
            points.append(
                AdaptationPoint(
                    name,
                    int(n),
                    estimate([own[each] for each in of], "mean"),
                    _share([np.stack([own[each], blind[each], oracle[each]]) for each in of]) if blind and oracle else None,
                    estimate([oracle[each] - own[each] for each in of], "mean") if oracle else None,
                    estimate([skill[each] for each in of if each in skill], "mean") if any(e in skill for e in of) else None,
                )
            )
    return points


def _share(strata: Sequence[np.ndarray]) -> IntervalEstimate | None:
    """
    Return which share of the gap is closed.

    :param strata: Of each partner the returns of the team, of the blind and of the oracle, ``[3, repetitions]``
    """

    def statistic(*values: np.ndarray, axis: int = -1) -> np.ndarray:
        own, blind, oracle = np.mean([each.mean(axis=axis) for each in values], axis=0)
        return np.asarray((own - blind) / (oracle - blind))

    _, blind, oracle = np.mean([each.mean(axis=-1) for each in strata], axis=0)
    if not oracle > blind:
        return None
    with np.errstate(divide="ignore", invalid="ignore"):
        value, interval = float(statistic(*strata)), bootstrap_interval(strata, statistic)
    low, high = (None, None) if interval is None else (float(interval[0]), float(interval[1]))
    # Where noise closes the gap in some resamples, nothing is known of the share
    if low is not None and high is not None and not np.isfinite([low, high]).all():
        low = high = None
    return IntervalEstimate(value, low, high, strata[0].shape[-1])


def adaptation_figure(
    rows: Sequence[Row], points: Sequence[AdaptationPoint], title: str, skill: bool = False
) -> dict[str, Any]:
    """
    Return the picture of the curve of adapting: with its interval, each partner as a thin line, and blind and oracle.

    :param rows: The table
    :param points: Its curve, as :func:`adaptation_points` returns it
    :param title: Title
    :param skill: Whether to draw the skill of the predictions instead of the return
    :return: The specification
    """
    drawn: dict[str, list[tuple[int, IntervalEstimate]]] = {}
    for point in points:
        estimated = point.skill if skill else point.score
        if estimated is not None:
            drawn.setdefault(point.partner, []).append((point.steps, estimated))
    mean = drawn.pop(ALL)
    x = [float(steps) for steps, _ in mean]
    curves = {TEAM: _curve(x, [each for _, each in mean], {name: [e.value for _, e in of] for name, of in drawn.items()})}
    for role in (BLIND, ORACLE):
        values = list(by_partner(rows, role, 0).values())
        if values and not skill:
            curves[role] = _curve(x, [estimate(values, "mean")] * len(x))
    arms = list(curves)
    return curves_spec(
        title,
        curves,
        arm_colours(arms, BLIND),
        {arm: _DASHES[arm] for arm in arms},
        x_title="steps observed since the swap",
        y_title="accuracy above the base rate" if skill else "return",
        x_format="~s",
        mark=0.0 if skill else None,
        of_what=("agents", "partner"),
    )


def _curve(
    x: Sequence[float], estimates: Sequence[IntervalEstimate], partners: Mapping[int | str, Sequence[float]] | None = None
) -> Curve:
    has_band = all(each.low is not None for each in estimates)
    return Curve(
        x,
        [each.value for each in estimates],
        [float(each.low) for each in estimates] if has_band else None,  # type: ignore[arg-type]
        [float(each.high) for each in estimates] if has_band else None,  # type: ignore[arg-type]
        partners or {},
    )


def adaptation_sentences(rows: Sequence[Row], points: Sequence[AdaptationPoint]) -> str:
    """
    Say in a paragraph how a team adapts.

    :param rows: The table
    :param points: Its curve, as :func:`adaptation_points` returns it
    :return: The paragraph
    """
    curve = [point for point in points if point.partner == ALL]
    first, last = curve[0], curve[-1]
    partners = [point for point in points if point.partner != ALL and point.steps == last.steps]
    n = len(partners)
    own = next(row for row in rows if row["role"] == TEAM)
    said = [
        f"{own['run']} beside {n} partner{'s' * (n > 1)} on {own['environment']} (means over {first.score.n_seeds} repetitions"
        f" each, 95 % intervals over these): return {estimate_text(first.score)} after {first.steps} observed steps,"
        f" {estimate_text(last.score)} after {last.steps}."
    ]
    blind, oracle = (
        [estimate(list(of.values()), "mean")] if of else [] for of in (by_partner(rows, r, 0) for r in (BLIND, ORACLE))
    )
    if blind and oracle:
        gap = f"between blind ({estimate_text(blind[0])}) and oracle ({estimate_text(oracle[0])})"
        if first.share is None or last.share is None:
            said.append(f"There is no gap {gap}.")
        else:
            said.append(f"Of the gap {gap} that closes {first.share.value:.0%}, then {_percent(last.share)}.")
    if first.skill is not None and last.skill is not None:
        said.append(f"Its predictions are {estimate_text(first.skill)}, then {estimate_text(last.skill)} above the base rate.")
    regrets = [(point.regret.value, point.partner) for point in partners if point.regret is not None]
    worst, partner = max(regrets, default=(0.0, ""))
    if worst > 0:
        said.append(f"The largest regret after {last.steps} steps is {worst:.3g}, beside {partner}.")
    return " ".join(said)


def estimate_text(each: IntervalEstimate) -> str:
    """
    Return an estimate as text.

    :param each: The estimate
    :return: Such as ``"4 [3.5, 4.5]"``, without brackets if there is no interval
    """
    return f"{each.value:.3g}" + ("" if each.low is None else f" [{each.low:.3g}, {each.high:.3g}]")


def _percent(each: IntervalEstimate) -> str:
    return f"{each.value:.0%}" + ("" if each.low is None else f" [{each.low:.0%}, {each.high:.0%}]")
