"""Hidden types of scripted others, in environments whose copies are stepped at once: which holds now in each copy."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sb3_belief.common.checks import check_flag, check_integer
from sb3_belief.common.redraws import RedrawSchedule


@dataclass(frozen=True)
class TypeRules:
    """
    When the type of the scripted others is drawn anew, and whether learners are told: arguments that such tasks share.

    :param redraw_every: Number of rollouts or episodes for which a type stays, >= 1. None for one that stays for ever
    :param redraw_unit: ``"rollouts"`` or ``"episodes"``
    :param per_copy: Whether each copy draws by itself; False for the same type in all copies
    :param rollout_steps: Steps of one copy in a rollout, >= 1: the learner's ``n_steps``. It counts with rollouts only
    :param partner_seed: Seed of the draws, >= 0
    :param held_out: Whether types are drawn from those that are held out of training, instead of the others
    :param reveal_partner: Whether observations end with what the present type is, one-hot
    :raises ValueError: For any other value, and for episodes without ``per_copy``
    """

    redraw_every: int | None = 5
    redraw_unit: str = "rollouts"
    per_copy: bool = False
    rollout_steps: int = 40
    partner_seed: int = 0
    held_out: bool = False
    reveal_partner: bool = False

    def __post_init__(self) -> None:
        check_integer("rollout_steps", self.rollout_steps, 1, "the n_steps of the learner")
        for name in ("held_out", "reveal_partner"):
            check_flag(name, getattr(self, name))
        try:
            self.schedule  # noqa: B018
        except ValueError as error:
            raise ValueError(f"redraw_every, redraw_unit, per_copy and partner_seed are no schedule: {error}") from error

    @property
    def schedule(self) -> RedrawSchedule:
        """When a type is drawn, and which."""
        return RedrawSchedule(self.redraw_every, self.redraw_unit, self.per_copy, self.partner_seed)


class DrawnTypes:
    """
    The type that holds in each of ``n_copies`` copies.

    A type that changes with rollouts changes at once, or at the next reset if the episode has just ended: the last observation
    of an episode still belongs to the type that was played. One that changes with episodes changes at resets.

    :param n_copies: Number of environment copies
    :param rules: When types are drawn
    :param weights: Of each type, >= 0 and not all 0: those of weight 0 are never drawn
    """

    def __init__(self, n_copies: int, rules: TypeRules, weights: Sequence[float]):
        self.rules, self.weights = rules, tuple(weights)
        self.current = np.zeros(n_copies, dtype=np.int64)
        # Steps and finished episodes since the copy was last seeded
        self.age = np.zeros(n_copies, dtype=np.int64)
        self.episodes = np.zeros(n_copies, dtype=np.int64)
        self.copy_seeds = [0] * n_copies
        self._period = None
        if rules.redraw_unit == "rollouts" and rules.redraw_every is not None:
            self._period = rules.redraw_every * rules.rollout_steps
        for copy in range(n_copies):
            self.seed(copy, None)

    def seed(self, copy: int, seed: int | None) -> None:
        """
        Seed one copy, which starts again with the first draw.

        :param copy: Index of the copy
        :param seed: The copy's own seed, or None for one from the operating system
        """
        self.copy_seeds[copy] = int(np.random.SeedSequence().generate_state(1)[0]) if seed is None else seed
        self.age[copy] = self.episodes[copy] = 0
        self.update([copy])

    def step(self, dones: np.ndarray) -> None:
        """
        Count a step of all copies.

        :param dones: Whether the copy's episode has ended with it, bool [n_copies]
        """
        self.age += 1
        self.episodes += dones
        if self._period is not None:
            due = np.flatnonzero((self.age % self._period == 0) & ~dones)
            if len(due):
                self.update(due)

    def update(self, copies: Sequence[int] | np.ndarray) -> None:
        """
        Set the types by the numbers of steps and episodes so far, as at the start of an episode.

        :param copies: Indices of the copies, int [k]
        """
        schedule, steps = self.rules.schedule, self.rules.rollout_steps
        for copy in copies:
            by_rollouts = schedule.unit == "rollouts"
            passed = int(self.age[copy]) // steps if by_rollouts else int(self.episodes[copy])
            self.current[copy] = schedule.draw(schedule.number(passed), self.weights, self.copy_seeds[copy])

    def get_state(self, copy: int) -> dict[str, int]:
        """
        Return what determines the types of one copy from here on.

        :param copy: Index of the copy
        :return: Plain numbers
        """
        return {
            "age": int(self.age[copy]),
            "episodes": int(self.episodes[copy]),
            "copy_seed": self.copy_seeds[copy],
            "current": int(self.current[copy]),
        }

    def set_state(self, copy: int, state: dict[str, Any]) -> None:
        """
        Restore one copy.

        :param copy: Index of the copy
        :param state: State that ``get_state`` returned under the same rules
        """
        self.age[copy], self.episodes[copy] = state["age"], state["episodes"]
        self.copy_seeds[copy], self.current[copy] = state["copy_seed"], state["current"]
