"""What is on a page: tables, figures, and the sections that hold them."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from sb3_belief.report.page.markup import Html

#: What stands for a value that there is not: an en dash
NOTHING = "\u2013"
# The sign, which is as wide as a digit
_MINUS = "\u2212"

Kind = Literal["text", "number", "significant", "count", "interval", "verdict", "link", "status"]


@dataclass(frozen=True)
class Column:
    """
    Column of a table.

    :param key: Name of the column in the CSV file, and key of its values in the rows
    :param label: Its header on the page
    :param kind: How values are shown. An ``"interval"`` is a pair (low, high), which the CSV file has in two columns; a
        ``"link"`` a pair (text, relative address)
    :param digits: Decimals of numbers, or significant digits of those that are ``"significant"``
    :param help: What the column means, shown when the pointer rests on the header
    :param shown: Whether the page has it. Otherwise only the CSV file does
    """

    key: str
    label: str
    kind: Kind = "text"
    digits: int = 3
    help: str = ""
    shown: bool = True

    def csv_names(self) -> list[str]:
        """
        Return the names of its columns in a CSV file.

        :return: One name, or two for an interval
        """
        return [f"{self.key}_low", f"{self.key}_high"] if self.kind == "interval" else [self.key]

    def csv_values(self, value: Any) -> list[Any]:
        """
        Return what a CSV file has for a value: in full, and empty for None.

        :param value: The value
        :return: One value, or two for an interval
        """
        if self.kind == "interval":
            return ["", ""] if value is None else list(value)
        if self.kind == "link" and value is not None:
            return [value[0]]
        return ["" if value is None else value]

    def text(self, value: Any) -> str:
        """
        Return a value as it is shown.

        :param value: The value
        :return: Its text
        """
        if value is None or (isinstance(value, float) and math.isnan(value)):
            return NOTHING
        if self.kind == "interval":
            low, high = value
            return f"{number_text(low, self.digits)} to {number_text(high, self.digits)}"
        if self.kind == "number":
            return number_text(value, self.digits)
        if self.kind == "significant":
            return f"{value:.{self.digits}g}".replace("-", _MINUS)
        if self.kind == "count":
            return f"{value:,}"
        return str(value[0]) if self.kind == "link" else str(value)

    def sort_key(self, value: Any) -> float | str | None:
        """
        Return by what a value is sorted.

        :param value: The value
        :return: A number, a text, or None for nothing, which stands last
        """
        if value is None:
            return None
        if self.kind == "interval":
            return float(value[0])
        if self.kind in ("number", "significant", "count"):
            return float(value)
        return self.text(value)


@dataclass(frozen=True)
class Table:
    """
    Table of a page, which can be sorted and filtered there, and is a CSV file beside it.

    :param name: Name of the file; that of the element begins with ``table-``
    :param caption: What it shows, in a sentence
    :param columns: The columns; the first one has the headers of the rows
    :param rows: {key of the column: value}
    """

    name: str
    caption: str
    columns: Sequence[Column]
    rows: Sequence[Mapping[str, Any]]

    def shown(self) -> list[Column]:
        """
        Return the columns that the page has.

        :return: The columns
        """
        return [column for column in self.columns if column.shown]


@dataclass(frozen=True)
class Figure:
    """
    Figure of a page, which is an SVG and a PNG file beside it.

    :param name: Name of the files; that of the element begins with ``figure-``
    :param title: What it shows, in a few words
    :param spec: Vega-Lite specification, see ``report.figures``
    :param description: What can be seen, for those who cannot see it
    :param still: Whether the page shows a picture of it before, and without, its script
    """

    name: str
    title: str
    spec: Mapping[str, Any]
    description: str
    still: bool = True


@dataclass(frozen=True)
class PageSection:
    """
    Section of a page.

    :param identifier: Id of the element, by which the page's menu finds it
    :param title: Its title
    :param blocks: Text (a paragraph), markup, tables, and lists of figures, which stand side by side
    :param menu: Its name in the page's menu. Empty for the title
    """

    identifier: str
    title: str
    blocks: Sequence[str | Html | Table | Sequence[Figure]]
    menu: str = ""


@dataclass(frozen=True)
class Page:
    """
    A page.

    :param title: Title
    :param subtitle: What kind of page it is, above the title
    :param lead: What was found, at the top, in larger letters
    :param quote: How it was found, in a paragraph that can be copied
    :param notices: What the reader must know first, such as runs that failed
    :param sections: The sections
    :param arms: Algorithms, or other things, that the figures compare, with the colour of each (see ``figures.theme``)
    :param footer: Last line
    :param back: Relative address and text of the page above this one; None for none
    """

    title: str
    subtitle: str
    lead: str
    sections: Sequence[PageSection]
    quote: str = ""
    notices: Sequence[str] = ()
    arms: Mapping[str, str] = field(default_factory=dict)
    footer: str = ""
    back: tuple[str, str] | None = None

    def tables(self) -> list[Table]:
        """
        Return all tables.

        :return: The tables, in order
        """
        return [block for section in self.sections for block in section.blocks if isinstance(block, Table)]

    def figures(self) -> list[Figure]:
        """
        Return all figures.

        :return: The figures, in order
        """
        return [
            figure
            for section in self.sections
            for block in section.blocks
            if not isinstance(block, str | Table)
            for figure in block
        ]


def number_text(value: float, digits: int = 3) -> str:
    """
    Return a number for a reader: with so many decimals, fewer for large numbers, and more where all would be zero.

    :param value: The number
    :param digits: Decimals of a number near 1
    :return: Its text, with a true minus sign
    """
    if not math.isfinite(value):
        return NOTHING
    size = abs(value)
    if size >= 1e6:
        text = f"{value:.3g}"
    elif 0 < size < 0.5 * 10**-digits:
        text = f"{value:.1g}"
    else:
        text = f"{value:.{max(digits - max(int(math.log10(size)) if size >= 1 else 0, 0), 0)}f}"
    return text.replace("-", _MINUS)


def unique_name(text: str, taken: set[str]) -> str:
    """
    Return a name for an element and its files.

    :param text: What it is called
    :param taken: Names, in lower case, that are taken. The new one is added
    :return: Letters, digits, dots, underscores and hyphens
    """
    stem = re.sub(r"[^\w.]+|\.{2,}", "-", text).strip("-.")[:80] or "x"
    name, number = stem, 2
    # Some file systems do not tell small letters from capital ones
    while name.lower() in taken:
        name, number = f"{stem}-{number}", number + 1
    taken.add(name.lower())
    return name
