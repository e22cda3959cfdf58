"""Versions of the packages on which results and saved files depend."""

import platform
from importlib import metadata
from pathlib import Path

__version__ = (Path(__file__).parent.parent / "version.txt").read_text().strip()

_PACKAGES = ("stable-baselines3", "sb3-contrib", "torch", "gymnasium", "pettingzoo", "supersuit", "greenlet", "numpy")


def versions() -> dict[str, str]:
    """
    Return the versions of Python, this package and the packages that it builds on.

    :return: {name: version}
    """
    # This package's own version is not looked up as the others' are, because a checkout that is run in place is not installed
    found = {"python": platform.python_version(), "sb3-belief": __version__}
    for package in _PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = "not installed as a package"
    return found
