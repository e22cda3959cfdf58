"""Roads, lanes and routes of the Traffic Junction (Sukhbaatar et al. 2016, https://arxiv.org/abs/1605.07736)."""

import heapq
from dataclasses import dataclass
from functools import cache

import numpy as np

Cell = tuple[int, int]
"""(row, column). Row 0 is at the top."""

SOUTH, NORTH, EAST, WEST = (1, 0), (-1, 0), (0, 1), (0, -1)


@dataclass(frozen=True)
class Level:
    """
    One level of difficulty: the position of the lanes and the defaults of the level.

    :param size: Number of rows and of columns of the grid
    :param southbound: Columns of the lanes that lead down
    :param northbound: Columns of the lanes that lead up
    :param eastbound: Rows of the lanes that lead right
    :param westbound: Rows of the lanes that lead left
    :param turns: Whether cars may turn. Otherwise every route is straight
    :param n_cars: Number of slots for cars
    :param max_steps: Length of an episode in steps
    :param arrival_rate: Default probability that a car wants to enter, per entry and step
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
    The lanes of a level and all routes on them, as lookup tables.

    A *place* is the number ``r * stride + k``, which stands for cell k of route r. A car thus moves by adding 1 to its place.
    Each route has one place more than it has cells, which lies *beyond* its last cell. The very last place, ``nowhere``, is
    that of slots without a car.

    :param level: The level
    :param lanes: For each road cell the directions in which cars may leave it
    :param entries: First cells of the entering lanes, clockwise from the left end of the upper border
    :param routes: The cells of every route
    :param entry_routes: Numbers of the routes that start at each entry, int [n_entries, k]
    :param stride: Number of places per route
    :param cell: Cell of each place as row * size + column, int [n_places]. ``size**2`` beyond the end and nowhere
    :param next_cell: Cell that follows each place, int [n_places]. -1 on the last cell, beyond the end and nowhere
    :param route: Number of the route of each place, int [n_places]. ``n_routes`` nowhere
    :param is_last: Whether a place is the last cell of its route, bool [n_places]
    :param is_beyond: Whether a place lies beyond the last cell of its route, bool [n_places]
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
        """The number of routes."""
        return len(self.routes)

    @property
    def nowhere(self) -> int:
        """The place of a slot without a car."""
        return len(self.cell) - 1


@cache
def build_layout(name: str) -> Layout:
    """
    Return the roads and routes of a level.

    :param name: Name of a level, a key of ``LEVELS``
    :return: The layout. All callers share one object, so it must not be changed
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
        # The exits are sorted clockwise from the entry, so that the k-th route of one entry is the k-th of another, rotated
        around = sorted(exits, key=lambda e: (_border_position(e, level.size) - position) % (4 * level.size))
        from_entry = [_best_route(entry, end, lanes) for end in around if _may_leave_by(entry, end, level)]
        entry_routes.append(list(range(len(routes), len(routes) + len(from_entry))))
        routes.extend(from_entry)
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
    """Return the distance along the border, clockwise from the upper left corner. Inner cells come last."""
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
    # The exit beside the entry would be a U-turn
    return abs(entry[0] - end[0]) + abs(entry[1] - end[1]) > 1


def _best_route(entry: Cell, end: Cell, lanes: dict[Cell, tuple[Cell, ...]]) -> tuple[Cell, ...]:
    """Return the route with the fewest turns, then the fewest cells, then the earliest turns (``hard`` has such ties)."""
    # Dijkstra's algorithm: the queue is sorted by number of turns, number of cells and positions of the turns
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
    # The lanes of LEVELS connect every entry to every exit
    raise AssertionError(f"no route leads from {entry} to {end}")


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
