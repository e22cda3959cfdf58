"""What the cars of a Traffic Junction observe, and which other cars they see."""

import numpy as np
import pytest

from sb3_belief.envs.traffic_junction.config import JunctionConfig
from sb3_belief.envs.traffic_junction.core import TrafficCore
from sb3_belief.envs.traffic_junction.observation import Observer
from tests.envs.traffic_junction.scenarios import EAST, LEFT, RIGHT, STRAIGHT, TOP, gas, observe, put, quiet_core

N, R = 10, 12


def one_hot(k, n):
    """Return a list of ``n`` numbers, 1.0 at index ``k`` and 0.0 elsewhere."""
    return [float(j == k) for j in range(n)]


def test_a_car_alone():
    core = quiet_core()
    put(core, 3, TOP, LEFT, 2)
    core.step(gas(core, 3))
    obs, visible, _ = observe(core)
    assert obs.shape == (N, 1, 224) and obs.dtype == np.float32
    route = core.layout.entry_routes[TOP, LEFT]
    expected = [1.0, 1.0, *one_hot(route, R), 2 / 13, 6 / 13, 1 / 40] + [0.0] * 207
    np.testing.assert_allclose(obs[3, 0], expected, rtol=1e-6)
    assert not obs[np.arange(N) != 3].any(), "slots without a car see nothing"
    assert not visible.any()


def test_cars_in_view_and_where():
    core = quiet_core(observe_last_actions=True)
    put(core, 0, TOP, STRAIGHT, 5)  # (5, 6)
    put(core, 4, EAST, RIGHT, 6)  # (6, 7), moved below by one cell to (5, 7)
    put(core, 7, TOP, RIGHT, 4)  # (4, 6)
    put(core, 8, TOP, LEFT, 4)  # (4, 6)
    put(core, 9, TOP, LEFT, 7)  # (7, 6), two rows away
    core.place[0, 4] += 1
    core.last_action[0, [7, 9]] = 1
    obs, visible, observer = observe(core)
    assert divmod(int(core.layout.cell[core.place[0, 4]]), 14) == (5, 7)
    width = 1 + N + R + 1
    cells = obs[0, 0, 5 + R :].reshape(9, width)
    routes = {slot: int(core.layout.route[core.place[0, slot]]) for slot in (4, 7, 8)}
    # The upper centre cell holds two cars, one of which braked
    ids, both = [float(j in (7, 8)) for j in range(N)], [float(r in (routes[7], routes[8])) for r in range(R)]
    assert cells[1].tolist() == [2.0, *ids, *both, 1.0]
    assert cells[5].tolist() == [1.0, *one_hot(4, N), *one_hot(routes[4], R), 0.0]
    assert not np.delete(cells, [1, 5], axis=0).any(), "neither itself nor what is two rows away"
    assert np.flatnonzero(visible[0, 0]).tolist() == [4, 7, 8]
    others = observer.of_others(visible)[0]
    assert others.shape == (N, N - 1)
    assert others[0].tolist() == visible[0, 0, 1:].tolist()
    assert others[4].tolist() == np.delete(visible[0, 4], 4).tolist()
    space = observer.layout.space()
    assert all(space.contains(values[0]) for values in obs)


@pytest.mark.parametrize("level", ["easy", "medium", "hard"])
@pytest.mark.parametrize("vision", [0, 1, 2])
def test_against_an_independent_computation(level, vision):
    core = TrafficCore(2, JunctionConfig(level=level, vision=vision, arrival_rate=0.5))
    for copy in range(2):
        core.seed(copy, copy)
    core.reset()
    observer = Observer(core)
    generator = np.random.default_rng(0)
    size, n_cars, n_routes = core.layout.level.size, core.n_cars, core.layout.n_routes
    width, side = 1 + n_cars + n_routes, 2 * vision + 1
    n_seen = 0
    for _ in range(15):
        core.step(generator.integers(0, 2, size=(2, n_cars)))
        obs, visible = observer.observe()
        for copy in range(2):
            cars = {}
            for slot in np.flatnonzero(core.on_road[copy]):
                route, k = divmod(int(core.place[copy, slot]), core.layout.stride)
                cars[int(slot)] = (*core.layout.routes[route][k], route)
            for i in range(n_cars):
                expected = np.zeros((side, side, width))
                seen = []
                if i in cars:
                    row, column, route = cars[i]
                    np.testing.assert_allclose(obs[i, copy, 2 + n_routes : 4 + n_routes], np.array([row, column]) / (size - 1))
                    assert obs[i, copy, 2 : 2 + n_routes].argmax() == route
                    for j, (other_row, other_column, other_route) in cars.items():
                        down, right = other_row - row + vision, other_column - column + vision
                        if j != i and 0 <= down < side and 0 <= right < side:
                            expected[down, right, 0] += 1
                            expected[down, right, 1 + j] = 1
                            expected[down, right, 1 + n_cars + other_route] = 1
                            seen.append(j)
                else:
                    assert not obs[i, copy].any()
                n_seen += len(seen)
                assert np.flatnonzero(visible[copy, i]).tolist() == seen
                np.testing.assert_array_equal(obs[i, copy, 5 + n_routes :].reshape(side, side, width), expected)
    assert n_seen > 0


@pytest.mark.parametrize("level,width", [("easy", 79), ("medium", 224), ("hard", 754)])
def test_documented_widths(level, width):
    assert observe(quiet_core(level=level))[0].shape[-1] == width
