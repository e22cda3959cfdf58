"""The arguments of the junction with cultures, and which cultures there are."""

from dataclasses import dataclass
from functools import cache
from itertools import permutations

import numpy as np

from sb3_belief.envs.drawn_types import TypeRules
from sb3_belief.envs.traffic_junction.config import JunctionConfig
from sb3_belief.envs.traffic_junction.layout import build_layout

CULTURE_LEVELS = ("easy", "medium")
CULTURES = ("axes", "orders")


@dataclass(frozen=True)
class CultureConfig(TypeRules):
    """
    The rules of a junction with cultures.

    :param level: ``"easy"`` or ``"medium"``
    :param cultures: ``"axes"`` for two cultures, of which one lets those from north and south go first and the other one those
        from east and west; ``"orders"`` for one culture for each order of the entries
    :param arrival_rate: See :class:`~sb3_belief.envs.TrafficJunction`
    :param reward_scale: See :class:`~sb3_belief.envs.TrafficJunction`
    :param vision: See :class:`~sb3_belief.envs.TrafficJunction`
    :raises ValueError: For any other value, and for ``held_out`` where no culture is held out
    """

    level: str = "medium"
    cultures: str = "axes"
    arrival_rate: float | None = None
    reward_scale: float = 1.0
    vision: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, value, allowed in (("level", self.level, CULTURE_LEVELS), ("cultures", self.cultures, CULTURES)):
            if value not in allowed:
                raise ValueError(f"{name}={value!r} is not one of {', '.join(map(repr, allowed))}.")
        # Checks the others
        self.junction  # noqa: B018
        if self.held_out and not any(self.held_out_cultures):
            raise ValueError(
                f"held_out=True with level={self.level!r} and cultures={self.cultures!r}: no culture is held out there. Use"
                " level='medium' and cultures='orders'."
            )

    @property
    def junction(self) -> JunctionConfig:
        """The rules of the traffic."""
        return JunctionConfig(self.level, "commnet", "own", self.arrival_rate, self.reward_scale, self.vision)

    @property
    def priorities(self) -> np.ndarray:
        """The rank of each entry in each culture, int64 [n_cultures, n_entries]. Those of rank 0 go first."""
        return _priorities(self.level, self.cultures)

    @property
    def names(self) -> list[str]:
        """The names of the cultures: which of the letters N, E, S, W goes before which, with a hyphen where ranks differ."""
        letters = _letters(self.level)
        return [
            "-".join("".join(a for a, r in zip(letters, ranks, strict=True) if r == rank) for rank in sorted(set(ranks)))
            for ranks in self.priorities.tolist()
        ]

    @property
    def held_out_cultures(self) -> list[bool]:
        """Which cultures are held out of training: with 24 orders eight of them, an order always with its reverse."""
        n = len(self.priorities)
        held_out = np.zeros(n, dtype=bool)
        if n == 24:
            for k in np.random.default_rng(0).permutation(n):
                if held_out.sum() < 8:
                    held_out[k] = held_out[(self.priorities == 3 - self.priorities[k]).all(axis=1)] = True
        return held_out.tolist()

    @property
    def weights(self) -> tuple[float, ...]:
        """The weight of each culture in the draws, 1 or 0."""
        return tuple(float(held_out == self.held_out) for held_out in self.held_out_cultures)


def _letters(level: str) -> list[str]:
    """Return from where the cars of each entry come."""
    layout = build_layout(level)
    last = layout.level.size - 1
    return ["N" if row == 0 else "S" if row == last else "W" if column == 0 else "E" for row, column in layout.entries]


@cache
def _priorities(level: str, cultures: str) -> np.ndarray:
    letters = _letters(level)
    if cultures == "axes":
        north_south = np.array([letter in "EW" for letter in letters], dtype=np.int64)
        ranks = np.stack([north_south, 1 - north_south])
    else:
        # permutations() has the entries in the order in which they go, and argsort() the rank of each
        ranks = np.argsort(list(permutations(range(len(letters)))), axis=1)
    ranks.flags.writeable = False
    return ranks
