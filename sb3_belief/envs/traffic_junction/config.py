"""The arguments of the Traffic Junction and their validation."""

from dataclasses import dataclass

from sb3_belief.common.checks import check_flag
from sb3_belief.envs.traffic_junction.layout import LEVELS, Level

ORDERS = ("commnet", "ic3net")
REWARDS = ("own", "team")


@dataclass(frozen=True)
class JunctionConfig:
    """
    The rules of a Traffic Junction.

    :param level: ``"easy"``, ``"medium"`` or ``"hard"``
    :param order: Order of events in a step: ``"commnet"`` (move, collisions, removal, arrivals) or ``"ic3net"`` (move and
        removal, arrivals, collisions)
    :param reward: ``"own"`` (each agent gets the reward of its own car) or ``"team"`` (every agent gets the mean over all
        slots)
    :param arrival_rate: Probability in [0, 1] that a car wants to enter, per entry and step. None for the level's default
    :param reward_scale: Factor on all rewards, > 0
    :param vision: Largest distance in rows and in columns at which a car sees, in cells, >= 0 (1 shows the 3x3 cells around
        it)
    :param observe_last_actions: Whether observations contain the last actions of the cars in view
    :raises ValueError: For any other value
    """

    level: str = "medium"
    order: str = "commnet"
    reward: str = "own"
    arrival_rate: float | None = None
    reward_scale: float = 1.0
    vision: int = 1
    observe_last_actions: bool = False

    def __post_init__(self) -> None:
        for name, value, allowed in (
            ("level", self.level, tuple(LEVELS)),
            ("order", self.order, ORDERS),
            ("reward", self.reward, REWARDS),
        ):
            if value not in allowed:
                raise ValueError(f"{name}={value!r} is not one of {', '.join(map(repr, allowed))}.")
        if self.arrival_rate is not None:
            check_arrival_rate(self.arrival_rate)
        if not _is_number(self.reward_scale) or not 0 < self.reward_scale < float("inf"):
            raise ValueError(f"reward_scale={self.reward_scale!r} must be a positive number (0.1 suits PPO).")
        if not isinstance(self.vision, int) or isinstance(self.vision, bool) or self.vision < 0:
            raise ValueError(f"vision={self.vision!r} must be an integer >= 0 (1 shows the 3x3 cells around a car).")
        check_flag("observe_last_actions", self.observe_last_actions)

    @property
    def level_spec(self) -> Level:
        """The level of difficulty."""
        return LEVELS[self.level]

    @property
    def start_arrival_rate(self) -> float:
        """The arrival rate of a new environment, in [0, 1]."""
        return self.level_spec.arrival_rate if self.arrival_rate is None else float(self.arrival_rate)


def check_arrival_rate(arrival_rate: float) -> float:
    """
    Check an arrival rate.

    :param arrival_rate: Probability that a car wants to enter, per entry and step
    :return: The same number as a float
    :raises ValueError: If it is not a number in [0, 1]
    """
    if not _is_number(arrival_rate) or not 0 <= arrival_rate <= 1:
        raise ValueError(f"arrival_rate={arrival_rate!r} must be a probability in [0, 1], per entry and step.")
    return float(arrival_rate)


def _is_number(value: object) -> bool:
    # Schedules may produce numpy scalars, which have __float__ without being instances of int or float
    return not isinstance(value, bool | str | bytes) and hasattr(value, "__float__")
