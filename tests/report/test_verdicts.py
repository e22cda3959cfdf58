# The ends of an interval may be None, and a test that meets one fails
# mypy: disable-error-code="operator, index, arg-type, union-attr, call-arg, misc"

import numpy as np
import pytest
from scipy import stats

from sb3_belief.report.statistics import IntervalEstimate, estimate
from sb3_belief.report.verdicts import (
    compare_overall,
    compare_with_baseline,
    holm,
    permutation_p_value,
    probability_of_improvement,
    seeds_needed,
    verdict,
)


def arrays(*rows):
    return [np.array(row, dtype=float) for row in rows]


def test_ties_count_half_and_environments_count_alike():
    assert probability_of_improvement(arrays([1, 2]), arrays([1, 0, 2])).value == pytest.approx((0.5 + 1 + 1 + 1 + 0.5) / 6)
    one_of_two = probability_of_improvement(arrays([1, 2], [0, 0, 0]), arrays([0, 0], [0, 0]))
    assert one_of_two.value == 0.75 and one_of_two.n_seeds == 2
    assert probability_of_improvement(arrays([5, 6, 7]), arrays([1, 2, 3]))[:3] == (1.0, 1.0, 1.0)
    assert probability_of_improvement(arrays([5]), arrays([1, 2])).low is None
    wide = probability_of_improvement(arrays([1, 2, 6]), arrays([3, 4, 5]))
    assert 0 <= wide.low < wide.value < wide.high <= 1
    with pytest.raises(ValueError, match="One arm has scores in 1 environments and the other in 2"):
        probability_of_improvement(arrays([1]), arrays([1], [2]))


def test_the_p_value_is_that_of_mann_and_whitney():
    rng = np.random.default_rng(0)
    x, y = rng.normal(0.8, 1, 6), rng.normal(0, 1, 5)
    assert permutation_p_value([x], [y]) == pytest.approx(stats.mannwhitneyu(x, y, method="exact").pvalue, rel=1e-9)
    # The smallest that so many seeds allow
    for n_seeds, smallest in [(3, 0.1), (4, 2 / 70), (5, 2 / 252)]:
        assert permutation_p_value(arrays(range(n_seeds)), arrays(range(10, 10 + n_seeds))) == pytest.approx(smallest)
    # Success rates that tie: all deals of three ones among six runs
    assert permutation_p_value(arrays([1, 1, 1]), arrays([0, 0, 0])) == pytest.approx(0.1)
    assert permutation_p_value(arrays([1, 1]), arrays([1, 1])) == 1.0
    assert permutation_p_value(arrays([1]), arrays([0, 0])) is None


def test_several_environments_are_dealt_independently():
    # In each two deals of six are as extreme; that both are so in one direction: 2 / 36
    assert permutation_p_value(arrays([3, 4], [3, 4]), arrays([1, 2], [1, 2])) == pytest.approx(2 / 36, abs=0.01)
    assert permutation_p_value(arrays([3, 4], [1, 2]), arrays([1, 2], [3, 4])) == 1.0


def test_p_values_of_arms_that_are_alike_are_rarely_small():
    rng = np.random.default_rng(1)
    values = [
        permutation_p_value([rng.normal(size=5) for _ in range(2)], [rng.normal(size=5) for _ in range(2)], 500)
        for _ in range(200)
    ]
    # A standard error of 1.5 %
    assert 0.005 <= np.mean(np.array(values) <= 0.05) <= 0.095


def test_holms_correction():
    # Holm: 4 * 0.01, 3 * 0.02 -> 0.06, 2 * 0.03 -> 0.06, 0.5
    assert holm([0.5, 0.01, 0.03, 0.02]) == pytest.approx([0.5, 0.04, 0.06, 0.06])
    assert holm([None, 0.4, 0.6]) == [None, 0.8, 0.8]
    assert holm([]) == [] and holm([0.03]) == [0.03]


@pytest.mark.parametrize(
    ("ours", "theirs", "expected"),
    [
        ((5, 4, 6), (2, 1, 3.9), "better"),
        ((2, 1, 3.9), (5, 4, 6), "worse"),
        ((5, 4, 6), (2, 1, 4), "undecided"),
        ((5, None, None), (2, 1, 3), "undecided"),
        ((1, 1, 1), (1, 1, 1), "undecided"),
    ],
)
def test_only_disjoint_intervals_decide(ours, theirs, expected):
    assert verdict(IntervalEstimate(*ours, 3), IntervalEstimate(*theirs, 3)) == expected


def test_seeds_needed_follow_its_formula():
    # Half-widths of 2 with 5 seeds, 1 apart: (2 + 2) * t(n - 1) / t(4) * sqrt(5 / n) < 1
    ours, theirs = IntervalEstimate(1.0, -1.0, 3.0, 5), IntervalEstimate(0.0, -2.0, 2.0, 5)
    n_seeds = seeds_needed(ours, theirs)

    def facing(n):
        return 4 * stats.t.ppf(0.975, n - 1) / stats.t.ppf(0.975, 4) * np.sqrt(5 / n)

    assert facing(n_seeds) < 1 <= facing(n_seeds - 1)
    assert seeds_needed(theirs, ours) == n_seeds
    # With more environments few seeds are less of a handicap now, so more are needed for the same widths
    assert seeds_needed(ours, theirs, n_environments=4) > n_seeds
    assert seeds_needed(ours, ours) is None
    assert seeds_needed(IntervalEstimate(9.0, 8.0, 10.0, 5), theirs) is None
    assert seeds_needed(IntervalEstimate(9.0, None, None, 1), theirs) is None


@pytest.mark.parametrize("n_environments", [1, 3])
def test_about_every_second_study_of_the_size_that_is_said_decides(n_environments):
    # A pilot whose spread and difference are the true ones: the quantiles of the distribution
    pilot = stats.norm.ppf((np.arange(10) + 0.5) / 10)
    shift = 0.7 / np.sqrt(n_environments)
    ours, theirs = ([pilot + move] * n_environments for move in (shift, 0.0))
    n_seeds = seeds_needed(estimate(ours), estimate(theirs), n_environments)
    assert n_seeds is not None and 15 < n_seeds < 120
    rng = np.random.default_rng(2)

    def decided(n):
        found = 0
        for _ in range(40):
            x, y = ([rng.normal(move, 1, n) for _ in range(n_environments)] for move in (shift, 0.0))
            found += verdict(estimate(x, n_resamples=500), estimate(y, n_resamples=500)) == "better"
        return found / 40

    assert 0.25 <= decided(n_seeds) <= 0.75
    assert decided(4 * n_seeds) > 0.95
    assert decided(n_seeds // 3) < 0.25


RNG = np.random.default_rng(4)
SCORES = {
    environment: {
        arm: {seed: float(RNG.normal(mean, 1.0)) * scale for seed in range(5)}
        for arm, mean in [("ippo", 0.0), ("dynamic", 8.0), ("static", 0.3)]
    }
    for environment, scale in [("a", 1.0), ("b", 100.0)]
}


def test_arms_are_compared_with_the_baseline_in_each_environment():
    found = compare_with_baseline(SCORES, "ippo")
    assert list(found) == ["a", "b"]
    for environment, comparisons in found.items():
        assert [each.arm for each in comparisons] == ["dynamic", "static"]
        dynamic, static = comparisons
        assert dynamic.verdict == "better" and dynamic.seeds_needed is None
        assert static.verdict == "undecided"
        assert dynamic.improvement.value == 1.0
        assert dynamic.p_value == pytest.approx(2 / 252) and dynamic.p_holm == pytest.approx(4 / 252)
        values = list(SCORES[environment]["ippo"].values())
        assert dynamic.baseline == static.baseline == estimate(arrays(values))
    # Ranks and verdicts do not depend on the unit
    assert [each.verdict for each in compare_with_baseline(SCORES, "dynamic")["b"]] == ["worse", "worse"]


def test_arms_are_compared_over_all_environments_that_have_them():
    dynamic, static = compare_overall(SCORES, "ippo")
    assert (dynamic.arm, dynamic.verdict, static.arm, static.verdict) == ("dynamic", "better", "static", "undecided")
    assert 0 <= dynamic.baseline.value < dynamic.estimate.value <= 1
    assert dynamic.p_value < 0.001 and dynamic.p_holm == pytest.approx(2 * dynamic.p_value)
    fewer = {"a": SCORES["a"], "b": {"ippo": SCORES["b"]["ippo"]}}
    assert [each.p_value for each in compare_overall(fewer, "ippo")] == [
        each.p_value for each in compare_with_baseline(fewer, "ippo")["a"]
    ]
    assert compare_overall({"a": {"x": {0: 1.0}}, "b": {"y": {0: 1.0}}}, "x") == []


def test_intervals_of_success_rates_end_at_one():
    scores = {"a": {"ippo": {0: 0.1, 1: 0.5, 2: 0.4}, "dynamic": {0: 0.7, 1: 1.0, 2: 1.0}}}
    (found,) = compare_with_baseline(scores, "ippo", limits=(0.0, 1.0))["a"]
    (over_all,) = compare_overall(scores, "ippo", bounds={"a": (0.0, 1.0)}, limits=(0.0, 1.0))
    assert found == over_all and found.estimate.high == 1.0 and found.baseline.low == 0.0


def test_few_seeds_and_unknown_baselines():
    scores = {"a": {"ippo": {0: 1.0}, "dynamic": {0: 2.0}}}
    (only,) = compare_with_baseline(scores, "ippo")["a"]
    assert only.verdict == "undecided" and only.seeds_needed is only.p_value is only.p_holm is None
    assert only.estimate == IntervalEstimate(2.0, None, None, 1) and only.improvement.value == 1.0
    for compare in (compare_with_baseline, compare_overall):
        with pytest.raises(ValueError, match="The baseline 'wide' has no scores; there are ippo, dynamic"):
            compare(scores, "wide")
