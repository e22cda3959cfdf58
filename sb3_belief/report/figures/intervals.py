"""Dots with intervals: scores of arms, and the probability that one improves on another."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sb3_belief.report.figures.curves import WIDTH, rounded
from sb3_belief.report.figures.theme import SCHEMA

_ROW = 28


@dataclass(frozen=True)
class Interval:
    """
    Estimate of one arm.

    :param value: The estimate
    :param low: Lower end of its interval; None for no interval
    :param high: Upper end of its interval; None for no interval
    :param seeds: {seed, or a longer name of the run: its score}, small marks
    """

    value: float
    low: float | None = None
    high: float | None = None
    seeds: Mapping[int | str, float] = field(default_factory=dict)


def intervals_spec(
    title: str,
    intervals: Mapping[str, Interval],
    colours: Mapping[str, str],
    x_title: str,
    x_domain: tuple[float, float] | None = None,
    mark: float | None = None,
    order: Sequence[str] | None = None,
) -> dict[str, Any]:
    """
    Return a figure with a row for each arm: its estimate, the interval, and the scores of its seeds.

    :param title: Title
    :param intervals: {arm: its estimate}
    :param colours: Colour of each arm
    :param x_title: Title of the x axis
    :param x_domain: Ends of the x axis; None for those of the data
    :param mark: Place of a vertical line, such as that of no difference; None for none
    :param order: Arms from the top. None for the order of ``intervals``
    :return: The specification
    """
    arms = list(intervals if order is None else order)
    estimates = [
        {
            "arm": arm,
            "x": rounded(each.value),
            "low": None if each.low is None else rounded(each.low),
            "high": None if each.high is None else rounded(each.high),
        }
        for arm, each in intervals.items()
    ]
    seeds = [
        {"arm": arm, "seed": str(seed), "x": rounded(value)}
        for arm, each in intervals.items()
        for seed, value in each.seeds.items()
    ]
    color = {
        "field": "arm",
        "type": "nominal",
        "scale": {"domain": arms, "range": [colours[arm] for arm in arms]},
        # The rows have the names already
        "legend": None,
    }
    scale: dict[str, Any] = {"zero": False} if x_domain is None else {"domain": list(x_domain), "nice": False}
    y = {
        "field": "arm",
        "type": "nominal",
        "title": None,
        "sort": arms,
        "axis": {"labelLimit": 150, "labelColor": "var(--ink)", "labelFontSize": 12},
    }

    def x(name: str) -> dict[str, Any]:
        return {"field": name, "type": "quantitative", "title": x_title, "scale": scale, "axis": {"grid": True}}

    shown = [{"filter": "indexof(hidden, datum.arm) < 0"}]
    layers: list[dict[str, Any]] = []
    if mark is not None:
        layers.append(
            {
                "data": {"values": [{"x": mark}]},
                "mark": {"type": "rule", "strokeDash": [4, 4]},
                "encoding": {"x": {**x("x"), "field": "x"}},
            }
        )
    if any(row["low"] is not None for row in estimates):
        layers.append(
            {
                "name": "interval",
                "data": {"name": "estimates"},
                "transform": [*shown, {"filter": "isValid(datum.low)"}],
                "mark": {"type": "rule", "clip": True, "strokeWidth": 7, "opacity": 0.35, "strokeCap": "round"},
                "encoding": {"x": x("low"), "x2": {"field": "high"}, "y": y, "color": color},
            }
        )
    if seeds:
        layers.append(
            {
                "name": "seeds",
                "data": {"name": "seeds"},
                "transform": shown,
                "mark": {"type": "tick", "thickness": 1.2, "size": 15, "opacity": 0.75},
                "encoding": {
                    "x": x("x"),
                    "y": y,
                    "color": color,
                    "tooltip": [
                        {"field": "arm", "type": "nominal", "title": "algorithm"},
                        {"field": "seed", "type": "nominal", "title": "seed"},
                        {"field": "x", "type": "quantitative", "title": x_title, "format": ".4~g"},
                    ],
                },
            }
        )
    layers.append(
        {
            "name": "estimate",
            "data": {"name": "estimates"},
            "transform": shown,
            "mark": {"type": "point", "filled": True, "size": 95, "opacity": 1, "stroke": "var(--ground)", "strokeWidth": 1.2},
            "encoding": {
                "x": x("x"),
                "y": y,
                "color": color,
                "tooltip": [
                    {"field": "arm", "type": "nominal", "title": "algorithm"},
                    {"field": "x", "type": "quantitative", "title": x_title, "format": ".4~g"},
                    {"field": "low", "type": "quantitative", "title": "from", "format": ".4~g"},
                    {"field": "high", "type": "quantitative", "title": "to", "format": ".4~g"},
                ],
            },
        }
    )
    return {
        "$schema": SCHEMA,
        "title": title,
        "width": WIDTH,
        "height": _ROW * len(arms),
        "params": [{"name": "hidden", "value": []}],
        "datasets": {"estimates": estimates, "seeds": seeds},
        "layer": layers,
    }
