"""The versions that a result or a saved file depends on."""

import platform
from importlib import metadata
from pathlib import Path

__version__ = (Path(__file__).parent.parent / "version.txt").read_text().strip()

_PACKAGES = ("stable-baselines3", "sb3-contrib", "torch", "gymnasium", "pettingzoo", "supersuit", "greenlet", "numpy")


def versions() -> dict[str, str]:
    """
    :return: {name: version} of Python, this package and those that it builds on
    """
    # from the package itself: a checkout that is run in place is not known to pip
    found = {"python": platform.python_version(), "sb3-belief": __version__}
    for package in _PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = "not installed as a package"
    return found
