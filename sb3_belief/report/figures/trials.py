"""The trials of a tuning: their objectives one after the other, over their evaluations, and over what was drawn."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sb3_belief.report.figures.curves import HEIGHT, WIDTH, rounded
from sb3_belief.report.figures.theme import SCHEMA

#: The kinds of trials that figures tell apart, with their colours, from the back to the front
TRIAL_COLOURS = {"pruned": "var(--arm-0)", "complete": "var(--arm-1)", "best": "var(--arm-2)"}
_SHAPES = {"pruned": "cross", "complete": "circle", "best": "diamond"}
_SHOWN = {"filter": "indexof(hidden, datum.arm) < 0"}


@dataclass(frozen=True)
class TrialPoint:
    """
    A trial in a figure.

    :param number: Its number
    :param kind: ``"pruned"``, ``"complete"`` or ``"best"``
    :param value: Its objective
    :param runs: The objective in each evaluation of each of its runs. The last one of a trial that was pruned is cut off
    :param setting: What was drawn of the setting that a figure is about; None for none
    """

    number: int
    kind: str
    value: float
    runs: Sequence[Sequence[float]] = ()
    setting: float | str | None = None


def objectives_spec(title: str, points: Sequence[TrialPoint], y_title: str) -> dict[str, Any]:
    """
    Return a figure of the objective of each trial, with a line for the best complete one so far.

    :param title: Title
    :param points: The trials, in the order of their numbers
    :param y_title: What the objective is
    :return: The specification
    """
    best: list[dict[str, Any]] = []
    for each in points:
        if each.kind != "pruned" and (not best or each.value > best[-1]["exact"]):
            best.append({"trial": each.number, "value": rounded(each.value), "arm": "best", "exact": each.value})
    if best and points[-1].number > best[-1]["trial"]:
        best.append({**best[-1], "trial": points[-1].number})
    x = _quantitative("trial", "trial", {"format": "d", "tickMinStep": 1}, {"zero": False, "nice": False, "padding": 8})
    y = _quantitative("value", y_title, {}, {"zero": False})
    line = {
        "name": "best-so-far",
        "data": {"values": [{key: row[key] for key in ("trial", "value", "arm")} for row in best]},
        "transform": [_SHOWN],
        "mark": {"type": "line", "interpolate": "step-after", "strokeWidth": 2, "opacity": 0.7},
        "encoding": {"x": x, "y": y, "color": _color()},
    }
    return _figure(title, points, [*([line] if best else []), _points(x, y, [])])


def evaluations_spec(title: str, points: Sequence[TrialPoint], y_title: str) -> dict[str, Any]:
    """
    Return a figure of the objective in each evaluation: a line for each run of each trial. Runs of the same trial stand beside
    each other, between dashed lines, and a pruned trial ends with a cross.

    :param title: Title
    :param points: The trials
    :param y_title: What the objective is
    :return: The specification
    """
    length = max((len(run) for each in points for run in each.runs), default=0)
    rows = [
        {
            "trial": each.number,
            "arm": each.kind,
            "run": run,
            "x": [run * length + index + 1 for index in range(len(values))],
            "y": [rounded(value) for value in values],
        }
        for each in _best_last(points)
        for run, values in enumerate(each.runs)
        if len(values)
    ]
    ends = [{**row, "x": row["x"][-1], "y": row["y"][-1]} for row in _last_rows(rows) if row["arm"] == "pruned"]
    n_runs = max((len(each.runs) for each in points), default=1)
    x_title = "evaluation" if n_runs < 2 else "evaluation, one run after the other"
    x = _quantitative("x", x_title, {"format": "d", "tickMinStep": 1}, {"zero": False, "nice": False, "padding": 8})
    y = _quantitative("y", y_title, {}, {"zero": False})
    flat = [_SHOWN, {"flatten": ["x", "y"]}]
    is_best = "datum.arm === 'best'"
    layers: list[dict[str, Any]] = []
    if n_runs > 1:
        layers.append(
            {
                "data": {"values": [{"x": run * length + 0.5} for run in range(1, n_runs)]},
                "mark": {"type": "rule", "strokeDash": [4, 4], "opacity": 0.6},
                "encoding": {"x": x},
            }
        )
    lines = {
        "name": "lines",
        "data": {"name": "runs"},
        "transform": flat,
        # A run with a single evaluation would not be seen without its point
        "mark": {"type": "line", "point": {"size": 14}},
        "encoding": {
            "x": x,
            "y": y,
            "color": _color(),
            "detail": [{"field": "trial", "type": "nominal"}, {"field": "run", "type": "nominal"}],
            "strokeWidth": {"condition": {"test": is_best, "value": 2.4}, "value": 1},
            "opacity": {"condition": {"test": is_best, "value": 1}, "value": 0.55},
        },
    }
    crosses = {
        "name": "pruned",
        "data": {"values": ends},
        "transform": [_SHOWN],
        "mark": {"type": "point", "shape": "cross", "filled": True, "size": 70},
        "encoding": {"x": x, "y": y, "color": _color()},
    }
    hover = {
        "name": "hover",
        "data": {"name": "runs"},
        "transform": flat,
        "mark": {"type": "point", "filled": True, "size": 60, "opacity": 0},
        "encoding": {"x": x, "y": y, "tooltip": [*_TRIAL, _told("x", "evaluation", "d"), _told("y", y_title)]},
    }
    figure = _figure(title, points, [*layers, lines, *([crosses] if ends else []), hover])
    return {**figure, "datasets": {"runs": rows}}


def setting_spec(
    title: str,
    points: Sequence[TrialPoint],
    y_title: str,
    choices: Sequence[str] = (),
    ends: tuple[float, float] | None = None,
    is_log: bool = False,
) -> dict[str, Any]:
    """
    Return a figure of the objective over what was drawn of a setting.

    :param title: Name of the setting
    :param points: The trials
    :param y_title: What the objective is
    :param choices: All that could be drawn, as texts, in order. Empty for numbers
    :param ends: Least and greatest number that could be drawn
    :param is_log: Whether the axis is logarithmic
    :return: The specification
    """
    if choices:
        axis = {"labelAngle": 0, "labelLimit": 110}
        x: dict[str, Any] = {"field": "setting", "type": "nominal", "title": title, "axis": axis, "sort": list(choices)}
        # Also those that were never drawn
        x["scale"] = {"domain": list(choices)}
    else:
        scale: dict[str, Any] = {"type": "log"} if is_log else {"type": "linear", "zero": False}
        scale |= {"nice": False, "padding": 8}
        if ends is not None:
            scale["domain"] = list(ends)
        whole = all(isinstance(each.setting, int) for each in points)
        x = _quantitative("setting", title, {"format": "d", "tickMinStep": 1} if whole else {"format": ".3~g"}, scale)
    y = _quantitative("value", y_title, {}, {"zero": False})
    known = [each for each in points if each.setting is not None]
    return _figure(title, known, [_points(x, y, [{"field": "setting", "type": x["type"], "title": title}])])


_TRIAL = [{"field": "trial", "type": "quantitative", "title": "trial"}, {"field": "arm", "type": "nominal", "title": "it is"}]


def _figure(title: str, points: Sequence[TrialPoint], layers: list[dict[str, Any]]) -> dict[str, Any]:
    rows = [
        {"trial": each.number, "arm": each.kind, "value": rounded(each.value)}
        | ({} if each.setting is None else {"setting": each.setting})
        for each in _best_last(points)
    ]
    return {
        "$schema": SCHEMA,
        "title": title,
        "width": WIDTH,
        "height": HEIGHT,
        "params": [{"name": "hidden", "value": []}],
        "datasets": {"trials": rows},
        "layer": layers,
    }


def _best_last(points: Sequence[TrialPoint]) -> list[TrialPoint]:
    """Return the points in the order in which they are drawn, the best one above the others."""
    order = list(TRIAL_COLOURS)
    return sorted(points, key=lambda each: order.index(each.kind))


def _points(x: dict[str, Any], y: dict[str, Any], further: list[dict[str, Any]]) -> dict[str, Any]:
    scale = {"domain": list(_SHAPES), "range": list(_SHAPES.values())}
    return {
        "name": "trials",
        "data": {"name": "trials"},
        "transform": [_SHOWN],
        "mark": {"type": "point", "filled": True, "size": 62, "opacity": 0.9},
        "encoding": {
            "x": x,
            "y": y,
            "color": _color(),
            "shape": {"field": "arm", "type": "nominal", "scale": scale, "legend": None},
            "size": {"condition": {"test": "datum.arm === 'best'", "value": 150}, "value": 62},
            "tooltip": [*_TRIAL, *further, _told("value", y["title"])],
        },
    }


def _color() -> dict[str, Any]:
    scale = {"domain": list(TRIAL_COLOURS), "range": list(TRIAL_COLOURS.values())}
    return {"field": "arm", "type": "nominal", "scale": scale}


def _quantitative(field: str, title: str, axis: Mapping[str, Any], scale: Mapping[str, Any]) -> dict[str, Any]:
    return {"field": field, "type": "quantitative", "title": title, "axis": {**axis}, "scale": {**scale}}


def _told(field: str, title: str, form: str = ".4~g") -> dict[str, Any]:
    return {"field": field, "type": "quantitative", "title": title, "format": form}


def _last_rows(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the row of each trial's last run."""
    return list({row["trial"]: row for row in rows}.values())
