"""The files of a page: the page itself, and beside it its figures and tables."""

import csv
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sb3_belief.common.durable_files import make_folder, replaced_file
from sb3_belief.report.figures.drawing import figure_png, figure_svg
from sb3_belief.report.figures.theme import in_file
from sb3_belief.report.page.content import Page, Table
from sb3_belief.report.page.render import FIGURES, TABLES, render_page

#: Suffixes of the files of figures
FIGURE_FORMATS = (".svg", ".png")


def write_page(page: Page, path: str | os.PathLike[str], bundle: str) -> Path:
    """
    Write a page and, into the folder ``<name of the page>_files`` beside it, its figures (``figures/*.svg``, ``*.png`` and
    their Vega-Lite specifications ``*.vl.json``) and tables (``tables/*.csv``).

    The page itself comes last, so that what it names is there.

    :param page: The page
    :param path: HTML file to write. Its folder is made if necessary
    :param bundle: Script that draws the figures (``figures.drawing.vega_bundle``)
    :return: The page's path
    :raises OSError: If a file cannot be written
    """
    target = Path(path)
    files = files_folder(target)
    text = render_page(page, files.name, bundle)
    for folder in (target.parent, files / FIGURES, files / TABLES):
        make_folder(folder)
    for figure in page.figures():
        paths = [files / FIGURES / f"{figure.name}{suffix}" for suffix in (".svg", ".png")]
        write_figure(figure.spec, *paths)
        with replaced_file(files / FIGURES / f"{figure.name}.vl.json", "w", encoding="utf-8") as file:
            json.dump(in_file(figure.spec), file, allow_nan=False)
    for table in page.tables():
        write_csv(table, files / TABLES / f"{table.name}.csv")
    with replaced_file(target, "w", encoding="utf-8") as file:
        file.write(text)
    return target


def files_folder(path: Path) -> Path:
    """
    Return the folder of a page's files.

    :param path: The page
    :return: The folder beside it
    """
    return path.with_name(f"{path.stem}_files")


def write_figure(spec: Mapping[str, Any], *paths: Path) -> None:
    """
    Write a figure into one file or several.

    :param spec: The figure
    :param paths: The files, whose suffixes are ``.svg`` or ``.png``
    :raises ValueError: For another suffix
    """
    for path in paths:
        if path.suffix.lower() not in FIGURE_FORMATS:
            raise ValueError(f"{path}: a figure's file ends in {' or '.join(FIGURE_FORMATS)}.")
    svg = figure_svg(spec)
    for path in paths:
        with replaced_file(path) as file:
            file.write(figure_png(svg) if path.suffix.lower() == ".png" else svg.encode())


def remove_figures(folder: Path, *patterns: str) -> None:
    """
    Remove what :func:`write_figure` has written.

    :param folder: Where
    :param patterns: Names of the files without their suffixes, as patterns
    """
    for pattern in patterns:
        for suffix in FIGURE_FORMATS:
            for path in folder.glob(f"{pattern}{suffix}"):
                path.unlink()


def write_csv(table: Table, path: Path) -> None:
    """
    Write a table as CSV: all its values, in full, in the order of the page.

    :param table: The table
    :param path: The file
    """
    with replaced_file(path, "w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([name for column in table.columns for name in column.csv_names()])
        for row in table.rows:
            writer.writerow([value for column in table.columns for value in column.csv_values(row.get(column.key))])
