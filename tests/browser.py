"""A headless Chromium for tests of pages. Without one these tests are skipped, and say how to get it."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

_HOW = "Debian and Ubuntu: apt-get install chromium chromium-driver; pip install selenium"


@contextmanager
def browser(width: int = 1366, height: int = 900, phone: bool = False) -> Iterator[Any]:
    """
    Start a browser that reaches no network.

    :param width: Of the window
    :param height: Of the window
    :param phone: Whether to emulate a phone
    :return: Selenium's driver
    """
    selenium = pytest.importorskip("selenium", reason=f"pages are tested in a browser. {_HOW}")
    programs = [shutil.which(name) for name in ("chromium", "chromedriver")]
    if selenium is None or None in programs:
        pytest.skip(f"pages are tested in Chromium, which is not installed. {_HOW}")
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = str(programs[0])
    # In containers there is no sandbox, and /dev/shm is small
    for argument in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--hide-scrollbars"):
        options.add_argument(argument)
    options.add_argument("--host-resolver-rules=MAP * ~NOTFOUND")
    if phone:
        metrics = {"width": width, "height": height, "pixelRatio": 2.0}
        options.add_experimental_option("mobileEmulation", {"deviceMetrics": metrics})
    else:
        options.add_argument(f"--window-size={width},{height}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(programs[1]))
    try:
        yield driver
    finally:
        driver.quit()


def complaints(driver: Any) -> list[Any]:
    """
    Return what the page has written to the console since the last call.

    :param driver: Selenium's driver
    """
    return driver.get_log("browser")


def open_file(driver: Any, path: Path, fragment: str = "") -> None:
    """
    Open a file.

    :param driver: Selenium's driver
    :param path: The file
    :param fragment: What follows ``#`` in the address
    """
    # Only the fragment of the same file would not load it anew
    driver.get("about:blank")
    driver.get(path.resolve().as_uri() + (f"#{fragment}" if fragment else ""))
