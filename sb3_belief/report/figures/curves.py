"""Curves over joint steps and profiles over scores: lines with bands, and a thin line for each seed."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sb3_belief.report.figures.theme import SCHEMA

# In figures beside each other; a page makes them as wide as their place
WIDTH, HEIGHT = 420, 220
_SHOWN = "indexof(hidden, datum.arm) < 0"


@dataclass(frozen=True)
class Curve:
    """
    Curve of one arm.

    :param x: Where it has points, ``[k]``
    :param centre: Its height there, ``[k]``. NaN for a gap
    :param low: Lower end of its band, ``[k]``; None for no band
    :param high: Upper end of its band, ``[k]``; None for no band
    :param seeds: {seed, or name of another part: values ``[k]``}, thin lines. NaN where a seed has none
    """

    x: Sequence[float] | np.ndarray
    centre: Sequence[float] | np.ndarray
    low: Sequence[float] | np.ndarray | None = None
    high: Sequence[float] | np.ndarray | None = None
    seeds: Mapping[int | str, Sequence[float] | np.ndarray] = field(default_factory=dict)


def curves_spec(
    title: str,
    curves: Mapping[str, Curve],
    colours: Mapping[str, str],
    dashes: Mapping[str, Sequence[int]],
    x_title: str = "joint steps",
    y_title: str = "",
    y_domain: tuple[float, float] | None = None,
    x_format: str = "~s",
    mark: float | None = None,
    of_what: tuple[str, str] = ("algorithm", "seed"),
) -> dict[str, Any]:
    """
    Return a figure of curves. The pointer shows the seed and the value of the nearest point.

    :param title: Title
    :param curves: {arm: its curve}
    :param colours: Colour of each arm, of all arms of the page
    :param dashes: Dash of each arm
    :param x_title: Title of the x axis
    :param y_title: Title of the y axis
    :param y_domain: Ends of the y axis; None for those of the data
    :param x_format: Format of the numbers on the x axis, as d3 writes them
    :param mark: Height of a dashed horizontal line, such as that of chance; None for none
    :param of_what: What the lines are of, and the thin lines: words that stand before their names
    :return: The specification
    """
    centres, seeds = _rows(curves)
    arms = list(curves)
    color = {"field": "arm", "type": "nominal", "scale": {"domain": arms, "range": [colours[arm] for arm in arms]}}
    dash = {
        "field": "arm",
        "type": "nominal",
        "scale": {"domain": arms, "range": [list(dashes[arm]) for arm in arms]},
    }
    x = {
        "field": "x",
        "type": "quantitative",
        "title": x_title,
        "axis": {"format": x_format},
        "scale": {"nice": False, "zero": False},
    }
    scale: dict[str, Any] = {"zero": False} if y_domain is None else {"domain": list(y_domain), "nice": False, "clamp": False}

    def y(name: str) -> dict[str, Any]:
        return {"field": name, "type": "quantitative", "title": y_title, "scale": scale}

    layers: list[dict[str, Any]] = []
    if mark is not None:
        layers.append(
            {"data": {"values": [{"y": mark}]}, "mark": {"type": "rule", "strokeDash": [4, 4], "opacity": 0.6}}
            | {"encoding": {"y": {"field": "y", "type": "quantitative"}}}
        )
    shown, flat = [{"filter": _SHOWN}], {"flatten": ["x", "y"]}
    if any("low" in row for row in centres):
        layers.append(
            {
                "name": "band",
                "data": {"name": "centres"},
                "transform": [*shown, {"filter": "isValid(datum.low)"}, {"flatten": ["x", "low", "high"]}],
                "mark": {"type": "area", "opacity": 0.16, "clip": True},
                "encoding": {"x": x, "y": y("low"), "y2": {"field": "high"}, "color": color},
            }
        )
    if seeds:
        layers.append(
            {
                "name": "seeds",
                "data": {"name": "seeds"},
                "transform": [*shown, flat],
                "mark": {"type": "line", "clip": True},
                "encoding": {
                    "x": x,
                    "y": y("y"),
                    "color": color,
                    "detail": {"field": "seed", "type": "nominal"},
                    "opacity": {"condition": {"param": "near", "empty": False, "value": 1}, "value": 0.32},
                    "strokeWidth": {"condition": {"param": "near", "empty": False, "value": 1.8}, "value": 0.8},
                },
            }
        )
    layers.append(
        {
            "name": "centre",
            "data": {"name": "centres"},
            "transform": [*shown, flat],
            # Otherwise an arm with a single point would not be seen
            "mark": {"type": "line", "strokeWidth": 2.4, "clip": True, "point": _is_short(curves)},
            "encoding": {"x": x, "y": y("y"), "color": color, "strokeDash": dash},
        }
    )
    layers.append(_hover(x, y("y"), color, of_what if seeds else of_what[:1]))
    return {
        "$schema": SCHEMA,
        "title": title,
        "width": WIDTH,
        "height": HEIGHT,
        "params": [{"name": "hidden", "value": []}],
        "datasets": {"centres": centres, "seeds": seeds},
        "layer": layers,
        "resolve": {"scale": {"y": "shared"}},
    }


def rounded(value: float) -> float | None:
    """
    Return a number as a figure holds it, which no eye can tell from the number itself.

    :param value: The number
    :return: The number with six digits, or None, which is a gap, if it is not finite
    """
    return float(f"{value:.6g}") if math.isfinite(value) else None


def _rows(curves: Mapping[str, Curve]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return a row for each line, which Vega flattens: a page of many figures is then a fifth as large."""
    centres, seeds = [], []
    for arm, curve in curves.items():
        row = {"arm": arm, "x": _list(curve.x), "y": _list(curve.centre)}
        if curve.low is not None and curve.high is not None:
            row.update(low=_list(curve.low), high=_list(curve.high))
        centres.append(row)
        seeds += [{"arm": arm, "seed": str(seed), "x": row["x"], "y": _list(values)} for seed, values in curve.seeds.items()]
    return centres, seeds


def _list(values: Sequence[float] | np.ndarray) -> list[float | int | None]:
    found = [rounded(float(value)) for value in values]
    return [int(value) if value is not None and value.is_integer() else value for value in found]


def _is_short(curves: Mapping[str, Curve]) -> bool:
    return any(len(curve.x) < 3 for curve in curves.values())


def _hover(x: dict[str, Any], y: dict[str, Any], color: dict[str, Any], of_what: Sequence[str]) -> dict[str, Any]:
    fields = ["arm", "seed"][: len(of_what)]
    # Vega-Lite finds the nearest point by cells around all points, whose datum is the point; it forgets so for names
    row = "(datum.datum || datum)"
    lines = {word: f"{row}.{field}" for field, word in zip(fields, of_what, strict=True)}
    lines |= {x["title"]: f"format({row}.x, ',.6~g')", y["title"] or "value": f"format({row}.y, '.4~g')"}
    tooltip = "{" + ", ".join(f"{json.dumps(word)}: {value}" for word, value in lines.items()) + "}"
    return {
        "name": "hover",
        "data": {"name": "seeds" if "seed" in fields else "centres"},
        "transform": [{"filter": _SHOWN}, {"flatten": ["x", "y"]}, {"filter": "isValid(datum.y)"}],
        "params": [
            {
                "name": "near",
                "select": {
                    "type": "point",
                    "on": "pointerover",
                    "clear": "pointerout",
                    "nearest": True,
                    "fields": fields,
                },
            }
        ],
        "mark": {"type": "point", "filled": True, "size": 42, "opacity": 0},
        "encoding": {"x": x, "y": y, "color": color, "tooltip": {"value": {"expr": tooltip}}},
    }
