"""Cultures: what scripted cars do by them, in scenes that are set by hand, and what hand rules of the learner bring."""

from typing import Any

import numpy as np
import pytest

from sb3_belief.envs.junction_cultures.config import CultureConfig
from sb3_belief.envs.junction_cultures.core import CultureCore
from sb3_belief.envs.junction_cultures.policies import Yields, evaluate_culture_rule, follows_culture, follows_reverse
from sb3_belief.envs.traffic_junction.core import BRAKE, GAS
from tests.envs.traffic_junction.scenarios import BOTTOM, EAST, STRAIGHT, TOP, WEST, put

EACH: dict[str, Any] = {"redraw_unit": "episodes", "per_copy": True, "redraw_every": 1}


def scene(culture, **kwargs):
    """Return one empty junction of a culture, into which nobody else comes."""
    config = CultureConfig(redraw_every=None, arrival_rate=0.0, **kwargs)
    core = CultureCore(1, config)
    core.seed(0, 0)
    core.reset()
    core.types.current[:] = config.names.index(culture)
    return core


def do(core, action=GAS):
    """Return what all cars do at a step in which the learner does this."""
    core.observe()
    core.step(np.array([action]))
    return core.actions[0].tolist()


@pytest.mark.parametrize("cultures", ["axes", "orders"])
def test_names_and_ranks(cultures):
    config = CultureConfig(cultures=cultures)
    # Entries are numbered clockwise from the upper one
    ranks = dict(zip(config.names, config.priorities.tolist(), strict=True))
    if cultures == "axes":
        assert ranks == {"NS-EW": [0, 1, 0, 1], "EW-NS": [1, 0, 1, 0]} and not any(config.held_out_cultures)
    else:
        assert len(ranks) == 24 and ranks["S-W-N-E"] == [2, 3, 0, 1]
        held_out = {name for name, out in zip(config.names, config.held_out_cultures, strict=True) if out}
        assert len(held_out) == 8 and {"-".join(reversed(name.split("-"))) for name in held_out} == held_out
        drawn = CultureConfig(cultures=cultures, held_out=True).weights
        assert [weight == 1 for weight in drawn] == config.held_out_cultures
    assert CultureConfig(level="easy", cultures="orders").names == ["N-W", "W-N"]


def crossing_cars(core, first, second):
    """Put two cars one cell before the cell in which their straight ways cross."""
    layout = core.traffic.layout
    paths = [layout.routes[layout.entry_routes[entry][STRAIGHT]] for entry in (first[1], second[1])]
    shared = next(cell for cell in paths[0] if cell in paths[1])
    for (slot, entry), path in zip((first, second), paths, strict=True):
        put(core.traffic, slot, entry, STRAIGHT, path.index(shared) - 1)


@pytest.mark.parametrize(
    "culture, cultures, goes",
    [("NS-EW", "axes", 4), ("EW-NS", "axes", 7), ("S-W-N-E", "orders", 7), ("N-E-S-W", "orders", 4)],
)
def test_who_comes_from_an_entry_of_higher_rank_goes_first(culture, cultures, goes):
    core = scene(culture, cultures=cultures)
    crossing_cars(core, (4, TOP), (7, WEST))
    actions = do(core)
    assert {slot for slot in (4, 7) if actions[slot] == GAS} == {goes}


@pytest.mark.parametrize("culture, goes", [("NS-EW", 7), ("EW-NS", 4)])
def test_numbers_of_slots_count_between_equal_ranks_only(culture, goes):
    core = scene(culture)
    crossing_cars(core, (7, TOP), (4, EAST))
    actions = do(core)
    assert {slot for slot in (4, 7) if actions[slot] == GAS} == {goes}
    core = scene(culture)
    for slot in (7, 4):
        put(core.traffic, slot, BOTTOM, STRAIGHT, 0)
    actions = do(core)
    assert (actions[4], actions[7]) == (GAS, BRAKE)


def test_a_car_brakes_for_one_in_its_next_cell_and_the_learner_does_what_it_wants():
    core = scene("NS-EW")
    put(core.traffic, 0, TOP, STRAIGHT, 4)
    put(core.traffic, 3, TOP, STRAIGHT, 3)
    assert do(core, BRAKE)[:4] == [BRAKE, BRAKE, BRAKE, BRAKE]
    assert do(core, GAS)[0] == GAS
    assert core.saw[0].tolist() == [False, False, True] + [False] * 6


@pytest.mark.parametrize(
    "rule, rules, expected, episodes",
    [
        (follows_culture, {}, -1.82, 1536),
        (Yields(0.7), {}, -2.76, 1536),
        (Yields(), {}, -4.68, 1536),
        # Whose returns vary more
        (Yields(0), {}, -5.00, 8192),
        (follows_reverse, {}, -6.90, 8192),
        (follows_culture, {"cultures": "orders"}, -1.93, 1536),
        (follows_culture, {"level": "easy"}, -0.90, 1536),
    ],
)
def test_what_hand_rules_bring_in_a_life(rule, rules, expected, episodes):
    found = evaluate_culture_rule(rule, episodes, n_envs=256, **rules, **EACH).return_per_life
    assert found == pytest.approx(expected, abs=0.1)


@pytest.mark.parametrize(
    "kwargs, says",
    [
        ({"level": "hard"}, "level='hard' is not one of 'easy', 'medium'"),
        ({"cultures": "none"}, "cultures='none' is not one of 'axes', 'orders'"),
        ({"arrival_rate": 2}, "arrival_rate=2 must be a probability"),
        ({"vision": -1}, "vision=-1 must be an integer >= 0"),
        ({"reward_scale": 0}, "reward_scale=0 must be a positive number"),
        ({"held_out": True}, "no culture is held out there"),
        ({"redraw_unit": "episodes"}, "needs per_copy=True"),
    ],
)
def test_arguments_that_are_refused(kwargs, says):
    with pytest.raises(ValueError, match=says):
        CultureConfig(**kwargs)
    with pytest.raises(ValueError, match="episodes=0"):
        evaluate_culture_rule(follows_culture, 0)
