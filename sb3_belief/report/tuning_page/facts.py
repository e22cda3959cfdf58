"""What a page says of a tuning and its trials."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

#: States of trials that have an objective; that of a pruned one is the objective of its last evaluation
COMPLETE, PRUNED = "complete", "pruned"


@dataclass(frozen=True)
class SearchedSetting:
    """
    A setting that is searched.

    :param name: Its name, with a dot before each nested part
    :param kind: What it is drawn from
    :param ends: Least and greatest number; None for choices
    :param choices: The choices as texts, in order. Empty for numbers
    :param is_log: Whether the logarithms are drawn evenly
    :param step: Distance of neighbouring numbers; None for any between
    :param falls: Whether the number is the start of a schedule that falls linearly to 0
    """

    name: str
    kind: Literal["integer", "number", "choice"]
    ends: tuple[float, float] | None = None
    choices: Sequence[str] = ()
    is_log: bool = False
    step: float | None = None
    falls: bool = False


@dataclass(frozen=True)
class TrialFacts:
    """
    What is known of a trial.

    :param number: Its number
    :param state: ``"complete"``, ``"pruned"``, ``"failed"``, ``"killed"``, ``"running"`` or ``"waiting"``
    :param settings: {name: what was drawn}: a number, or the text of a choice. Without those that were not drawn
    :param value: Its objective, a finite number; None for none
    :param seed_values: The objective of each of its runs that finished
    :param evaluations: The objective in each evaluation, one run after the other
    :param repeats: The trial that it repeats; None for none
    :param started: When it started, as the table has it
    :param seconds: How long it took; None if not known
    :param error: Why it failed
    """

    number: int
    state: str
    settings: Mapping[str, float | int | str]
    value: float | None = None
    seed_values: Sequence[float] = ()
    evaluations: Sequence[float] = ()
    repeats: int | None = None
    started: str = ""
    seconds: float | None = None
    error: str = ""

    @property
    def has_value(self) -> bool:
        """Whether it counts in the figures."""
        return self.state in (COMPLETE, PRUNED) and self.value is not None


@dataclass(frozen=True)
class TuningFacts:
    """
    What is known of a tuning.

    :param name: Its name
    :param algorithm: Name of the algorithm
    :param environment: Id of the environment
    :param settings: What is searched
    :param trials: The trials, in the order of their numbers
    :param n_trials: Number of trials that it is to have, without repetitions
    :param objective: ``"return"`` or ``"success"``
    :param seeds: Seeds of the runs of each trial
    :param last_evaluations: Number of evaluations, the last ones of a run, whose mean counts
    :param every: Joint steps between evaluations
    :param episodes: Episodes of an evaluation
    :param n_timesteps: Joint steps of a run; None for those of the algorithm's configuration file
    :param sampler: ``name``, ``seed`` and ``startup_trials``
    :param pruner: ``name``, ``startup_trials`` and ``warmup_evaluations``
    :param specification: The tuning's file
    :param best_settings: The best trial's settings as a configuration file; empty for none
    """

    name: str
    algorithm: str
    environment: str
    settings: Sequence[SearchedSetting]
    trials: Sequence[TrialFacts]
    n_trials: int
    objective: str = "return"
    seeds: Sequence[int] = (0,)
    last_evaluations: int = 1
    every: int = 1
    episodes: int = 1
    n_timesteps: int | None = None
    sampler: Mapping[str, Any] = field(default_factory=dict)
    pruner: Mapping[str, Any] = field(default_factory=dict)
    specification: str = ""
    best_settings: str = ""

    @property
    def unit(self) -> str:
        """What the objective is, in words."""
        return "success rate" if self.objective == "success" else "mean return"

    @property
    def best(self) -> TrialFacts | None:
        """The best complete trial, of equal ones the first; None if none is complete."""
        complete = [each for each in self.trials if each.state == COMPLETE and each.has_value]
        return max(complete, key=lambda each: (each.value, -each.number), default=None)

    def count(self, state: str) -> int:
        """
        Return how many trials are in a state.

        :param state: The state
        :return: Their number
        """
        return sum(each.state == state for each in self.trials)
