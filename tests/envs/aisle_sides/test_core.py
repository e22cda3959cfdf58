"""The rules of the aisles, step by step in scenes that are set by hand."""

import numpy as np
import pytest

from sb3_belief.envs.aisle_sides.config import (
    LEFT,
    MIDDLE,
    RIGHT,
    AisleConfig,
    convention_names,
    convention_sides,
    held_out_conventions,
)
from sb3_belief.envs.aisle_sides.core import NOBODY, AisleCore


def scene(position=2, other=NOBODY, convention=0, kind=0, **kwargs):
    """Return one aisle into which nobody else comes."""
    core = AisleCore(1, AisleConfig(redraw_every=None, **kwargs))
    core.seed(0, 0)
    core.reset()
    core.draws[:] = 1.0
    core.position[:], core.other[:], core.kind[:], core.types.current[:] = position, other, kind, convention
    return core


def do(core, action):
    """Return reward and where both robots are after a step of one robot."""
    rewards, _ = core.step(np.array([[action]]))
    return float(rewards[0, 0]), int(core.position[0, 0]), int(core.other[0, 0])


@pytest.mark.parametrize("action", [MIDDLE, LEFT, RIGHT])
def test_a_robot_drives_a_cell_per_step_whatever_it_does_and_begins_anew_at_the_end(action):
    core = scene(position=6)
    assert [do(core, action) for _ in range(3)] == [(0.125, 7, NOBODY), (0.125, 0, NOBODY), (0.125, 1, NOBODY)]
    assert core.other_action[0, 0] == MIDDLE


@pytest.mark.parametrize("gap", [1, 2])
@pytest.mark.parametrize("convention, side", [(0, LEFT), (1, RIGHT)])
def test_robots_on_the_same_side_pass_and_the_other_one_turns_off(gap, convention, side):
    core = scene(2, 2 + gap, convention)
    assert do(core, side) == (0.125, 3, 1 + gap)
    assert core.other_action[0, 0] == side
    assert do(core, MIDDLE) == (0.125, 4, NOBODY)


def test_a_wrong_guess_costs_jam_steps_in_which_actions_do_nothing():
    core = scene(2, 4, jam_steps=3)
    assert do(core, RIGHT) == (0.0, 2, 4)
    assert core.other_action[0, 0] == LEFT and core.jam[0, 0] == 3
    for _ in range(2):
        assert do(core, LEFT) == (0.0, 2, 4)
        assert core.other_action[0, 0] == MIDDLE
    # Three steps without a cell, and then the one that passing would have taken
    assert do(core, RIGHT) == (0.125, 3, 3)
    assert core.jam[0, 0] == 0


def test_who_waits_is_waited_for_and_learns_nothing():
    core = scene(2, 4)
    for _ in range(5):
        assert do(core, MIDDLE) == (0.0, 2, 4)
        assert core.other_action[0, 0] == MIDDLE
    assert do(core, LEFT) == (0.125, 3, 3)


def test_robots_further_apart_drive_towards_each_other_in_the_middle():
    core = scene(1, 6)
    assert not core.in_sight.any()
    assert do(core, LEFT) == (0.125, 2, 5)
    assert core.in_sight.all() and not core.facing.any() and core.other_action[0, 0] == MIDDLE
    assert not core.saw.any()
    assert do(core, RIGHT) == (0.125, 3, 4)
    assert core.saw.all() and core.facing.all() and core.other_action[0, 0] == MIDDLE


def test_what_others_do_can_be_hidden_and_changes_nothing_else():
    seen, hidden = scene(2, 3), scene(2, 3, others_visible=False)
    assert do(seen, LEFT) == do(hidden, LEFT)
    assert seen.saw.all() and not hidden.saw.any()
    np.testing.assert_array_equal(seen.observe(), hidden.observe())


@pytest.mark.parametrize("position, enters", [(0, True), (3, False), (7, True)])
def test_a_robot_enters_where_it_is_not_seen_yet(position, enters):
    core = scene(position, kinds=4)
    core.draws[0, 0, 0] = 0.69, 0.5
    do(core, MIDDLE)
    assert core.other[0, 0] == (7 if enters else NOBODY)
    assert not core.in_sight.any()
    if enters:
        assert core.kind[0, 0] == 2
    core = scene(position)
    core.draws[0, 0, 0, 0] = 0.71
    do(core, MIDDLE)
    assert core.other[0, 0] == NOBODY


def test_observations_part_by_part():
    core = scene(3, 5, convention=6, kind=2, kinds=3, reveal_partner=True)
    own, sight, kind = [3 / 7, 0], [0, 1, 0], [0, 0, 1]
    told = [1, 0]
    np.testing.assert_array_equal(core.observe()[0, 0], np.array(own + sight + kind + told, np.float32))
    # Convention 6 is RRL
    do(core, RIGHT)
    np.testing.assert_array_equal(core.observe()[0, 0], np.array([3 / 7, 1, *sight, *kind, *told], np.float32))
    np.testing.assert_array_equal(scene(3, 7).observe()[0, 0], np.array([3 / 7, 0, 0, 0, 0, 0], np.float32))
    # Whoever was passed is not seen any more
    core = scene(3, 5)
    do(core, LEFT)
    np.testing.assert_array_equal(core.observe()[0, 0], np.array([4 / 7, 0, 0, 0, 0, 0], np.float32))


def test_the_side_depends_on_the_kind():
    sides = convention_sides(4)[convention_names(4).index("LRRL")]
    assert sides.tolist() == [LEFT, RIGHT, RIGHT, LEFT]
    for kind, side in enumerate(sides):
        core = scene(2, 4, convention_names(4).index("LRRL"), kind, kinds=4)
        assert do(core, int(side))[0] == 0.125


@pytest.mark.parametrize("kinds, n_held_out", [(1, 0), (2, 0), (3, 2), (4, 4), (6, 16)])
def test_held_out_conventions_are_pairs_of_opposites(kinds, n_held_out):
    names, held_out = convention_names(kinds), held_out_conventions(kinds)
    assert len(set(names)) == len(held_out) == 2**kinds and held_out.sum() == n_held_out
    assert np.array_equal(held_out, held_out[::-1])
    sides = convention_sides(kinds)
    assert np.array_equal(sides[::-1], LEFT + RIGHT - sides)
    # Among those of training each kind keeps left as often as right
    assert ((sides[~held_out] == LEFT).mean(axis=0) == 0.5).all()


def test_an_episode_ends_at_its_limit():
    core = scene(max_steps=3)
    assert [bool(core.step(np.array([[MIDDLE]]))[1][0]) for _ in range(3)] == [False, False, True]
