"""The page of the viewer: HTML, style, program and data in one file that needs no network."""

import html
import json
import os
from importlib import resources
from pathlib import Path

from sb3_belief.common.durable_files import make_folder, replaced_file
from sb3_belief.report.recording import Recording
from sb3_belief.report.viewer.page_data import page_data


def viewer_page(recording: Recording, title: str, subtitle: str = "", agent: str | None = None) -> str:
    """
    Return the viewer's page.

    :param recording: The episodes
    :param title: Heading of the page
    :param subtitle: What stands below it
    :param agent: Name of the agent that is shown at first; None for the one with a belief that sees the others most
    :return: HTML
    """
    files = resources.files("sb3_belief.report.viewer")
    parts = {
        name: (files / name).read_text(encoding="utf-8") for name in ("viewer.html", "viewer.css", "bars.js", "viewer.js")
    }
    # NaN is no JSON; JavaScript reads null for it. "<" could end the script
    data = json.dumps(page_data(recording, title, subtitle, agent), separators=(",", ":"), allow_nan=False).replace(
        "<", "\\u003c"
    )
    page = parts["viewer.html"]
    for mark, text in (
        ("{{title}}", html.escape(title)),
        ("{{style}}", parts["viewer.css"]),
        ("{{program}}", parts["bars.js"] + parts["viewer.js"]),
        # Last, so that no text of the recording is taken for a mark
        ("{{data}}", data),
    ):
        page = page.replace(mark, text, 1)
    return page


def write_viewer(
    recording: Recording, path: str | os.PathLike[str], title: str, subtitle: str = "", agent: str | None = None
) -> Path:
    """
    Write the viewer's page. An existing file is replaced only when the new one is complete.

    :param recording: The episodes
    :param path: The file. Its folder is made if necessary
    :param title: Heading of the page
    :param subtitle: What stands below it
    :param agent: Name of the agent that is shown at first; None for the one with a belief that sees the others most
    :return: Path of the file
    """
    target = Path(path)
    page = viewer_page(recording, title, subtitle, agent)
    make_folder(target.parent)
    with replaced_file(target, "w", encoding="utf-8") as file:
        file.write(page)
    return target
