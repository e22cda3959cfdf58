"""Rules of the Traffic Junction: moves, collisions, arrivals, rewards and limits, in both orders of a step."""

import numpy as np
import pytest

from tests.envs.traffic_junction.scenarios import BOTTOM, EAST, LEFT, RIGHT, STRAIGHT, TOP, WEST, arrival, gas, put, quiet_core

ORDERS = ("commnet", "ic3net")


def cell_of(core, slot):
    """Return row and column of a car."""
    return divmod(int(core.layout.cell[core.place[0, slot]]), core.layout.level.size)


@pytest.mark.parametrize("order", ORDERS)
def test_gas_moves_brake_waits_and_waiting_costs(order):
    core = quiet_core(order=order)
    put(core, 0, TOP, STRAIGHT, 2)
    put(core, 1, BOTTOM, STRAIGHT, 2)
    result = core.step(gas(core, 1))
    assert cell_of(core, 0) == (3, 6)
    assert cell_of(core, 1) == (11, 7)
    assert core.tau[0, :2].tolist() == [1, 1]
    result = core.step(gas(core, 1))
    np.testing.assert_allclose(result.rewards[0], [-0.02, -0.02] + [0.0] * 8)
    assert core.last_action[0].tolist() == [0, 1] + [0] * 8
    assert not result.partners.any()
    assert result.acted[0].tolist() == [True, True] + [False] * 8


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("n_cars", [2, 3, 4])
def test_each_partner_of_a_collision_costs_five(order, n_cars):
    core = quiet_core(order=order)
    # Two cars arrive at (6, 6), from the top and from the east; the others wait there already
    put(core, 0, TOP, STRAIGHT, 5)
    put(core, 3, EAST, STRAIGHT, 6)
    put(core, 5, TOP, RIGHT, 6)
    put(core, 6, TOP, LEFT, 6)
    brakes = [5, 6]
    for slot in (5, 6)[: 4 - n_cars]:
        core.on_road[0, slot] = False
        core.place[0, slot] = core.layout.nowhere
    result = core.step(gas(core, *brakes))
    here = [slot for slot in (0, 3, 5, 6) if core.on_road[0, slot]]
    assert len(here) == n_cars
    assert {cell_of(core, slot) for slot in here} == {(6, 6)}
    assert result.partners[0, here].tolist() == [n_cars - 1] * n_cars
    np.testing.assert_allclose(result.rewards[0, here], -5.0 * (n_cars - 1) - 0.01)
    assert core.n_collisions[0] == n_cars * (n_cars - 1) / 2
    assert np.flatnonzero(core.crashed[0]).tolist() == [6 * 14 + 6]
    # Cars that have collided drive on
    core.step(gas(core))
    assert cell_of(core, 0) == (7, 6)
    assert cell_of(core, 3) == (6, 5)


@pytest.mark.parametrize("order", ORDERS)
def test_cars_that_swap_cells_do_not_collide(order):
    core = quiet_core(order=order)
    put(core, 0, TOP, STRAIGHT, 3)
    put(core, 1, TOP, STRAIGHT, 4)
    result = core.step(gas(core))
    assert not result.partners.any()


def test_commnet_removes_on_the_last_cell_and_ic3net_beyond_it():
    for order, n_steps in (("commnet", 1), ("ic3net", 2)):
        core = quiet_core(order=order)
        put(core, 0, TOP, STRAIGHT, 12, tau=20)
        for k in range(n_steps):
            assert core.on_road[0, 0]
            result = core.step(gas(core))
            assert result.left[0, 0] == (k == n_steps - 1)
        assert not core.on_road[0, 0]
        assert core.tau[0, 0] == 0
        # In commnet order the car is still on the road when rewards are computed, in ic3net order no longer
        np.testing.assert_allclose(result.rewards[0, 0], -0.21 if order == "commnet" else 0.0)


def test_ic3net_car_may_wait_on_its_last_cell():
    core = quiet_core(order="ic3net")
    put(core, 0, TOP, STRAIGHT, 13)
    assert not core.step(gas(core, 0)).left.any()
    assert core.step(gas(core)).left[0, 0]


def test_commnet_cars_collide_on_the_last_cell_before_removal():
    core = quiet_core()
    # Two routes that end in (13, 6), each car one cell before it
    put(core, 0, TOP, STRAIGHT, 12)
    put(core, 1, WEST, RIGHT, 11)
    result = core.step(gas(core))
    assert result.partners[0, :2].tolist() == [1, 1]
    assert result.left[0, :2].all()


@pytest.mark.parametrize("order", ORDERS)
def test_a_freed_slot_is_given_to_an_arrival_of_the_same_step(order):
    core = quiet_core(order=order)
    core.set_arrival_rate(0.5)
    core.draws[:] = 1.0
    arrival(core, time=0, entry=EAST, turn=RIGHT, slot=4)
    put(core, 4, TOP, STRAIGHT, 12 if order == "commnet" else 13, tau=9)
    for slot in set(range(10)) - {4}:
        put(core, slot, WEST, STRAIGHT, 0)
    result = core.step(gas(core))
    assert result.left[0, 4] and result.acted[0, 4] and core.on_road[0, 4]
    assert cell_of(core, 4) == (6, 13)
    assert core.layout.route[core.place[0, 4]] == core.layout.entry_routes[EAST, RIGHT]
    assert core.tau[0, 4] == 0 and core.last_action[0, 4] == 0
    np.testing.assert_allclose(result.rewards[0, 4], -0.1 if order == "commnet" else 0.0)


def test_no_arrival_without_a_free_slot():
    core = quiet_core(arrival_rate=1.0)
    for slot in range(9):
        put(core, slot, TOP, STRAIGHT, slot + 1)
    core.step(gas(core, *range(9)))
    # A car arrives at each of the four entries, and one slot was free
    assert core.on_road.all()
    assert (core.layout.cell[core.place[0]] == 6).sum() == 1
    before = core.place.copy()
    core.step(np.ones((1, 10), dtype=int))
    np.testing.assert_array_equal(core.place, before)


def test_arrival_in_an_occupied_entry_collides_at_once_in_ic3net_only():
    results = {}
    for order in ORDERS:
        core = quiet_core(order=order)
        core.set_arrival_rate(0.5)
        core.draws[:] = 1.0
        arrival(core, time=0, entry=TOP, turn=STRAIGHT, slot=7)
        put(core, 0, TOP, LEFT, 0)
        results[order] = core.step(gas(core, 0))
        assert cell_of(core, 0) == cell_of(core, 7) == (0, 6)
        if order == "commnet":
            assert core.n_collisions[0] == 0
            np.testing.assert_allclose(results[order].rewards[0, [0, 7]], [-0.01, 0.0])
            # One car leaves the cell and the other stays, so they do not collide
            assert not core.step(gas(core, 7)).partners.any()
        else:
            assert core.n_collisions[0] == 1
            # The car that arrives has not acted
            np.testing.assert_allclose(results[order].rewards[0, [0, 7]], [-5.01, 0.0])
            assert results[order].partners[0, [0, 7]].tolist() == [1, 1]


def test_commnet_cars_that_stay_in_a_shared_entry_collide():
    core = quiet_core()
    put(core, 0, TOP, LEFT, 0)
    put(core, 1, TOP, STRAIGHT, 0)
    assert core.step(gas(core, 0, 1)).partners[0, :2].tolist() == [1, 1]
    core = quiet_core()
    put(core, 0, TOP, LEFT, 0)
    put(core, 1, TOP, STRAIGHT, 0)
    assert core.step(gas(core)).partners[0, :2].tolist() == [1, 1], "they leave together for the same cell"


def test_team_reward_is_the_mean_over_slots_for_everyone():
    core = quiet_core(reward="team", reward_scale=0.1)
    put(core, 0, TOP, STRAIGHT, 5)
    put(core, 3, EAST, STRAIGHT, 6)
    result = core.step(gas(core))
    np.testing.assert_allclose(result.rewards[0], np.full(10, 0.1 * 2 * -5.01 / 10))


def test_arrivals_are_bernoulli_uniform_over_slots_and_routes():
    core = quiet_core(2000, arrival_rate=0.2)
    for copy in range(core.n_copies):
        core.seed(copy, copy)
    core.reset()
    core.step(gas(core))
    n_cars = core.on_road.sum()
    # 8,000 trials with p = 0.2 have a standard deviation of 36
    assert abs(n_cars - 1600) < 4 * 36
    per_slot = core.on_road.sum(axis=0)
    assert np.abs(per_slot - n_cars / 10).max() < 4.5 * np.sqrt(n_cars / 10)
    per_route = np.bincount(core.layout.route[core.place[core.on_road]], minlength=12)
    assert np.abs(per_route - n_cars / 12).max() < 4.5 * np.sqrt(n_cars / 12)


def test_arrival_rate_counts_from_the_next_step_on():
    core = quiet_core(50)
    core.step(gas(core))
    assert not core.on_road.any()
    core.set_arrival_rate(1.0)
    core.step(gas(core))
    assert (core.on_road.sum(axis=1) == 4).all()
    core.set_arrival_rate(0.0)
    core.step(gas(core))
    assert (core.on_road.sum(axis=1) == 4).all()


def test_reset_of_some_copies_leaves_the_others():
    core = quiet_core(3, arrival_rate=0.5)
    core.reset()
    for _ in range(7):
        core.step(gas(core))
    place, time = core.place.copy(), core.time.copy()
    core.reset(np.array([1]))
    assert core.time.tolist() == [7, 0, 7]
    assert not core.on_road[1].any()
    np.testing.assert_array_equal(core.place[[0, 2]], place[[0, 2]])
    assert time.tolist() == [7, 7, 7]
    # Every copy still reads its own draws
    core.step(gas(core))
    assert core.time.tolist() == [8, 1, 8]


@pytest.mark.parametrize("level,limit", [("easy", 20), ("medium", 40), ("hard", 80)])
def test_step_limit(level, limit):
    core = quiet_core(level=level)
    dones = [bool(core.step(gas(core)).dones[0]) for _ in range(limit)]
    assert dones == [False] * (limit - 1) + [True]
