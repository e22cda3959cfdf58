"""Hidden types: when they change in each copy, and what decides which."""

import numpy as np
import pytest

from sb3_belief.envs.drawn_types import DrawnTypes, TypeRules


def played(rules, n_steps, length, weights=(1.0,) * 8, n_copies=3, seed=0):
    """Return the types of each step, int [n_steps, n_copies], with episodes of ``length`` steps."""
    types = DrawnTypes(n_copies, rules, weights)
    for copy in range(n_copies):
        types.seed(copy, seed + copy)
    seen = []
    for t in range(n_steps):
        seen.append(types.current.copy())
        done = (t + 1) % length == 0
        types.step(np.full(n_copies, done))
        if done:
            # The last observation belongs to the type that was played
            assert np.array_equal(types.current, seen[-1])
            types.update(range(n_copies))
    return np.array(seen)


def runs(column):
    """Return the lengths of runs of equal types, of which one may be a multiple of the schedule's."""
    return np.diff(np.flatnonzero(np.diff(column, prepend=-1)))


@pytest.mark.parametrize("length", [4, 6])
def test_types_change_with_rollouts_in_all_copies_at_once(length):
    seen = played(TypeRules(redraw_every=2, rollout_steps=6), 240, length)
    assert (seen == seen[:, :1]).all() and len(set(seen[:, 0])) > 4
    assert (runs(seen[:, 0]) % 12 == 0).all() and 12 in runs(seen[:, 0])
    other = played(TypeRules(redraw_every=2, rollout_steps=6, partner_seed=1), 240, length)
    assert (other != seen).any()
    # The copies' own seeds do not matter
    assert np.array_equal(seen, played(TypeRules(redraw_every=2, rollout_steps=6), 240, length, seed=9))


def test_types_change_with_episodes_in_each_copy_by_its_own_seed():
    rules = TypeRules(redraw_every=3, redraw_unit="episodes", per_copy=True)
    seen = played(rules, 300, 5)
    assert all((runs(column) % 15 == 0).all() and 15 in runs(column) for column in seen.T)
    assert (seen[:, 0] != seen[:, 1]).any()
    # Copy 1 of the one has the seed of copy 0 of the other
    assert np.array_equal(seen[:, 1], played(rules, 300, 5, seed=1)[:, 0])


def test_types_of_weight_0_and_those_that_never_change():
    seen = played(TypeRules(redraw_every=1, rollout_steps=1), 200, 5, weights=(0, 1, 0, 1))
    assert set(seen.ravel()) == {1, 3}
    assert len(set(played(TypeRules(redraw_every=None), 100, 5).ravel())) == 1


def test_a_state_goes_on_in_other_types():
    rules = TypeRules(redraw_every=1, redraw_unit="episodes", per_copy=True)
    first, second = DrawnTypes(1, rules, (1,) * 9), DrawnTypes(1, rules, (1,) * 9)
    for _ in range(3):
        first.step(np.array([True]))
    first.update([0])
    second.set_state(0, first.get_state(0))
    for _ in range(20):
        assert first.current.tolist() == second.current.tolist()
        for types in (first, second):
            types.step(np.array([True]))
            types.update([0])


def test_copies_without_a_seed_differ():
    rules = TypeRules(redraw_unit="episodes", per_copy=True)
    assert len(set(DrawnTypes(30, rules, (1,) * 50).current)) > 5


@pytest.mark.parametrize(
    "kwargs, says",
    [
        ({"redraw_every": 0}, "redraw_every, redraw_unit, per_copy and partner_seed are no schedule: redraw_every=0 must be"),
        ({"redraw_unit": "steps"}, "unit='steps' is not one of 'rollouts', 'episodes'"),
        ({"redraw_unit": "episodes"}, "needs per_copy=True"),
        ({"partner_seed": -1}, "seed=-1 must be an integer >= 0"),
        ({"per_copy": 1}, "per_copy=1 must be True or False"),
        ({"rollout_steps": 0}, "rollout_steps=0 must be an integer >= 1: the n_steps of the learner"),
        ({"held_out": 1}, "held_out=1 must be True or False"),
        ({"reveal_partner": "yes"}, "reveal_partner='yes' must be True or False"),
    ],
)
def test_rules_that_are_refused(kwargs, says):
    with pytest.raises(ValueError, match=says):
        TypeRules(**kwargs)
