"""Figures of the trials of a tuning."""

import json

import pytest

from sb3_belief.report.figures.drawing import figure_svg
from sb3_belief.report.figures.trials import TrialPoint, evaluations_spec, objectives_spec, setting_spec

pytest.importorskip("vl_convert", reason="figures are drawn by vl-convert-python")

POINTS = [
    TrialPoint(0, "complete", 1.0, [[0.5, 1.0], [0.4, 1.0]], 0.001),
    TrialPoint(2, "pruned", 3.0, [[2.0, 2.0], [3.0]], 0.1),
    TrialPoint(3, "best", 2.0, [[1.0, 2.0], [1.5, 2.0]], 0.01),
    TrialPoint(4, "complete", 1.5, [[1.0, 1.5], [1.5, 1.5]], 0.01),
]


def layer(spec, name):
    (found,) = [each for each in spec["layer"] if each.get("name") == name]
    return found


def test_the_best_so_far_is_that_of_the_complete_trials():
    spec = objectives_spec("Objective", POINTS, "mean return")
    line = layer(spec, "best-so-far")["data"]["values"]
    assert [(row["trial"], row["value"]) for row in line] == [(0, 1.0), (3, 2.0), (4, 2.0)]
    assert {row["trial"]: row["arm"] for row in spec["datasets"]["trials"]}[2] == "pruned"
    # The best trial stands above the others
    assert spec["datasets"]["trials"][-1]["arm"] == "best"
    assert "mean return" in figure_svg(spec)
    (alone,) = objectives_spec("Objective", POINTS[1:2], "mean return")["layer"]
    assert alone["name"] == "trials"


def test_runs_of_a_trial_stand_beside_each_other_and_pruned_ones_end_with_a_cross():
    spec = evaluations_spec("Evaluations", POINTS, "mean return")
    runs = {(row["trial"], row["run"]): (row["x"], row["y"]) for row in spec["datasets"]["runs"]}
    assert runs[0, 0] == ([1, 2], [0.5, 1.0]) and runs[0, 1] == ([3, 4], [0.4, 1.0]) and runs[2, 1] == ([3], [3.0])
    (end,) = layer(spec, "pruned")["data"]["values"]
    assert (end["trial"], end["x"], end["y"]) == (2, 3, 3.0)
    assert "one run after the other" in figure_svg(spec)
    single = evaluations_spec("Evaluations", [TrialPoint(0, "best", 1.0, [[1.0, float("nan")]])], "mean return")
    assert single["datasets"]["runs"][0]["y"] == [1.0, None]
    assert "one run after the other" not in json.dumps(single) and [each["name"] for each in single["layer"]] == [
        "lines",
        "hover",
    ]


def test_a_setting_s_axis_is_that_of_its_search():
    spec = setting_spec("learning_rate", POINTS, "mean return", ends=(0.001, 0.1), is_log=True)
    x = layer(spec, "trials")["encoding"]["x"]
    assert x["scale"]["type"] == "log" and x["scale"]["domain"] == [0.001, 0.1]
    figure_svg(spec)
    chosen = [TrialPoint(0, "best", 1.0, setting="[8]"), TrialPoint(1, "complete", 1.0)]
    spec = setting_spec("net_arch", chosen, "mean return", choices=["[8]", "[16, 16]"])
    assert layer(spec, "trials")["encoding"]["x"]["scale"]["domain"] == ["[8]", "[16, 16]"]
    # A trial of which nothing was drawn has no place
    assert [row["trial"] for row in spec["datasets"]["trials"]] == [0]
    svg = figure_svg(spec)
    assert "[16, 16]" in svg
    whole = setting_spec("n_epochs", [TrialPoint(0, "best", 1.0, setting=10)], "mean return", ends=(2, 10))
    assert ">10<" in figure_svg(whole)
