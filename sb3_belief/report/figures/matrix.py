"""A matrix of values: a square for each pair, the darker the higher, with its value."""

from collections.abc import Mapping, Sequence
from typing import Any

from sb3_belief.report.figures.curves import rounded
from sb3_belief.report.figures.theme import SCHEMA

_SIDE = 44


def matrix_spec(
    title: str,
    values: Mapping[tuple[str, str], float],
    names: Sequence[str],
    x_title: str,
    y_title: str,
    domain: tuple[float, float],
) -> dict[str, Any]:
    """
    Return a figure of a matrix.

    :param title: Title
    :param values: {(row, column): value}
    :param names: Names of rows and columns, in order
    :param x_title: What the columns are
    :param y_title: What the rows are
    :param domain: Values of the lightest and the darkest square
    :return: The specification
    """
    cells = [
        {"row": row, "column": column, "value": rounded(value), "text": f"{value:.3g}"}
        for (row, column), value in values.items()
    ]
    size = max(_SIDE * len(names), 160)
    low, high = domain
    # Squares of one value only are all drawn alike
    scale = {"domain": [low, high if high > low else low + 1], "range": [0.06, 0.7]}
    return {
        "$schema": SCHEMA,
        "title": title,
        "width": size,
        "height": size,
        "params": [{"name": "hidden", "value": []}],
        "data": {"values": cells},
        "encoding": {
            "x": {"field": "column", "type": "nominal", "title": x_title, "sort": list(names), "axis": {"labelAngle": -45}},
            "y": {"field": "row", "type": "nominal", "title": y_title, "sort": list(names)},
        },
        "layer": [
            {
                "mark": {"type": "rect", "fill": "var(--arm-1)"},
                "encoding": {"fillOpacity": {"field": "value", "type": "quantitative", "scale": scale, "legend": None}},
            },
            {
                "mark": {"type": "text", "fontSize": 11, "fill": "var(--ink)"},
                "encoding": {"text": {"field": "text", "type": "nominal"}},
            },
        ],
    }
