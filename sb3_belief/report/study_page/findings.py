"""What statistics say of the episodes of a study: the numbers of its page."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa

from sb3_belief.report.bands import Band, efficiency_curve, overall_curves, performance_profiles
from sb3_belief.report.episodes import curves, scores
from sb3_belief.report.figures.curves import Curve
from sb3_belief.report.statistics import (
    IntervalEstimate,
    Scores,
    estimates_by_environment,
    normalized_scores,
    overall_estimates,
    score_range,
    shared,
)
from sb3_belief.report.verdicts import BaselineComparison, compare_overall, compare_with_baseline

# Lowest and highest possible score, if there are such
Limits = tuple[float, float] | None

# A line of hundreds of points has no more to show than one of so many
_POINTS = 200
# Which weights count and whether they act greedily, those that a table has of these
_WAYS = [(checkpoint, deterministic) for checkpoint in ("best", "last", "current") for deterministic in (True, False)]
# Bands are looked at, and their intervals are many
_CURVE_RESAMPLES = 2_000


@dataclass(frozen=True)
class ArmFinding:
    """
    What is found of an arm, on one environment or over all.

    :param score: Interquartile mean of its runs' scores
    :param seeds: {seed: score of the run}; over all environments {"seed, environment": normalised score}
    :param comparison: With the baseline; None for the baseline itself, or if there is none
    """

    score: IntervalEstimate
    seeds: Mapping[int | str, float]
    comparison: BaselineComparison | None = None


@dataclass(frozen=True)
class OtherScore:
    """
    Score of an arm by another way to evaluate it.

    :param environment: The environment
    :param arm: The arm
    :param checkpoint: Which weights were evaluated
    :param deterministic: Whether the team acted greedily
    :param score: Interquartile mean
    :param n_runs: Number of runs
    """

    environment: str
    arm: str
    checkpoint: str
    deterministic: bool
    score: IntervalEstimate
    n_runs: int


@dataclass(frozen=True)
class Findings:
    """
    Everything that is found.

    :param quantity: ``"return"`` or ``"success"``
    :param checkpoint: Which weights were evaluated: ``"best"``, ``"last"``, or ``"current"`` for the last evaluation
    :param deterministic: Whether the team acted greedily
    :param arms: The arms, in order
    :param baseline: The arm that the others are compared with; None for none
    :param environments: {environment: {arm: what is found}}
    :param overall: {arm: the same over the environments in which all arms have runs, of normalised scores}; empty for fewer
        than two environments
    :param profiles: {environment: {arm: its performance profile}}, and over all
    :param curves: {environment: {arm: its learning curve}}
    :param overall_curves: {arm: its curve over all environments, of normalised scores}; may be empty
    :param others: Scores by other ways to evaluate
    """

    quantity: str
    checkpoint: str
    deterministic: bool
    arms: Sequence[str]
    baseline: str | None
    environments: Mapping[str, Mapping[str, ArmFinding]]
    overall: Mapping[str, ArmFinding] = field(default_factory=dict)
    profiles: Mapping[str, Mapping[str, Curve]] = field(default_factory=dict)
    curves: Mapping[str, Mapping[str, Curve]] = field(default_factory=dict)
    overall_curves: Mapping[str, Curve] = field(default_factory=dict)
    others: Sequence[OtherScore] = ()

    @property
    def unit(self) -> str:
        """What a score is, in words."""
        return "success rate" if self.quantity == "success" else "return per episode"


def findings_of(
    table: pa.Table,
    arms: Sequence[str],
    baseline: str | None,
    quantity: str | None = None,
    overall_name: str = "all environments",
) -> Findings:
    """
    Return what statistics say of the episodes of a study.

    The best team of each run counts, acting greedily; where it was not evaluated so, the last team, then the last evaluation
    while training, and sampled actions.

    :param table: The episodes of all runs that count (``report.episodes``)
    :param arms: The arms in order, of which some may have no runs
    :param baseline: The arm that the others are compared with; None for none
    :param quantity: ``"return"`` or ``"success"``. None for successes if all environments report them
    :param overall_name: What all environments together are called
    :return: The findings, without any for a table without rows
    :raises ValueError: If the quantity is not there
    """
    quantity = quantity or default_quantity(table)
    if not table.num_rows:
        return Findings(quantity, "best", True, [], None, {})
    ways = _ways(table)
    checkpoint, deterministic = ways[0]
    found = scores(table, quantity, checkpoint, deterministic)
    present = {arm for of_arms in found.values() for arm in of_arms}
    known = [arm for arm in arms if arm in present]
    found = {environment: {arm: of[arm] for arm in known if arm in of} for environment, of in found.items()}
    of_baseline = baseline if baseline in present else None
    limits = (0.0, 1.0) if quantity == "success" else None
    bounds = {environment: (0.0, 1.0) for environment in found} if quantity == "success" else score_range(found)
    training = curves(table, quantity, deterministic=("current", True) in ways)
    several = len(shared(found)) > 1
    profiles = {
        environment: performance_profiles({environment: of}, _thresholds(of), n_resamples=_CURVE_RESAMPLES)
        for environment, of in found.items()
    }
    if several:
        profiles = {
            overall_name: performance_profiles(normalized_scores(found, bounds), n_resamples=_CURVE_RESAMPLES),
            **profiles,
        }
    return Findings(
        quantity,
        checkpoint,
        deterministic,
        known,
        of_baseline,
        _by_environment(found, of_baseline, limits),
        _over_all(found, of_baseline, bounds, limits) if several else {},
        {place: {arm: _curve(band) for arm, band in of.items()} for place, of in profiles.items() if of},
        {
            environment: {arm: _learning_curve(*of[arm], limits) for arm in known if arm in of}
            for environment, of in training.items()
            if environment in found
        },
        _overall_curves(training, known, bounds, limits) if several else {},
        _others(table, quantity, ways, known, limits),
    )


def default_quantity(table: pa.Table) -> str:
    """
    Return what scores are made of if nothing else is said.

    :param table: The episodes
    :return: ``"success"`` if all episodes report it, else ``"return"``
    """
    return "success" if table.num_rows and not table["success"].null_count else "return"


def _by_environment(found: Scores, baseline: str | None, limits: Limits) -> dict[str, dict[str, ArmFinding]]:
    estimates = estimates_by_environment(found, limits=limits)
    compared = {} if baseline is None else compare_with_baseline(found, baseline, limits=limits)
    return {
        environment: {
            arm: ArmFinding(
                estimates[environment][arm],
                {seed: value for seed, value in seeds.items()},
                next((each for each in compared.get(environment, []) if each.arm == arm), None),
            )
            for arm, seeds in of_arms.items()
        }
        for environment, of_arms in found.items()
    }


def _over_all(
    found: Scores, baseline: str | None, bounds: Mapping[str, tuple[float, float]], limits: Limits
) -> dict[str, ArmFinding]:
    estimates = overall_estimates(found, bounds=bounds, limits=limits)
    compared = [] if baseline is None else compare_overall(found, baseline, bounds=bounds, limits=limits)
    normalised = normalized_scores(shared(found), bounds)
    return {
        arm: ArmFinding(
            estimate,
            {f"{seed}, {environment}": value for environment, of in normalised.items() for seed, value in of[arm].items()},
            next((each for each in compared if each.arm == arm), None),
        )
        for arm, estimate in estimates.items()
    }


def _overall_curves(
    training: Mapping[str, Mapping[str, tuple[np.ndarray, np.ndarray, list[int]]]],
    arms: Sequence[str],
    bounds: Mapping[str, tuple[float, float]],
    limits: Limits,
) -> dict[str, Curve]:
    of_arms = {
        environment: {arm: of[arm] for arm in arms if arm in of}
        for environment, of in training.items()
        if environment in bounds
    }
    bands = overall_curves(of_arms, bounds, n_resamples=_CURVE_RESAMPLES, limits=limits)
    return {arm: _curve(band) for arm, band in bands.items()}


def _learning_curve(steps: np.ndarray, values: np.ndarray, seeds: list[int], limits: Limits) -> Curve:
    # Of very many evaluations every second, third ... and the last
    kept = np.unique(np.append(np.arange(0, len(steps), max(1, -(-len(steps) // _POINTS))), len(steps) - 1))
    band = efficiency_curve(steps[kept], values[:, kept], n_resamples=_CURVE_RESAMPLES, limits=limits)
    centre, low, high = (np.full(len(kept), np.nan) for _ in range(3))
    places = np.searchsorted(steps[kept], band.x)
    centre[places] = band.values
    if band.low is None or band.high is None:
        return Curve(steps[kept], centre)
    low[places], high[places] = band.low, band.high
    return Curve(steps[kept], centre, low, high, {seed: row for seed, row in zip(seeds, values[:, kept], strict=True)})


def _thresholds(of_arms: Mapping[str, Mapping[int, float]]) -> np.ndarray:
    values = [value for seeds in of_arms.values() for value in seeds.values()]
    low, high = min(values), max(values)
    # A little beyond both ends, so that the profiles begin at 1 and end at 0
    margin = 0.05 * (high - low) or 0.5
    return np.linspace(low - margin, high + margin, 101)


def _curve(band: Band) -> Curve:
    return Curve(band.x, band.values, band.low, band.high)


def _ways(table: pa.Table) -> list[tuple[str, bool]]:
    """Return the ways in which teams were evaluated, the one that counts first."""
    there = {
        (row["checkpoint"], row["deterministic"])
        for row in table.group_by(["checkpoint", "deterministic"]).aggregate([]).to_pylist()
    }
    return [way for way in _WAYS if way in there]


def _others(
    table: pa.Table, quantity: str, ways: Sequence[tuple[str, bool]], arms: Sequence[str], limits: Limits
) -> list[OtherScore]:
    final = [way for way in ways if way[0] != "current"]
    found = []
    # One alone is that of the headline
    for checkpoint, deterministic in final if len(final) > 1 else ():
        of_all = scores(table, quantity, checkpoint, deterministic)
        for environment, of in estimates_by_environment(of_all, limits=limits).items():
            for arm in arms:
                if arm in of:
                    n_runs = len(of_all[environment][arm])
                    found.append(OtherScore(environment, arm, checkpoint, deterministic, of[arm], n_runs))
    return found
