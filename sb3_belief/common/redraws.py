"""When another partner is met, and which: draws that a seed determines, each without those before it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from sb3_belief.common.checks import check_flag, check_integer

UNITS = ("rollouts", "episodes")


@dataclass(frozen=True)
class RedrawSchedule:
    """
    How long a partner stays, and the draws of those that follow one another.

    What is drawn is an index into a list of partners, of types of them or of conventions. It depends on the seed, the number
    of the draw and, with ``per_copy``, the copy's own seed, and on nothing that has happened before. So whoever knows how many
    rollouts or episodes have passed knows who is there, and nothing else has to be saved.

    :param every: Number of rollouts or episodes for which a partner stays, >= 1. None for one that stays for ever
    :param unit: ``"rollouts"`` or ``"episodes"``
    :param per_copy: Whether each copy draws by itself; False for the same partner in all copies
    :param seed: Seed of the draws, >= 0
    :raises ValueError: For any other value, and for ``"episodes"`` without ``per_copy``, since copies end theirs at different
        times
    """

    every: int | None = 1
    unit: str = "episodes"
    per_copy: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        if self.every is not None:
            check_integer("redraw_every", self.every, 1, f"for how many {self.unit} a partner stays, or None")
        check_integer("seed", self.seed, 0, "which decides who is drawn")
        if self.unit not in UNITS:
            raise ValueError(f"redraw_unit={self.unit!r} is not one of {', '.join(map(repr, UNITS))}.")
        check_flag("per_copy", self.per_copy)
        if self.unit == "episodes" and not self.per_copy and self.every is not None:
            raise ValueError(
                "redraw_unit='episodes' needs per_copy=True, since the copies end their episodes at different times; partners"
                " that are the same in all copies change with rollouts."
            )

    def number(self, passed: int) -> int:
        """
        Return the number of the draw that holds now.

        :param passed: Rollouts or episodes that have ended since the seeding, >= 0
        :return: From 0
        """
        return 0 if self.every is None else passed // self.every

    def draw(self, number: int, weights: Sequence[float], copy_seed: int = 0, stream: int = 0) -> int:
        """
        Return who is drawn.

        :param number: Number of the draw, from 0
        :param weights: Of each that can be drawn, >= 0 and not all 0; they need not sum to 1
        :param copy_seed: The copy's own seed, >= 0. Without ``per_copy`` it does not matter
        :param stream: Number of those who draw by the same seed, >= 0; each has draws of its own
        :return: An index into ``weights``
        """
        key = (number, copy_seed) if self.per_copy else (number,)
        return _draw(self.seed, (*key, 0, stream) if stream else key, tuple(weights))


# Cached, because all copies ask for the same draw at the same time unless each has its own
@lru_cache(maxsize=1024)
def _draw(seed: int, key: tuple[int, ...], weights: tuple[float, ...]) -> int:
    # A generator of its own for each draw, so that any one can be made without those before it
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))
    shares = np.asarray(weights, dtype=np.float64)
    return int(rng.choice(len(shares), p=shares / shares.sum()))
