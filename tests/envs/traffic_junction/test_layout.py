"""Roads of the Traffic Junction: routes of the three levels, and the tables made of them."""

from itertools import pairwise

import numpy as np
import pytest

from sb3_belief.envs.traffic_junction.layout import LEVELS, build_layout

TOP_STRAIGHT = [(row, 6) for row in range(14)]
TOP_RIGHT = [(row, 6) for row in range(7)] + [(6, column) for column in range(5, -1, -1)]
TOP_LEFT = [(row, 6) for row in range(8)] + [(7, column) for column in range(7, 14)]


def turned(route, quarters, size):
    """Return a route rotated by a number of quarter turns."""
    for _ in range(quarters):
        route = [(column, size - 1 - row) for row, column in route]
    return route


def test_medium_routes_are_those_of_the_top_entry_and_their_rotations():
    layout = build_layout("medium")
    assert layout.entries == ((0, 6), (6, 13), (13, 7), (7, 0))
    assert layout.entry_routes.shape == (4, 3)
    for quarters in range(4):
        routes = {layout.routes[r] for r in layout.entry_routes[quarters]}
        assert routes == {tuple(turned(route, quarters, 14)) for route in (TOP_STRAIGHT, TOP_RIGHT, TOP_LEFT)}
    assert sorted(map(len, layout.routes)) == [13] * 4 + [14] * 4 + [15] * 4


def test_easy_has_two_straight_one_way_roads():
    layout = build_layout("easy")
    assert layout.entries == ((0, 3), (3, 0))
    assert set(layout.routes) == {tuple((k, 3) for k in range(7)), tuple((3, k) for k in range(7))}


def test_hard_connects_each_entry_with_the_seven_other_roads():
    layout = build_layout("hard")
    assert layout.level.size == 18
    assert len(layout.entries) == 8
    assert layout.entry_routes.shape == (8, 7)
    assert len(set(layout.routes)) == 56
    junctions = [cell for cell, headings in layout.lanes.items() if len(headings) > 1]
    assert len(junctions) == 4 * 4
    for entry, numbers in zip(layout.entries, layout.entry_routes, strict=True):
        ends = {layout.routes[r][-1] for r in numbers}
        assert len(ends) == 7
        assert all(layout.routes[r][0] == entry for r in numbers)
        # A car may not leave by the road that it came from
        assert all(abs(end[0] - entry[0]) + abs(end[1] - entry[1]) > 1 for end in ends)
    # A quarter turn maps the routes onto themselves
    assert {tuple(turned(route, 1, 18)) for route in layout.routes} == set(layout.routes)


@pytest.mark.parametrize("name", LEVELS)
def test_routes_follow_lanes(name):
    layout = build_layout(name)
    for route in layout.routes:
        assert len(set(route)) == len(route)
        for (row, column), following in pairwise(route):
            assert following in {(row + down, column + right) for down, right in layout.lanes[row, column]}


@pytest.mark.parametrize("name", LEVELS)
def test_tables_say_what_the_routes_say(name):
    layout = build_layout(name)
    size = layout.level.size
    for r, route in enumerate(layout.routes):
        start = r * layout.stride
        numbers = [row * size + column for row, column in route]
        assert layout.cell[start : start + len(route)].tolist() == numbers
        assert layout.next_cell[start : start + len(route)].tolist() == [*numbers[1:], -1]
        assert np.flatnonzero(layout.is_last[start : start + layout.stride]).tolist() == [len(route) - 1]
        assert np.flatnonzero(layout.is_beyond[start : start + layout.stride]).tolist() == [len(route)]
        assert (layout.route[start : start + layout.stride] == r).all()
    assert layout.cell[layout.nowhere] == size**2
