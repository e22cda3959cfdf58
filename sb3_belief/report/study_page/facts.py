"""What a page says of a study and its runs beside their scores."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sb3_belief.report.figures.curves import Curve

#: The diagnostics of a belief that pages show, with their titles and what they say
DIAGNOSTICS = {
    "belief/accuracy": ("Accuracy of the belief", "share of the others' actions that the belief expected most"),
    "belief/base_rate": ("Base rate", "accuracy of always expecting each other's most frequent action"),
    "belief/history_gain": (
        "Gain by the history",
        "how much the loss of the predictions rises when the history's actions are shuffled",
    ),
    "belief/history_gain_rare": (
        "Gain by the history, rare actions",
        "the same over the actions that each other does not do most often",
    ),
    "belief/action_loss": ("Loss of the predictions", "loss of the predicted actions"),
    "belief/kl": ("KL divergence", "divergence of the latent variable from its prior"),
    "belief/attention_entropy": (
        "Entropy of the attention",
        "how widely the attention spreads over the history's rows, in nats",
    ),
    "belief/fusion_ratio": (
        "Weight of the belief",
        "share of the belief's weights in the layer that joins it with the observation (the paper's Fig. 5e)",
    ),
    "belief/visible_fraction": ("Visible others", "share of the others' actions that the agents saw"),
}

#: Values of a quantity over joint steps: steps ``[k]`` and values ``[k]``
Series = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class RunFacts:
    """
    What is known of a run.

    :param arm: Its arm
    :param algorithm: Its algorithm
    :param environment: Id of its environment
    :param seed: Its seed; None if it is not known
    :param status: ``"finished"``, ``"running"``, ``"interrupted"``, ``"failed"``, ``"waiting"`` or ``"damaged"``
    :param folder: Its folder, as it is shown
    :param counts: Whether it is part of the comparison
    :param why_not: Why it is not, in words
    :param joint_steps: Joint steps that it has trained; None if not known
    :param total_steps: Joint steps that it shall train; None if not known
    :param seconds: Seconds that it took; None if not known
    :param started: When it started, as its record has it
    :param command: The command that started it
    :param config: Its configuration, as YAML
    :param versions: {package: version}
    :param error: Its traceback, or what is known of its failure
    :param score: Its score; None if it has none
    :param evaluations: {name of a series: its values over joint steps}: evaluations, returns while learning
    :param diagnostics: {name of a diagnostic: {agent: its values over joint steps}}
    :param viewer: File of the belief viewer, absolute; None if there is none
    :param trained: How its algorithm is trained, if it is not decentralised
    """

    arm: str
    algorithm: str
    environment: str
    seed: int | None
    status: str
    folder: Path
    counts: bool = True
    why_not: str = ""
    joint_steps: int | None = None
    total_steps: int | None = None
    seconds: float | None = None
    started: str = ""
    command: str = ""
    config: str = ""
    versions: Mapping[str, str] = field(default_factory=dict)
    error: str = ""
    score: float | None = None
    evaluations: Mapping[str, Series] = field(default_factory=dict)
    diagnostics: Mapping[str, Mapping[str, Series]] = field(default_factory=dict)
    viewer: Path | None = None
    trained: str = ""


@dataclass(frozen=True)
class StudyFacts:
    """
    What is known of a study, or of a folder of runs.

    :param name: Its name
    :param runs: Its runs
    :param is_study: Whether it is a study, with final evaluations. Otherwise the last evaluation of each run counts
    :param evaluation_every: Joint steps between evaluations; None if they differ or are not known
    :param evaluation_episodes: Episodes of an evaluation; None likewise
    :param final_episodes: Episodes of a final evaluation; None likewise
    :param ablations: {title of a panel: its arms}
    :param notices: Further things that the reader must know
    :param is_online: Whether the episodes of the trainings themselves count, instead of evaluations
    :param trained: {arm: how it was trained}, of those that are not decentralised
    """

    name: str
    runs: Sequence[RunFacts]
    is_study: bool = True
    evaluation_every: int | None = None
    evaluation_episodes: int | None = None
    final_episodes: int | None = None
    ablations: Mapping[str, Sequence[str]] = field(default_factory=dict)
    notices: Sequence[str] = ()
    is_online: bool = False
    trained: Mapping[str, str] = field(default_factory=dict)

    def versions(self) -> dict[str, list[str]]:
        """
        Return the versions of the packages that the runs used.

        :return: {package: versions, each once}
        """
        found: dict[str, list[str]] = {}
        for run in self.runs:
            for package, version in run.versions.items():
                if version not in found.setdefault(package, []):
                    found[package].append(version)
        return found


def thinned(series: Series, most: int = 80) -> Series:
    """
    Return a series with fewer points: means of as many neighbours as it takes.

    :param series: Steps ``[k]`` and values ``[k]``. Values that are NaN are left out
    :param most: Number of points that it may have
    :return: Steps, each the last of its group, and the means
    """
    steps, values = series
    known = ~np.isnan(values)
    steps, values = steps[known], values[known]
    groups = np.array_split(np.arange(len(steps)), min(most, len(steps)) or 1)
    if len(steps) <= most:
        return steps, values
    return np.array([steps[group[-1]] for group in groups]), np.array([values[group].mean() for group in groups])


def mean_of(series: Mapping[Any, Series]) -> Series:
    """
    Return the mean of several series, over those that have a value, after each of the steps that one of them has.

    :param series: The series
    :return: Steps ``[k]`` and means ``[k]``
    """
    steps = np.unique(np.concatenate([each[0] for each in series.values()])) if series else np.zeros(0)
    rows = np.full((len(series), len(steps)), np.nan)
    for row, (own, values) in zip(rows, series.values(), strict=True):
        row[np.searchsorted(steps, own)] = values
    counts = (~np.isnan(rows)).sum(axis=0)
    return steps, np.nansum(rows, axis=0) / np.maximum(counts, 1)


def curve_of(series: Mapping[int | str, Series]) -> Curve:
    """
    Return the curve of several series: their mean, each a thin line.

    :param series: {seed or other name: steps and values}
    :return: The curve
    """
    steps, means = mean_of(series)
    seeds = {}
    for name, (own, values) in series.items():
        row = np.full(len(steps), np.nan)
        row[np.searchsorted(steps, own)] = values
        seeds[name] = row
    return Curve(steps, means, seeds=seeds if len(series) > 1 else {})
