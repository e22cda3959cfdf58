# The ends of an interval may be None, and a test that meets one fails
# mypy: disable-error-code="operator, index, arg-type, union-attr, call-arg, misc"

import numpy as np
import pytest

from sb3_belief.report.bands import efficiency_curve, overall_curves, performance_profiles, pooled_mean
from sb3_belief.report.statistics import estimate
from tests.report.peers import REFERENCE, check_interval

RNG = np.random.default_rng(0)


def test_an_efficiency_curve_has_the_estimate_of_each_evaluation():
    values = RNG.normal(size=(5, 3))
    band = efficiency_curve(np.array([10, 20, 30]), values)
    np.testing.assert_array_equal(band.x, [10, 20, 30])
    for index in range(3):
        alone = estimate([values[:, index]])
        assert (band.values[index], band.low[index], band.high[index]) == pytest.approx(alone[:3], rel=1e-9)
    assert band.n_seeds == 5


def test_evaluations_that_a_seed_has_not_had_are_left_out():
    values = np.array([[1.0, 2.0, np.nan], [3.0, 4.0, 5.0]])
    band = efficiency_curve(np.array([10, 20, 30]), values)
    np.testing.assert_array_equal(band.x, [10, 20])
    np.testing.assert_array_equal(band.values, [2.0, 3.0])
    for empty in (
        efficiency_curve(np.array([10]), np.array([[1.0], [np.nan]])),
        efficiency_curve(np.array([]), np.empty((3, 0))),
    ):
        assert len(empty.x) == len(empty.values) == len(empty.low) == 0
    single = efficiency_curve(np.array([10, 20]), np.array([[1.0, 2.0]]))
    limited = efficiency_curve(np.array([10]), np.array([[0.0], [1.0], [1.0]]), limits=(0.0, 1.0))
    assert (limited.low, limited.high) == (0.0, 1.0)
    assert single.low is single.high is None and single.n_seeds == 1


def test_overall_curves_are_over_the_share_of_the_training():
    # Straight lines, normalised: in "short" from 0 to 1 over the 100 steps that all have, in "long" over 1,000 steps
    seeds = [0, 1]
    short = np.array([0, 50, 100, 150]), np.array([[0.0, 5.0, 10.0, 90.0]] * 2), seeds
    long = np.array([250, 1000]), np.array([[-3.0, -0.0]] * 2), seeds
    unfinished = np.array([0, 100, 200]), np.array([[0.0, 10.0, 99.0], [0.0, 10.0, np.nan]]), seeds
    curves = {"short": {"x": short, "y": unfinished}, "long": {"x": long, "y": long}, "other": {"x": long}}
    found = overall_curves(curves, {"short": (0.0, 10.0), "long": (-4.0, 0.0)}, n_points=5)
    for arm in ("x", "y"):
        np.testing.assert_allclose(found[arm].x, [0.25, 0.5, 0.75, 1.0])
        np.testing.assert_allclose(found[arm].values, [0.25, 0.5, 0.75, 1.0])
        # Both seeds are alike
        np.testing.assert_allclose(found[arm].low, found[arm].values)
    assert overall_curves({"a": {"x": long}, "b": {"y": long}}, {}) == {}


def test_profiles_are_shares_of_runs_above_thresholds():
    scores = {
        "a": {"x": {0: 0.0, 1: 0.5}, "y": {0: 0.2, 1: 0.4}},
        "b": {"x": {0: 1.0, 1: 0.5}, "y": {0: 0.9, 1: 1.0}},
        "c": {"x": {0: 0.0}},
    }
    found = performance_profiles(scores, [0.0, 0.45, 0.5, 1.0])
    np.testing.assert_array_equal(found["x"].values, [0.75, 0.75, 0.25, 0.0])
    np.testing.assert_array_equal(found["y"].values, [1.0, 0.5, 0.5, 0.0])
    assert (found["x"].low >= 0).all() and (found["x"].high <= 1).all() and found["x"].low[0] < 0.75 < found["x"].high[0]
    default = performance_profiles(scores)["x"]
    assert (len(default.x), default.x[0], default.x[-1]) == (101, 0.0, 1.0)
    assert performance_profiles({"a": {"x": {0: 1.0}}, "b": {"y": {0: 1.0}}}) == {}


@pytest.mark.parametrize("name", REFERENCE["cases"])
def test_profiles_are_those_of_rliable(name):
    case = REFERENCE["cases"][name]
    for arm, expected in case["profiles"].items():
        scores = {str(task): {arm: dict(enumerate(values))} for task, values in enumerate(case["scores"][arm])}
        ours = performance_profiles(scores, REFERENCE["thresholds"])[arm]
        np.testing.assert_allclose(ours.values, expected["values"], rtol=1e-12)
        above = [(np.array(values) > np.array(REFERENCE["thresholds"])[:, None]) * 1.0 for values in case["scores"][arm]]
        check_interval(expected["bands"], above, pooled_mean)
