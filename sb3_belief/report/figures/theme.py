"""Colours and config of all figures, which follow the page that they stand on."""

import copy
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

FONT = "system-ui, -apple-system, 'Segoe UI', 'Helvetica Neue', Arial, 'Liberation Sans', sans-serif"
SCHEMA = "https://vega.github.io/schema/vega-lite/v6.json"

#: Colours on a light ground, by the names of the CSS variables that a page gives both for light and for dark. All have a
#: contrast of 3 to 1 or more with the ground. ``--arm-0`` is that of the baseline
LIGHT = {
    "--ink": "#1d2329",
    "--ink-soft": "#59636e",
    "--line": "#d9dde1",
    "--ground": "#ffffff",
    "--arm-0": "#6b7480",
    "--arm-1": "#1f6f8b",
    "--arm-2": "#c8553d",
    "--arm-3": "#6a7a1f",
    "--arm-4": "#6b5b95",
    "--arm-5": "#a06f00",
    "--arm-6": "#b03f7a",
    "--arm-7": "#3a66c4",
    "--arm-8": "#7d5a45",
}
DARK = {
    "--ink": "#e7eaed",
    "--ink-soft": "#a4adb7",
    "--line": "#353c44",
    "--ground": "#16191d",
    "--arm-0": "#a2abb6",
    "--arm-1": "#5bb5d4",
    "--arm-2": "#f08c74",
    "--arm-3": "#b4c55a",
    "--arm-4": "#b8a6ea",
    "--arm-5": "#e3b347",
    "--arm-6": "#ee8cbd",
    "--arm-7": "#8eb1ff",
    "--arm-8": "#cba78f",
}
# From the ninth arm on colours are used again, with another dash
_DASHES = ([1, 0], [6, 3], [2, 2], [8, 3, 2, 3])
_OTHERS = 8


def arm_colours(arms: Iterable[str], baseline: str | None = None) -> dict[str, str]:
    """
    Return a colour for each arm, the same in all figures of a page.

    :param arms: The arms, in order
    :param baseline: The arm that the others are compared with, which is grey
    :return: {arm: CSS variable of its colour}
    """
    others = [arm for arm in arms if arm != baseline]
    colours = {arm: f"var(--arm-{index % _OTHERS + 1})" for index, arm in enumerate(others)}
    return {arm: "var(--arm-0)" if arm == baseline else colours[arm] for arm in arms}


def arm_dashes(arms: Sequence[str], baseline: str | None = None) -> dict[str, list[int]]:
    """
    Return the dash of each arm's lines: whole, unless another arm has the same colour.

    :param arms: The arms, in order
    :param baseline: The arm that the others are compared with
    :return: {arm: lengths of line and gap}
    """
    others = [arm for arm in arms if arm != baseline]
    dashes = {arm: _DASHES[index // _OTHERS % len(_DASHES)] for index, arm in enumerate(others)}
    return {arm: dashes.get(arm, [1, 0]) for arm in arms}


def config() -> dict[str, Any]:
    """
    Return Vega-Lite's config of all figures, with CSS variables for colours.

    :return: The config
    """
    return {
        "background": None,
        "font": FONT,
        "view": {"stroke": None},
        "axis": {
            "labelColor": "var(--ink-soft)",
            "titleColor": "var(--ink-soft)",
            "labelFontSize": 11,
            "titleFontSize": 11.5,
            "titleFontWeight": "normal",
            "titlePadding": 7,
            "gridColor": "var(--line)",
            "domainColor": "var(--line)",
            "tickColor": "var(--line)",
            "tickCount": 5,
        },
        "axisX": {"grid": False, "labelFlush": True},
        "axisY": {"domain": False, "ticks": False, "labelPadding": 6, "labelFlush": False},
        "legend": {
            "labelColor": "var(--ink)",
            "labelFontSize": 11.5,
            "title": None,
            "orient": "top",
            "symbolType": "stroke",
            "symbolStrokeWidth": 2.5,
            "symbolOpacity": 1,
            "labelLimit": 320,
            "columns": 4,
        },
        "title": {"color": "var(--ink)", "fontSize": 14, "fontWeight": 600, "anchor": "start", "offset": 10},
        "text": {"color": "var(--ink-soft)"},
        "rule": {"color": "var(--ink-soft)"},
    }


def on_page(spec: Mapping[str, Any]) -> dict[str, Any]:
    """
    Return a figure as a page draws it: as wide as its place, and without legend and title, which the page has.

    :param spec: The figure
    :return: Its specification, with CSS variables for colours
    """
    figure = copy.deepcopy(dict(spec))
    figure.pop("title", None)
    figure.update(width="container", autosize={"type": "fit-x", "contains": "padding"}, config=config())
    _without_legends(figure)
    return figure


def still(spec: Mapping[str, Any]) -> dict[str, Any]:
    """
    Return a figure without what answers to the pointer.

    :param spec: The figure
    :return: Its specification: no parameters, and no layer whose name begins with "hover"
    """
    return dict(_without_parameters(copy.deepcopy(dict(spec))))


def in_file(spec: Mapping[str, Any], colours: Mapping[str, str] | None = None) -> dict[str, Any]:
    """
    Return a figure as it stands by itself in a file: with a ground, a legend and its title.

    :param spec: The figure
    :param colours: Colour of each CSS variable. None for those on a light ground
    :return: Its specification, with colours in place of CSS variables
    """
    figure = still(spec)
    figure["config"] = {**config(), "background": "var(--ground)", "padding": 14}
    with_colours = _with_colours(figure, LIGHT if colours is None else colours)
    assert isinstance(with_colours, dict)
    return with_colours


def css_variables(colours: Mapping[str, str]) -> str:
    """
    Return colours as declarations of CSS.

    :param colours: Colour of each variable
    :return: The declarations
    """
    return " ".join(f"{name}: {colour};" for name, colour in colours.items())


def _without_legends(value: Any) -> None:
    if isinstance(value, dict):
        for key, item in value.items():
            if key in ("color", "strokeDash", "shape") and isinstance(item, dict) and "field" in item:
                item["legend"] = None
            _without_legends(item)
    elif isinstance(value, list):
        for item in value:
            _without_legends(item)


def _without_parameters(value: Any) -> Any:
    if isinstance(value, list):
        return [
            _without_parameters(item)
            for item in value
            if not (isinstance(item, dict) and str(item.get("name", "")).startswith("hover"))
        ]
    if not isinstance(value, dict):
        return value
    if "condition" in value and "param" in value["condition"]:
        return {"value": value["value"]}
    kept = {key: _without_parameters(item) for key, item in value.items() if key != "params"}
    if "transform" in kept:
        # Filters by a parameter of the page
        kept["transform"] = [each for each in kept["transform"] if "hidden" not in str(each.get("filter", ""))]
    return kept


def _with_colours(value: Any, colours: Mapping[str, str]) -> Any:
    if isinstance(value, dict):
        return {key: _with_colours(item, colours) for key, item in value.items()}
    if isinstance(value, list):
        return [_with_colours(item, colours) for item in value]
    if isinstance(value, str) and value.startswith("var("):
        return re.sub(r"var\((--[\w-]+)\)", lambda match: colours[match[1]], value)
    return value
