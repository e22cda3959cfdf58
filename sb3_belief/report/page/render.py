"""The HTML of a page."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from sb3_belief.report.figures.drawing import still_svg
from sb3_belief.report.figures.theme import DARK, FONT, LIGHT, css_variables, on_page
from sb3_belief.report.page.content import NOTHING, Column, Figure, Page, PageSection, Table
from sb3_belief.report.page.markup import Html, copy_button, json_script, markup_of, script_of, tag

_STATIC = Path(__file__).parent / "static"
_NUMBERS = ("number", "significant", "count", "interval")
# Colours of a page that no figure has
_PAGE_LIGHT = {"--accent": "#1f6f8b", "--good": "#1e7a46", "--bad": "#b3372a", "--warn": "#8f5f00"}
_PAGE_DARK = {"--accent": "#6fc3df", "--good": "#63c78d", "--bad": "#f28b7d", "--warn": "#e3b347"}
# Nothing may be fetched. Vega makes functions of the expressions in a specification, all of which are ours
_POLICY = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline' 'unsafe-eval'; img-src data:"
# Before anything is drawn, so that a dark page does not flash
_FIRST = 'try{const t=localStorage.getItem("sb3-belief-theme");if(t)document.documentElement.dataset.theme=t}catch(e){}'
#: Name and address of the files of a figure or a table, under the folder beside the page
FIGURES, TABLES = "figures", "tables"


def render_page(page: Page, files: str | None, bundle: str = "", bundle_file: str | None = None) -> str:
    """
    Return a page as HTML, with everything that it needs in it.

    :param page: The page
    :param files: Relative address of the folder that has the files of its figures and tables; None for none
    :param bundle: Script that draws the figures (``drawing.vega_bundle``). Without it they are still pictures
    :param bundle_file: Relative address of that script, for pages that share one. Where it is missing, figures are still
    :return: The text of the file
    """
    figures = page.figures()
    styles = f"{_colours()}\n{_file('page.css')}"
    head = tag(
        "head",
        tag("meta", charset="utf-8"),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        None if bundle_file else tag("meta", http_equiv="Content-Security-Policy", content=_POLICY),
        tag("meta", name="generator", content="sb3-belief"),
        # Otherwise a browser asks a server for one
        tag("link", rel="icon", href="data:,"),
        tag("title", page.title),
        tag("style", Html(styles)),
        script_of(_FIRST),
    )
    drawn = bool(figures) and bool(bundle or bundle_file)
    body = tag(
        "body",
        tag("a", "Skip to the content", href="#content", class_="skip"),
        _bar(page),
        tag(
            "main",
            _header(page),
            *(_section(section, page, files) for section in page.sections),
            tag("footer", tag("p", page.footer, class_="small")),
            id="content",
        ),
        json_script("figures", {figure.name: on_page(figure.spec) for figure in figures}) if drawn else None,
        script_of(bundle) if bundle and figures else None,
        tag("script", src=bundle_file) if bundle_file and figures else None,
        script_of(_file("page.js")),
    )
    return f"<!doctype html>\n{tag('html', head, body, lang='en')}\n"


def _file(name: str) -> str:
    return (_STATIC / name).read_text(encoding="utf-8")


def _colours() -> str:
    light = css_variables({**LIGHT, **_PAGE_LIGHT})
    dark = css_variables({**DARK, **_PAGE_DARK})
    return "\n".join(
        [
            f":root {{ --font: {FONT}; {light} }}",
            f'@media (prefers-color-scheme: dark) {{ :root:not([data-theme="light"]) {{ {dark} }} }}',
            f':root[data-theme="dark"] {{ {dark} }}',
            # Paper is light, whatever the screen is: the id that is not there makes the rule weigh more than those above
            f"@media print {{ :root:not(#none) {{ color-scheme: light; {light} }} }}",
        ]
    )


def _bar(page: Page) -> Html:
    links = [tag("a", section.menu or section.title, href=f"#{section.identifier}") for section in page.sections]
    if page.back is not None:
        links.insert(0, tag("a", "← ", page.back[1], href=_address(page.back[0])))
    buttons = [
        tag("button", "Print", type="button", id="print", class_="plain"),
        tag("button", "Dark", type="button", id="theme", class_="plain", aria_label="Switch between light and dark"),
    ]
    return tag("div", tag("div", tag("nav", *links, aria_label="Sections"), *buttons, class_="inner"), class_="bar")


def _header(page: Page) -> Html:
    parts: list[Html] = [tag("p", page.subtitle, class_="kicker"), tag("h1", page.title)]
    if page.notices:
        notices = [tag("li", notice) for notice in page.notices]
        parts.append(tag("div", tag("strong", "Read this first"), tag("ul", *notices), class_="notice", role="note"))
    parts += [tag("p", paragraph, class_="lead") for paragraph in page.lead.split("\n")]
    if page.quote:
        parts.append(tag("p", page.quote, class_="quote", id="quote"))
        parts.append(tag("p", copy_button("quote", "Copy this paragraph")))
    return tag("header", *parts)


def _section(section: PageSection, page: Page, files: str | None) -> Html:
    blocks: list[Html] = []
    for block in section.blocks:
        if isinstance(block, Table):
            blocks.append(_table(block, page, files))
        elif isinstance(block, Html):
            blocks.append(block)
        elif isinstance(block, str):
            blocks.append(tag("p", block))
        else:
            blocks += _figures(block, page, files)
    return tag("section", tag("h2", section.title), *blocks, id=section.identifier)


def _figures(figures: Sequence[Figure], page: Page, files: str | None) -> Iterator[Html]:
    shown = [arm for arm in page.arms if any(_holds(figure.spec, arm) for figure in figures)]
    if len(shown) > 1:
        yield tag("ul", *(tag("li", _legend_button(arm, page)) for arm in shown), class_="legend", aria_label="Legend")
    beside = {1: " one", 2: " two", 4: " two"}.get(len(figures), "")
    yield tag("div", *(_figure(figure, files) for figure in figures), class_=f"figures{beside}")


def _legend_button(arm: str, page: Page) -> Html:
    line = tag(
        "line", x1="0", y1="5", x2="26", y2="5", stroke=page.arms[arm], stroke_width="3", stroke_dasharray=_dash(arm, page)
    )
    swatch = tag("svg", line, viewBox="0 0 26 10", aria_hidden="true")
    return tag("button", swatch, arm, type="button", aria_pressed="true", data_arm=arm, title="Show or hide")


def _dash(arm: str, page: Page) -> str | None:
    for figure in page.figures():
        for encoding in _encodings(figure.spec, "strokeDash"):
            scale = encoding["scale"]
            if arm in scale["domain"]:
                dash = scale["range"][scale["domain"].index(arm)]
                return None if dash == [1, 0] else " ".join(map(str, dash))
    return None


def _holds(spec: Mapping[str, Any], arm: str) -> bool:
    return any(arm in encoding["scale"]["domain"] for encoding in _encodings(spec, "color"))


def _encodings(spec: Mapping[str, Any], channel: str) -> Iterator[dict[str, Any]]:
    for layer in spec["layer"]:
        encoding = layer["encoding"].get(channel, {})
        if "scale" in encoding:
            yield encoding


def _figure(figure: Figure, files: str | None) -> Html:
    links = None
    if files is not None:
        address = f"{files}/{FIGURES}/{figure.name}"
        kinds = ("svg", "png")
        links = tag(
            "span", *_joined([tag("a", kind.upper(), href=_address(f"{address}.{kind}")) for kind in kinds]), class_="files"
        )
    # It takes a tenth of a second, too long for thousands of them
    picture = Html(still_svg(figure.spec, figure.name)) if figure.still else None
    drawing = tag("div", picture, class_="drawing" if figure.still else "drawing empty", data_figure=figure.name)
    return tag(
        "figure",
        tag("figcaption", tag("span", figure.title), links),
        tag("div", drawing, role="group", aria_label=figure.description),
        id=f"figure-{figure.name}",
    )


def _joined(parts: Sequence[Html]) -> list[Html]:
    return [part if index == 0 else markup_of(" · ", part) for index, part in enumerate(parts)]


def _table(table: Table, page: Page, files: str | None) -> Html:
    heads = [
        tag(
            "th",
            tag("button", column.label, type="button", title=column.help or None),
            scope="col",
            aria_sort="none",
            class_="right" if column.kind in _NUMBERS else None,
            data_numeric=column.kind in _NUMBERS,
        )
        for column in table.shown()
    ]
    rows = [
        tag("tr", *(_cell(table, index, row, page) for index in range(len(table.shown()))), role="row") for row in table.rows
    ]
    options = [
        tag("option", f"{column.label} {arrow}", value=f"{index} {direction}")
        for index, column in enumerate(table.shown())
        for direction, arrow in ((1, "↑"), (-1, "↓"))
    ]
    name = f"Filter: {table.caption}"
    tools: list[Html | None] = [
        tag("input", type="search", placeholder="Filter, e.g. a name", aria_label=name) if len(rows) > 3 else None,
        tag("label", "Sort by ", tag("select", *options), class_="sorting") if len(rows) > 1 else None,
        tag("span", f"{len(rows)} rows", class_="count", role="status") if len(rows) > 3 else None,
    ]
    if files is not None:
        tools.append(tag("a", "CSV", href=_address(f"{files}/{TABLES}/{table.name}.csv")))
    label = f"table-{table.name}-caption"
    element = tag(
        "table",
        tag("thead", tag("tr", *heads, role="row"), role="rowgroup"),
        tag("tbody", *rows, role="rowgroup"),
        class_="stacks",
        role="table",
        aria_labelledby=label,
    )
    heading = tag("p", table.caption, class_="caption", id=label)
    scroll = tag("div", element, class_="scroll")
    return tag("div", heading, tag("div", *tools, class_="tools"), scroll, class_="table", id=f"table-{table.name}")


def _cell(table: Table, index: int, row: Mapping[str, Any], page: Page) -> Html:
    column: Column = table.shown()[index]
    value = row.get(column.key)
    text, key = column.text(value), column.sort_key(value)
    content: object = text
    if column.kind == "link" and value is not None and value[1]:
        content = tag("a", text, href=_address(value[1]))
    elif column.kind in ("verdict", "status") and value is not None:
        # "better" in "better (significant)" is the class
        content = tag("span", text, class_=f"{column.kind} {text.split()[0]}")
    elif column.key == "arm" and text in page.arms:
        content = tag("span", _swatch(page.arms[text]), text, class_="keep")
    classes = "right keep" if column.kind in _NUMBERS else None
    if index == 0:
        return tag("th", content, scope="row", role="rowheader", data_key=key, class_=classes)
    return tag("td", content, role="cell", data_key=key, data_label=column.label, data_empty=text == NOTHING, class_=classes)


def _swatch(colour: str) -> Html:
    return tag("span", class_="swatch", style=f"background:{colour}", aria_hidden="true")


def _address(path: str) -> str:
    """Return a relative address, which names of folders may not turn into one of another kind."""
    return quote(path, safe="/#.")
