import json

import numpy as np
import pytest

from sb3_belief.report.figures.curves import Curve, curves_spec
from sb3_belief.report.figures.intervals import Interval, intervals_spec
from sb3_belief.report.figures.theme import DARK, LIGHT, arm_colours, arm_dashes, in_file, on_page, still

vl_convert = pytest.importorskip("vl_convert", reason="figures are drawn by vl-convert-python")
ARMS = ["ippo", "dynamic", "<b>"]
COLOURS, DASHES = arm_colours(ARMS, "ippo"), arm_dashes(ARMS, "ippo")


def curve_spec():
    seeds: dict = {0: [0.1, np.nan], 1: [0.3, 0.5]}
    curves = {arm: Curve([1000, 2000], [0.2, 0.4], [0.1, 0.3], [0.3, np.inf], seeds) for arm in ARMS}
    return curves_spec("A & B", curves, COLOURS, DASHES, y_title="success rate", y_domain=(0, 1), mark=0.25)


def interval_spec():
    return intervals_spec("P", {arm: Interval(0.5, 0.4, 0.6, {0: 0.45}) for arm in ARMS}, COLOURS, "P", (0, 1), mark=0.5)


def test_the_data_are_the_curve():
    spec = curve_spec()
    centres = [row for row in spec["datasets"]["centres"] if row["arm"] == "dynamic"]
    # What is not finite is a gap
    assert centres == [{"arm": "dynamic", "x": [1000, 2000], "y": [0.2, 0.4], "low": [0.1, 0.3], "high": [0.3, None]}]
    seeds = [(row["seed"], row["x"], row["y"]) for row in spec["datasets"]["seeds"] if row["arm"] == "ippo"]
    assert seeds == [("0", [1000, 2000], [0.1, None]), ("1", [1000, 2000], [0.3, 0.5])]
    json.dumps(spec, allow_nan=False)


@pytest.mark.parametrize("make", [curve_spec, interval_spec])
def test_files_have_colours_and_nothing_that_moves(make):
    spec = in_file(make())
    text = json.dumps(spec)
    assert "var(" not in text and '"param' not in text and "hidden" not in text and LIGHT["--arm-0"] in text
    assert not any(layer.get("name") == "hover" for layer in spec["layer"])
    dark = json.dumps(in_file(make(), DARK))
    assert DARK["--arm-1"] in dark and LIGHT["--arm-1"] not in dark
    svg = vl_convert.vegalite_to_svg(spec)
    assert spec["title"].replace("&", "&amp;") in svg and "<b>" not in svg and "&lt;b&gt;" in svg and "undefined" not in svg


@pytest.mark.parametrize("make", [curve_spec, interval_spec])
def test_the_page_s_figures_compile_and_answer_to_the_pointer(make):
    spec = on_page(make())
    assert "title" not in spec and spec["width"] == "container"
    vega = vl_convert.vegalite_to_vega(spec)
    assert {signal["name"] for signal in vega["signals"]} >= {"hidden"}
    assert vega.get("legends", []) == []
    still_text = json.dumps(still(make()))
    assert "near" not in still_text and json.dumps(make()) == json.dumps(make())


def test_the_baseline_is_grey_and_many_arms_differ_by_their_dashes():
    arms = [f"arm {i}" for i in range(30)]
    colours, dashes = arm_colours(arms, "arm 3"), arm_dashes(arms, "arm 3")
    assert colours["arm 3"] == "var(--arm-0)" and "var(--arm-0)" not in [colours[arm] for arm in arms if arm != "arm 3"]
    assert len({(colours[arm], tuple(dashes[arm])) for arm in arms}) == 30
    assert list(colours) == arms


def luminance(colour):
    parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@pytest.mark.parametrize("colours", [LIGHT, DARK], ids=["light", "dark"])
def test_colours_can_be_told_from_the_ground(colours):
    ground = luminance(colours["--ground"])
    for name, colour in colours.items():
        lights = sorted([luminance(colour), ground])
        contrast = (lights[1] + 0.05) / (lights[0] + 0.05)
        # WCAG 2.2: 4.5 for text, 3 for what a figure is made of. Grids only help
        if name not in ("--ground", "--line"):
            assert contrast >= (4.5 if "ink" in name else 3), name
