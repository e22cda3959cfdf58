"""Drawing of figures without a browser, by the PyPI package ``vl-convert-python``, which holds Vega and Vega-Lite."""

import re
from collections.abc import Mapping
from types import ModuleType
from typing import Any

from sb3_belief.report.figures.theme import in_file, on_page, still

# Twice as many pixels as the figure's units, so that it is sharp on slides
_SCALE = 2.0
_WIDTH_ON_PAGE = 390


def figure_svg(spec: Mapping[str, Any]) -> str:
    """
    Draw a figure as an SVG file.

    :param spec: The figure, see ``figures.curves`` and ``figures.intervals``
    :return: Text of the file
    :raises ImportError: If vl-convert-python is not installed, as in all functions here
    """
    svg: str = _vl_convert().vegalite_to_svg(in_file(spec))
    return svg


def figure_png(svg: str) -> bytes:
    """
    Draw a figure as a PNG file.

    :param svg: Text of its SVG file
    :return: Content of the file
    """
    png: bytes = _vl_convert().svg_to_png(svg, scale=_SCALE)
    return png


def still_svg(spec: Mapping[str, Any], name: str) -> str:
    """
    Draw a figure for a page, where it stands until the page's script draws it anew, and on paper.

    :param spec: The figure
    :param name: Its name, which no other figure of the page has
    :return: Element ``svg``, as wide as its place, with the page's CSS variables for colours
    """
    figure = still(on_page(spec))
    figure["width"] = _WIDTH_ON_PAGE
    svg: str = _vl_convert().vegalite_to_svg(figure)
    # Vega numbers what clips a figure, here and in the browser: one figure would be clipped as another is
    svg = re.sub(r'(id="|url\(#)(clip\d)', rf"\g<1>{name}-\g<2>", svg)
    # The element's size is that of its place. What it shows is said by the element around it
    svg = re.sub(r'^(<svg [^>]*?) width="[\d.]+" height="[\d.]+"', r"\1", svg)
    # These describe single lines and points, for readers of which there are none in a still figure, and are half of it
    svg = re.sub(r' (?:aria-\w+|role)="[^"]*"', "", svg)
    return svg.replace("<svg ", '<svg aria-hidden="true" ', 1)


def vega_bundle() -> str:
    """
    Return Vega, Vega-Lite and Vega-Embed as one script, which needs nothing else.

    :return: JavaScript, 0.9 MB
    """
    script: str = _vl_convert().javascript_bundle()
    return script


def check_drawing() -> None:
    """
    Check that figures can be drawn.

    :raises ImportError: If they cannot
    """
    _vl_convert()


def _vl_convert() -> ModuleType:
    try:
        import vl_convert
    except ImportError as error:
        raise ImportError("Reports need vl-convert-python: pip install 'sb3-belief[study]'.") from error
    module: ModuleType = vl_convert
    return module
