import numpy as np
import pytest

pa = pytest.importorskip("pyarrow", reason="tables of episodes need pyarrow")
pytest.importorskip("scipy", reason="statistics need scipy")

from sb3_belief.report.bands import efficiency_curve, overall_curves, performance_profiles  # noqa: E402
from sb3_belief.report.episodes import EPISODES, curves, scores  # noqa: E402
from sb3_belief.report.statistics import estimates_by_environment, overall_estimates  # noqa: E402
from sb3_belief.report.study_page.facts import RunFacts, StudyFacts  # noqa: E402
from sb3_belief.report.study_page.findings import default_quantity, findings_of  # noqa: E402
from sb3_belief.report.study_page.sections import StudyPage  # noqa: E402
from sb3_belief.report.verdicts import compare_overall, compare_with_baseline  # noqa: E402

ENVIRONMENTS, ARMS, SEEDS, STEPS = ("junction", "forest"), ("ippo", "dynamic"), 4, (1000, 2000, 3000)
BOUNDS = {environment: (0.0, 1.0) for environment in ENVIRONMENTS}
LIMITS = (0.0, 1.0)


@pytest.fixture(scope="module")
def table():
    rng = np.random.default_rng(0)
    rows = []
    for environment in ENVIRONMENTS:
        for arm in ARMS:
            for seed in range(SEEDS):
                chance = 0.4 + 0.4 * (arm == "dynamic") + 0.05 * rng.standard_normal()
                common = {"study": "s", "arm": arm, "algorithm": arm, "environment": environment, "seed": seed, "length": 5}
                kinds = [("training", "current", True, steps) for steps in STEPS]
                kinds += [("final", checkpoint, greedy, 3000) for checkpoint in ("last", "best") for greedy in (True, False)]
                for phase, checkpoint, greedy, steps in kinds:
                    for episode, won in enumerate(rng.random(40) < chance):
                        kind = {"phase": phase, "checkpoint": checkpoint, "deterministic": greedy, "joint_steps": steps}
                        scored = {"episode": episode, "success": float(won), "episode_return": 10.0 * won}
                        rows.append({**common, **kind, **scored})
    return pa.Table.from_pylist(rows, schema=EPISODES)


@pytest.fixture(scope="module")
def findings(table):
    return findings_of(table, ARMS, "ippo")


def test_the_numbers_are_those_of_the_statistics(table, findings):
    of_best = scores(table, "success", "best")
    assert (findings.quantity, findings.checkpoint, list(findings.arms)) == ("success", "best", list(ARMS))
    estimates = estimates_by_environment(of_best, limits=LIMITS)
    compared = compare_with_baseline(of_best, "ippo", limits=LIMITS)
    for environment in ENVIRONMENTS:
        for arm in ARMS:
            found = findings.environments[environment][arm]
            assert (found.score, found.seeds) == (estimates[environment][arm], of_best[environment][arm])
        assert findings.environments[environment]["dynamic"].comparison == compared[environment][0]
        assert findings.environments[environment]["ippo"].comparison is None
    assert {arm: found.score for arm, found in findings.overall.items()} == overall_estimates(
        of_best, bounds=BOUNDS, limits=LIMITS
    )
    assert findings.overall["dynamic"].comparison == compare_overall(of_best, "ippo", bounds=BOUNDS, limits=LIMITS)[0]
    assert findings.overall["dynamic"].comparison.verdict == "better"
    assert findings.overall["ippo"].seeds["2, forest"] == of_best["forest"]["ippo"][2]


def test_the_curves_are_those_of_the_statistics(table, findings):
    steps, values, seeds = curves(table, "success")["forest"]["dynamic"]
    band, curve = efficiency_curve(steps, values, n_resamples=2000, limits=LIMITS), findings.curves["forest"]["dynamic"]
    for ours, theirs in ((curve.x, band.x), (curve.centre, band.values), (curve.low, band.low), (curve.high, band.high)):
        np.testing.assert_array_equal(ours, theirs)
    assert list(curve.seeds) == seeds
    np.testing.assert_array_equal(list(curve.seeds.values()), values)
    overall = overall_curves(curves(table, "success"), BOUNDS, n_resamples=2000, limits=LIMITS)
    np.testing.assert_array_equal(findings.overall_curves["ippo"].centre, overall["ippo"].values)
    profile = performance_profiles(scores(table, "success", "best"), n_resamples=2000)
    np.testing.assert_array_equal(findings.profiles["all environments"]["ippo"].centre, profile["ippo"].values)
    np.testing.assert_array_equal(findings.profiles["all environments"]["ippo"].low, profile["ippo"].low)


def test_other_ways_to_evaluate_are_all_there(table, findings):
    ways = {(each.environment, each.arm, each.checkpoint, each.deterministic): each.score for each in findings.others}
    assert len(ways) == 2 * 2 * 4
    of_last = estimates_by_environment(scores(table, "success", "last", False), limits=LIMITS)
    assert ways["junction", "dynamic", "last", False] == of_last["junction"]["dynamic"]


def test_what_there_is_decides_what_is_compared(table):
    training = table.filter(pa.compute.field("phase") == "training")
    assert findings_of(training, ARMS, None).checkpoint == "current" and findings_of(training, ARMS, None).others == []
    silent = training.set_column(11, EPISODES.field("success"), pa.array([None] * training.num_rows, pa.float64()))
    assert (default_quantity(table), default_quantity(silent)) == ("success", "return")
    assert findings_of(silent, ARMS, "ippo").unit == "return per episode"
    one = training.filter(pa.compute.field("environment") == "forest")
    assert findings_of(one, ARMS, "ippo").overall == {} and findings_of(one, ARMS, "lost").baseline is None
    empty = findings_of(EPISODES.empty_table(), ARMS, "ippo")
    assert (empty.environments, empty.arms) == ({}, [])


@pytest.fixture(scope="module")
def page(findings):
    from pathlib import Path

    runs = [
        RunFacts(
            arm,
            arm,
            environment,
            seed,
            "finished",
            Path(f"{arm}/{environment}_{seed}"),
            total_steps=3000,
            versions={"torch": "2"},
        )
        for environment in ENVIRONMENTS
        for arm in ARMS
        for seed in range(SEEDS)
    ]
    runs.append(RunFacts("dynamic", "dynamic", "forest", 9, "failed", Path("x"), counts=False, why_not="failed"))
    facts = StudyFacts("games", runs, True, 1000, 40, 40, {"Parts": ["dynamic", "ippo"]})
    return StudyPage(facts, findings, "Made today.", {}).page()


def test_the_page_s_tables_and_figures_hold_these_numbers(findings, page):
    tables = {table.name: table for table in page.tables()}
    rows = {(row["environment"], row["arm"]): row for row in tables["results"].rows}
    assert len(rows) == 6
    dynamic = findings.overall["dynamic"]
    row = rows["all environments", "dynamic"]
    assert (row["iqm"], row["interval"], row["verdict"]) == (dynamic.score.value, dynamic.score[1:3], "better")
    assert (row["improvement"], row["p_holm"]) == (dynamic.comparison.improvement.value, dynamic.comparison.p_holm)
    figures = {figure.name: figure.spec["datasets"] for figure in page.figures()}
    estimates = {each["arm"]: each for each in figures["scores-forest"]["estimates"]}
    assert estimates["dynamic"]["x"] == pytest.approx(findings.environments["forest"]["dynamic"].score.value, rel=1e-5)
    (ippo,) = [each for each in figures["learning-forest"]["centres"] if each["arm"] == "ippo"]
    np.testing.assert_allclose(ippo["y"], findings.curves["forest"]["ippo"].centre, rtol=1e-5)
    assert {"ablation-Parts-forest", "ablation-Parts-forest-learning", "profile-forest", "improvement-junction"} <= set(
        figures
    )
    assert len({figure.name for figure in page.figures()}) == len(page.figures())


def test_the_paragraph_can_be_quoted(page):
    for words in (
        *(
            "dynamic with ippo on junction and forest",
            "4 seeds each (16 runs of 3,000 joint steps)",
            "every 1,000 joint steps",
        ),
        *("over 40 episodes on seeds that neither the training nor those evaluations used", "interquartile means", "95 %"),
        *("better or worse than ippo where the two intervals are disjoint", "Holm", "PyTorch 2"),
    ):
        assert words in page.quote
    assert "dynamic" in page.lead and "better than ippo" in page.lead
    assert page.notices == ["1 run (failed) does not count: dynamic on forest, seed 9."]
