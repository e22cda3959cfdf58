"""The returns that policies with and without a memory reach in the aisles."""

import pytest

from sb3_belief.envs.aisle_sides.config import LEFT, MIDDLE, RIGHT
from sb3_belief.envs.aisle_sides.policies import KeepSide, KnowConvention, Remember, evaluate_aisle_policy

KINDS = {"kinds": 4}
PER_COPY = {"redraw_unit": "episodes", "per_copy": True}


def result(policy, episodes=600, **kwargs):
    return evaluate_aisle_policy(policy, episodes, n_envs=60, **kwargs)


@pytest.mark.parametrize("kwargs", [{}, KINDS, {**KINDS, "held_out": True}, {"n_robots": 2}])
def test_who_knows_is_never_held_up(kwargs):
    told = {**kwargs, "reveal_partner": True}
    found = result(KnowConvention(**told), 60, **told)
    # 40 steps through aisles of 8 cells
    assert found.mean_return == pytest.approx(5.0) and found.jams == 0 and found.meetings == pytest.approx(4.95, abs=0.05)


@pytest.mark.parametrize("side", [LEFT, RIGHT])
# Who is wrong in all meetings has fewer of them, and thus a smaller share
@pytest.mark.parametrize("kwargs, jams, expected", [(PER_COPY, 0.38, 3.7), ({**KINDS, **PER_COPY}, 0.49, 3.4)])
def test_a_guess_is_wrong_half_the_time(side, kwargs, jams, expected):
    found = result(KeepSide(side), 1800, **kwargs)
    assert found.jams == pytest.approx(jams, abs=0.06) and found.mean_return == pytest.approx(expected, abs=0.1)


def test_who_waits_gets_nowhere():
    found = result(KeepSide(MIDDLE), 60)
    assert found.meetings == 0 and found.mean_return < 0.6


@pytest.mark.parametrize(
    "span, kwargs, expected",
    [
        ("copy", PER_COPY, 4.91),
        ("copy", {**KINDS, **PER_COPY}, 4.70),
        ("copies", {"redraw_every": 1}, 4.71),
        ("copies", KINDS, 4.93),
    ],
)
def test_what_an_ideal_memory_is_worth(span, kwargs, expected):
    found = result(Remember(span, **kwargs), 1800, **kwargs)
    assert found.mean_return == pytest.approx(expected, abs=0.1)


def test_a_memory_of_the_rollout_before_is_one_rollout_late():
    # Of this seed the first convention is to keep right, and who has seen nothing keeps left
    rules = {"redraw_every": None, "partner_seed": 1}
    first = result(KeepSide(LEFT), 60, **rules).mean_return
    assert first < 3 and result(KeepSide(RIGHT), 60, **rules).mean_return == pytest.approx(5.0)
    assert result(Remember("rollout", **rules), 60, **rules).mean_return == first
    late = result(Remember("rollout", **rules), 240, **rules)
    assert late.mean_return == pytest.approx((first + 3 * 5) / 4, abs=1e-6)
    # Where each rollout has another convention, nothing that it remembers is of use
    rules = {"redraw_every": 1}
    assert result(Remember("rollout", **rules), 240, **rules) == result(KeepSide(LEFT), 240, **rules)


def test_a_memory_of_one_copy_does_not_see_the_others():
    alone = result(Remember("copy", redraw_every=1), 1200, redraw_every=1).mean_return
    together = result(Remember("copies", redraw_every=1), 1200, redraw_every=1).mean_return
    assert alone < together - 0.05


def test_arguments_that_are_refused():
    with pytest.raises(ValueError, match="pass reveal_partner=True"):
        KnowConvention()
    with pytest.raises(ValueError, match="span='ever' is not one of"):
        Remember("ever")
    with pytest.raises(ValueError, match="needs per_copy=False"):
        Remember("rollout", **PER_COPY)
    with pytest.raises(ValueError, match="episodes=0 must be at least 1"):
        evaluate_aisle_policy(KeepSide(), 0)
