"""The arguments of the aisles and the conventions that their robots may follow."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from sb3_belief.common.checks import check_flag, check_integer
from sb3_belief.envs.drawn_types import TypeRules

MIDDLE, LEFT, RIGHT = 0, 1, 2
MOST_KINDS = 6


@dataclass(frozen=True)
class AisleConfig(TypeRules):
    """
    The rules of the aisles.

    :param kinds: Number of visible kinds of robots, each of which keeps to a side of its own, from 1 to 6
    :param n_robots: Number of learners, each in an aisle of its own, >= 1
    :param length: Cells of an aisle, larger than ``sight + 1``
    :param sight: Largest distance at which a robot sees another one, in cells, >= 2
    :param traffic: Probability in (0, 1] that another robot enters an aisle that has none, per step
    :param jam_steps: Steps that a wrong guess costs both robots, >= 1
    :param max_steps: Length of an episode in steps, >= 1
    :param others_visible: Whether a robot observes what the one in sight does; False as a control
    :raises ValueError: For any other value, and for ``held_out`` where no convention is held out
    """

    kinds: int = 1
    n_robots: int = 1
    length: int = 8
    sight: int = 3
    traffic: float = 0.7
    jam_steps: int = 8
    max_steps: int = 40
    others_visible: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        check_integer("kinds", self.kinds, 1, "the number of visible kinds of robots", MOST_KINDS)
        check_integer("n_robots", self.n_robots, 1, "the number of learners")
        check_integer("sight", self.sight, 2, "robots in front of each other are up to two cells apart")
        check_integer("length", self.length, self.sight + 2, "the cells of an aisle, in which robots see each other coming")
        check_integer("jam_steps", self.jam_steps, 1, "the steps that a wrong guess costs")
        check_integer("max_steps", self.max_steps, 1, "the length of an episode")
        is_number = isinstance(self.traffic, int | float) and not isinstance(self.traffic, bool)
        if not is_number or not 0 < self.traffic <= 1:
            raise ValueError(f"traffic={self.traffic!r} must be a probability in (0, 1], per step and empty aisle.")
        check_flag("others_visible", self.others_visible)
        if self.held_out and not held_out_conventions(self.kinds).any():
            raise ValueError(f"held_out=True needs kinds >= 3, since fewer have no held-out conventions; kinds={self.kinds}.")

    @property
    def weights(self) -> tuple[float, ...]:
        """The weight of each convention in the draws, 1 or 0."""
        held_out = held_out_conventions(self.kinds)
        return tuple((held_out if self.held_out else ~held_out).astype(float).tolist())


@cache
def convention_sides(kinds: int) -> np.ndarray:
    """
    Return to which side the kinds of robots keep.

    :param kinds: Number of kinds
    :return: 1 (left) or 2 (right) by convention and kind, int64 [2**kinds, kinds], read-only. The last kind changes fastest
    """
    bits = np.arange(2**kinds)[:, None] >> np.arange(kinds)[::-1] & 1
    sides = np.where(bits, RIGHT, LEFT)
    sides.flags.writeable = False
    return sides


@cache
def held_out_conventions(kinds: int) -> np.ndarray:
    """
    Return which conventions are held out of training: a quarter of them, none with fewer than three kinds.

    They come in pairs of opposites, so that in those that are left each kind keeps left as often as right, and only memory
    tells.

    :param kinds: Number of kinds
    :return: bool [2**kinds], read-only
    """
    n_pairs = 2 ** (kinds - 1)
    chosen = np.zeros(2 * n_pairs, dtype=bool)
    pairs = np.random.default_rng(kinds).permutation(n_pairs)[: n_pairs // 4]
    chosen[pairs] = chosen[2 * n_pairs - 1 - pairs] = True
    chosen.flags.writeable = False
    return chosen


def convention_names(kinds: int) -> list[str]:
    """
    Return the names of the conventions.

    :param kinds: Number of kinds
    :return: ``left`` and ``right`` with one kind, otherwise a letter for each kind, such as ``LRRL``
    """
    if kinds == 1:
        return ["left", "right"]
    return ["".join("LR"[side - LEFT] for side in sides) for sides in convention_sides(kinds)]
