"""
Scripted players of Level-Based Foraging: pickers with a fixed order of collecting, and the heuristics H1 to H4.

The heuristics are written from their published description: H1 goes to the closest food; H2 to the food closest to the centre
of all visible players; H3 to the closest food that it can load by its own level; H4 to the food closest to the centre of the
visible players that their levels together can load.
"""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from types import MappingProxyType
from typing import TypeAlias

import numpy as np

Cell: TypeAlias = tuple[int, int]

LOAD = 5
_MOVES: tuple[Cell, ...] = ((-1, 0), (1, 0), (0, -1), (0, 1))


@dataclass(frozen=True)
class Situation:
    """
    What a scripted player knows, which is everything.

    :param field: Levels of the food, int [rows, columns]
    :param foods: Cells of the food at the beginning of the episode, in reading order
    :param me: Its own cell
    :param other: The cell of the other player
    :param level: Its own level
    :param levels: The levels of both together
    """

    field: np.ndarray
    foods: Sequence[Cell]
    me: Cell
    other: Cell
    level: int
    levels: int

    @property
    def left(self) -> list[Cell]:
        """The food that is left, in reading order."""
        return [food for food in self.foods if self.field[food]]


Choice: TypeAlias = Callable[[Situation], Cell | None]


def distance(a: Sequence[float], b: Sequence[float]) -> float:
    """
    Return the number of steps between two cells on an empty field.

    :param a: Row and column
    :param b: Row and column
    :return: Sum of both differences
    """
    return abs(a[0] - b[0]) + abs(a[1] - b[1])


def action_towards(food: Cell, field: np.ndarray, me: Cell, other: Cell) -> int:
    """
    Return the action of a player that goes to a food by a shortest way and loads it.

    :param food: Cell of the food
    :param field: Levels of the food, int [rows, columns]
    :param me: Cell of the player
    :param other: Cell of the other player, around which the way leads unless there is none
    :return: None 0, north 1, south 2, west 3, east 4 or load 5
    """
    if distance(me, food) == 1:
        return LOAD
    return _first_step(food, field, me, {other}) or _first_step(food, field, me, set()) or 0


def _first_step(food: Cell, field: np.ndarray, me: Cell, blocked: set[Cell]) -> int | None:
    rows, columns = field.shape
    seen, waiting = {me}, deque([(me, 0)])
    while waiting:
        (row, column), first = waiting.popleft()
        for move, (down, right) in enumerate(_MOVES, start=1):
            cell = (row + down, column + right)
            inside = 0 <= cell[0] < rows and 0 <= cell[1] < columns
            if not inside or cell in seen or cell in blocked or field[cell]:
                continue
            if distance(cell, food) == 1:
                return first or move
            seen.add(cell)
            waiting.append((cell, first or move))
    return None


def _in_order(order: Sequence[int]) -> Choice:
    def choose(now: Situation) -> Cell | None:
        # On a small field lbforaging may find no room for the last of them
        there = [now.foods[number] for number in order if number < len(now.foods)]
        return next((food for food in there if now.field[food]), None)

    return choose


def _closest(to_centre: bool, able: Callable[[Situation, int], bool]) -> Choice:
    def choose(now: Situation) -> Cell | None:
        centre = np.rint(np.mean([now.me, now.other], axis=0)) if to_centre else now.me
        foods = [food for food in now.left if able(now, int(now.field[food]))]
        return min(foods, key=lambda food: distance(food, centre), default=None)

    return choose


#: {kind: {name: which food a player of this type goes to}}
PARTNERS: Mapping[str, Mapping[str, Choice]] = MappingProxyType(
    {
        "orders": {"-".join(map(str, order)): _in_order(order) for order in permutations(range(3))},
        "heuristics": {
            "H1": _closest(False, lambda now, level: True),
            "H2": _closest(True, lambda now, level: True),
            "H3": _closest(False, lambda now, level: level <= now.level),
            "H4": _closest(True, lambda now, level: level <= now.levels),
        },
    }
)
