"""Classes and a function that plain data may name in the tests."""

import dataclasses
import enum
from typing import Any, NamedTuple


def allowed(module: str) -> bool:
    return module.split(".")[0] in ("stable_baselines3", "tests") or module.startswith("torch.nn.modules.")


class Colour(enum.Enum):
    RED = 1
    BLUE = 2


class Flags(enum.Flag):
    A = 1
    B = 2


class Point(NamedTuple):
    x: Any
    y: Any


@dataclasses.dataclass(frozen=True)
class Frozen:
    number: int


@dataclasses.dataclass(slots=True)
class Slotted:
    a: Any
    b: Any


class Node:
    made = 0

    def __init__(self, **attributes: Any):
        type(self).made += 1
        vars(self).update(attributes)

    def chase(self) -> str:
        return "chasing"


class OwnState(Node):
    def __setstate__(self, state):
        raise AssertionError("called")


class Refusing(Node):
    def __reduce__(self):
        raise AssertionError("called")


class Nested:
    class Inner:
        pass


def double(x: float) -> float:
    return 2 * x
