"""Roads, lanes and routes of the Traffic Junction (Sukhbaatar et al. 2016, https://arxiv.org/abs/1605.07736)."""

import heapq
from dataclasses import dataclass
from functools import cache

import numpy as np

Cell = tuple[int, int]
"""(row, column), row 0 at the top."""

SOUTH, NORTH, EAST, WEST = (1, 0), (-1, 0), (0, 1), (0, -1)


@dataclass(frozen=True)
class Level:
    """
    One level of difficulty: where the lanes lie, and the defaults that go with it.

    :param size: the grid is ``size`` x ``size`` cells
    :param southbound: columns of the lanes that lead down
    :param northbound: columns of the lanes that lead up
    :param eastbound: rows of the lanes that lead right
    :param westbound: rows of the lanes that lead left
    :param turns: whether cars may turn; otherwise every route is straight
    :param n_cars: number of slots for cars
    :param max_steps: length of an episode
    :param arrival_rate: default probability that a car wants to enter, per entry and step
    """

    size: int
    southbound: tuple[int, ...]
    northbound: tuple[int, ...]
    eastbound: tuple[int, ...]
    westbound: tuple[int, ...]
    turns: bool
    n_cars: int
    max_steps: int
    arrival_rate: float


LEVELS: dict[str, Level] = {
    "easy": Level(7, (3,), (), (3,), (), turns=False, n_cars=5, max_steps=20, arrival_rate=0.3),
    "medium": Level(14, (6,), (7,), (7,), (6,), turns=True, n_cars=10, max_steps=40, arrival_rate=0.2),
    "hard": Level(18, (4, 12), (5, 13), (5, 13), (4, 12), turns=True, n_cars=20, max_steps=80, arrival_rate=0.05),
}


@dataclass(frozen=True, eq=False)
class Layout:
    """
    The lanes of a level and all routes on them. A *place* is a number that says "cell k of route r": ``r * stride + k``. Each
    route has one place more than cells, *beyond* its last cell, and the last place of all, ``nowhere``, is that of no car.

    :param level: the level
    :param lanes: for each road cell the directions in which cars may leave it
    :param entries: first cells of the entering lanes, clockwise from the left end of the upper border
    :param routes: the cells of every route
    :param entry_routes: int [n_entries, k], the numbers of the routes that start at each entry
    :param stride: places per route
    :param cell: int [n_places], row * size + column; ``size**2`` beyond the end and nowhere
    :param next_cell: int [n_places], the cell after it; -1 on the last cell, beyond the end and nowhere
    :param route: int [n_places], number of the route; ``n_routes`` nowhere
    :param is_last: bool [n_places], whether it is the last cell of its route
    :param is_beyond: bool [n_places], whether it lies beyond the last cell of its route
    """

    level: Level
    lanes: dict[Cell, tuple[Cell, ...]]
    entries: tuple[Cell, ...]
    routes: tuple[tuple[Cell, ...], ...]
    entry_routes: np.ndarray
    stride: int
    cell: np.ndarray
    next_cell: np.ndarray
    route: np.ndarray
    is_last: np.ndarray
    is_beyond: np.ndarray

    @property
    def n_routes(self) -> int:
        return len(self.routes)

    @property
    def nowhere(self) -> int:
        return len(self.cell) - 1


@cache
def build_layout(name: str) -> Layout:
    """
    :param name: one of ``LEVELS``
    :return: its roads and routes (one shared object; treat it as read-only)
    """
    level = LEVELS[name]
    lanes = _lanes(level)
    clockwise = sorted(lanes, key=lambda cell: _border_position(cell, level.size))
    entries = [cell for cell in clockwise if _is_entry(cell, lanes, level.size)]
    exits = [cell for cell in clockwise if _is_exit(cell, lanes, level.size)]
    routes: list[tuple[Cell, ...]] = []
    entry_routes = []
    for entry in entries:
        position = _border_position(entry, level.size)
        # the exits clockwise from the entry, so that the routes of one entry are those of another, rotated
        around = sorted(exits, key=lambda e: (_border_position(e, level.size) - position) % (4 * level.size))
        found = [_best_route(entry, end, lanes) for end in around if _may_leave_by(entry, end, level)]
        entry_routes.append(list(range(len(routes), len(routes) + len(found))))
        routes.extend(found)
    return _tabulate(level, lanes, entries, routes, np.array(entry_routes))


def _lanes(level: Level) -> dict[Cell, tuple[Cell, ...]]:
    directions: dict[Cell, list[Cell]] = {}
    for k in range(level.size):
        for columns, heading in ((level.southbound, SOUTH), (level.northbound, NORTH)):
            for column in columns:
                directions.setdefault((k, column), []).append(heading)
        for rows, heading in ((level.eastbound, EAST), (level.westbound, WEST)):
            for row in rows:
                directions.setdefault((row, k), []).append(heading)
    return {cell: tuple(headings) for cell, headings in directions.items()}


def _border_position(cell: Cell, size: int) -> int:
    """Distance along the border, clockwise from the upper left corner; cells inside come last."""
    row, column = cell
    if row == 0:
        return column
    if column == size - 1:
        return size + row
    if row == size - 1:
        return 3 * size - 1 - column
    if column == 0:
        return 4 * size - 1 - row
    return 4 * size


def _is_entry(cell: Cell, lanes: dict[Cell, tuple[Cell, ...]], size: int) -> bool:
    return _border_position(cell, size) < 4 * size and _add(cell, lanes[cell][0]) in lanes


def _is_exit(cell: Cell, lanes: dict[Cell, tuple[Cell, ...]], size: int) -> bool:
    return _border_position(cell, size) < 4 * size and _add(cell, lanes[cell][0]) not in lanes


def _may_leave_by(entry: Cell, end: Cell, level: Level) -> bool:
    if not level.turns:
        return entry[0] == end[0] or entry[1] == end[1]
    # the lane beside the entry would be a U-turn
    return abs(entry[0] - end[0]) + abs(entry[1] - end[1]) > 1


def _best_route(entry: Cell, end: Cell, lanes: dict[Cell, tuple[Cell, ...]]) -> tuple[Cell, ...]:
    """The route with the fewest turns, then the fewest cells, then the earliest turns (the tie that ``hard`` has)."""
    queue: list[tuple[int, int, tuple[int, ...], tuple[Cell, ...], Cell]] = [(0, 1, (), (entry,), lanes[entry][0])]
    seen: set[tuple[Cell, Cell]] = set()
    while queue:
        n_turns, length, turned_at, path, heading = heapq.heappop(queue)
        cell = path[-1]
        if cell == end:
            return path
        if (cell, heading) in seen:
            continue
        seen.add((cell, heading))
        for direction in lanes[cell]:
            following = _add(cell, direction)
            if following in lanes and following not in path:
                turn = direction != heading
                where = (*turned_at, length) if turn else turned_at
                heapq.heappush(queue, (n_turns + turn, length + 1, where, (*path, following), direction))
    raise AssertionError(f"no route leads from {entry} to {end}")  # the lanes of LEVELS connect every entry to every exit


def _add(cell: Cell, direction: Cell) -> Cell:
    return cell[0] + direction[0], cell[1] + direction[1]


def _tabulate(level: Level, lanes: dict, entries: list[Cell], routes: list, entry_routes: np.ndarray) -> Layout:
    stride = max(map(len, routes)) + 1
    n_places = len(routes) * stride + 1
    cell = np.full(n_places, level.size**2)
    next_cell = np.full(n_places, -1)
    is_last = np.zeros(n_places, dtype=bool)
    is_beyond = np.zeros(n_places, dtype=bool)
    for r, path in enumerate(routes):
        numbers = [row * level.size + column for row, column in path]
        start, end = r * stride, r * stride + len(path)
        cell[start:end] = numbers
        next_cell[start : end - 1] = numbers[1:]
        is_last[end - 1] = True
        is_beyond[end] = True
    return Layout(
        level=level,
        lanes=lanes,
        entries=tuple(entries),
        routes=tuple(routes),
        entry_routes=entry_routes,
        stride=stride,
        cell=cell,
        next_cell=next_cell,
        route=np.arange(n_places) // stride,
        is_last=is_last,
        is_beyond=is_beyond,
    )
