"""Reference policies of the Traffic Junction, and the success rates that they are known to reach."""

import numpy as np
import pytest

from sb3_belief.envs.traffic_junction.policies import (
    RandomPolicy,
    RulePolicy,
    all_brake,
    all_gas,
    evaluate_junction_policy,
    success_rate,
)
from tests.envs.traffic_junction.scenarios import BOTTOM, EAST, LEFT, RIGHT, STRAIGHT, TOP, WEST, observe, put, quiet_core

EPISODES = 2048


@pytest.mark.parametrize(
    "policy,order,arrival_rate,expected,tolerance",
    [
        (all_gas, "commnet", 0.2, 0.035, 0.03),
        (all_gas, "ic3net", 0.2, 0.043, 0.03),
        (all_gas, "commnet", 0.1, 0.31, 0.03),
        (all_brake, "commnet", 0.2, 0.0, 0.001),
        (all_brake, "ic3net", 0.2, 0.0, 0.001),
        (RandomPolicy(0), "commnet", 0.2, 0.0, 0.002),
        (RandomPolicy(0), "ic3net", 0.2, 0.0, 0.002),
        (RulePolicy(), "commnet", 0.2, 0.936, 0.03),
        (RulePolicy(), "commnet", 0.1, 0.986, 0.015),
        (RulePolicy(), "commnet", 0.05, 1.0, 0.005),
        # The expected value is one sample of 1,024 episodes (standard error 0.015); 65,536 episodes give 0.630 (0.002)
        (RulePolicy(), "ic3net", 0.2, 0.661, 0.06),
        (RulePolicy(), "ic3net", 0.1, 0.889, 0.03),
        (RulePolicy(), "ic3net", 0.05, 0.986, 0.015),
    ],
)
def test_success_of_the_reference_policies(policy, order, arrival_rate, expected, tolerance):
    result = evaluate_junction_policy(policy, EPISODES, seed=0, order=order, arrival_rate=arrival_rate)
    assert result.episodes == EPISODES
    assert result.success_rate == pytest.approx(expected, abs=tolerance)
    if arrival_rate == 0.2:
        assert 0.72 < result.occupancy < 0.85
        if policy is not all_brake:
            assert 0.8 < result.visible < 1.25


def rule_actions(core):
    """Return the actions of the rule for all slots, given what they observe."""
    obs, _, _ = observe(core)
    policy = RulePolicy(level=core.config.level)
    return [int(a[0]) for a in policy({f"car_{i}": values for i, values in enumerate(obs)}).values()]


def test_rule_brakes_for_a_car_in_its_next_cell():
    core = quiet_core()
    put(core, 0, TOP, STRAIGHT, 3)
    put(core, 9, TOP, STRAIGHT, 4)
    actions = rule_actions(core)
    assert (actions[0], actions[9]) == (1, 0)
    assert set(actions[1:9]) == {1}, "slots without a car brake"


def test_rule_yields_to_the_lower_id_with_the_same_next_cell():
    for low, high in ((0, 1), (4, 7)):
        for entries in ((TOP, EAST), (EAST, TOP)):
            core = quiet_core()
            cells = {TOP: 5, EAST: 6}
            put(core, low, entries[0], STRAIGHT, cells[entries[0]])
            put(core, high, entries[1], STRAIGHT, cells[entries[1]])
            actions = rule_actions(core)
            assert (actions[low], actions[high]) == (0, 1)


def test_rule_lets_the_lowest_id_leave_a_shared_entry():
    core = quiet_core()
    for slot, turn in ((2, LEFT), (5, RIGHT), (8, STRAIGHT)):
        put(core, slot, WEST, turn, 0)
    actions = rule_actions(core)
    assert [actions[slot] for slot in (2, 5, 8)] == [0, 1, 1]


def test_rule_ignores_neighbours_with_other_ways():
    core = quiet_core()
    put(core, 0, TOP, STRAIGHT, 3)
    put(core, 1, BOTTOM, STRAIGHT, 10)  # Beside the first car, in the opposite direction
    actions = rule_actions(core)
    assert actions[:2] == [0, 0]


@pytest.mark.parametrize("order", ["commnet", "ic3net"])
@pytest.mark.parametrize("level", ["easy", "medium", "hard"])
def test_rule_from_observations_equals_the_rule_from_the_state_until_a_collision(level, order):
    core = quiet_core(32, level=level, order=order)
    core.set_arrival_rate(0.2)
    core.reset()
    policy = RulePolicy(level=level)
    roads, n_cars = core.layout, core.n_cars
    compared = braked = 0
    for _ in range(core.max_steps):
        obs, visible, _ = observe(core)
        actions = np.stack(list(policy({f"car_{i}": values for i, values in enumerate(obs)}).values()), axis=1)
        cell, target = roads.cell[core.place], roads.next_cell[core.place]
        in_the_way = visible & (cell[:, None, :] == target[:, :, None])
        lower = np.arange(n_cars)[None, :] < np.arange(n_cars)[:, None]
        same = visible & lower & (target[:, None, :] == target[:, :, None]) & (target[:, :, None] >= 0)
        expected = ~core.on_road | (in_the_way | same).any(axis=2)
        intact = core.n_collisions == 0
        np.testing.assert_array_equal(actions[intact], expected[intact])
        compared += core.on_road[intact].sum()
        braked += (expected & core.on_road)[intact].sum()
        core.step(actions)
    assert compared > 500 and braked > 50


def test_evaluation_is_reproducible_and_counts_what_it_says():
    first = evaluate_junction_policy(all_gas, 65, seed=3, n_envs=16, level="easy")
    assert first.episodes == 80, "every copy plays the same number"
    assert first == evaluate_junction_policy(all_gas, 65, seed=3, n_envs=16, level="easy")
    assert first.success_rate == success_rate(all_gas, 65, seed=3, n_envs=16, level="easy")
    assert first != evaluate_junction_policy(all_gas, 65, seed=4, n_envs=16, level="easy")
    empty = evaluate_junction_policy(all_gas, 4, n_envs=4, arrival_rate=0.0)
    assert (empty.success_rate, empty.occupancy, empty.visible, empty.mean_return) == (1.0, 0.0, 0.0, 0.0)
    with pytest.raises(ValueError, match="episodes=0"):
        evaluate_junction_policy(all_gas, 0)


def test_random_policy_is_seeded_and_even():
    obs = {f"car_{i}": np.zeros((500, 3)) for i in range(4)}
    first, second = RandomPolicy(1)(obs), RandomPolicy(1)(obs)
    assert all(np.array_equal(first[agent], second[agent]) for agent in obs)
    assert 0.44 < np.mean(list(first.values())) < 0.56
    assert set(all_gas(obs)["car_0"]) == {0} and set(all_brake(obs)["car_0"]) == {1}
