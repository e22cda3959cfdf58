"""Fetches the suites of the installed versions out of their source distributions: `python -m tests.conformance.fetch`."""

import subprocess
import sys
import tarfile
import tempfile
from importlib import metadata
from pathlib import Path

#: Suite -> package whose source distribution holds it
PACKAGES = {"sb3": "stable-baselines3", "contrib": "sb3-contrib"}
FOLDER = Path(__file__).parents[2] / "build" / "conformance"


def suite_folder(suite: str) -> Path:
    """
    :param suite: ``"sb3"`` or ``"contrib"``
    :return: Where its source distribution of the installed version is unpacked, whether it has been fetched or not
    """
    package = PACKAGES[suite]
    return FOLDER / f"{package.replace('-', '_')}-{metadata.version(package)}"


def fetch(suite: str) -> Path:
    """
    Fetch a suite, unless it is there already.

    :param suite: ``"sb3"`` or ``"contrib"``
    :return: Its folder
    :raises RuntimeError: if the source distribution cannot be fetched, or holds no tests
    """
    folder = suite_folder(suite)
    if folder.exists():
        return folder
    package = PACKAGES[suite]
    requirement = f"{package}=={metadata.version(package)}"
    FOLDER.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=FOLDER) as scratch:
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--no-binary", ":all:", "--dest", scratch]
        if subprocess.run([*command, requirement]).returncode:
            raise RuntimeError(f"pip could not fetch the source distribution of {requirement}; its own message stands above")
        (archive,) = Path(scratch).glob("*.tar.gz")
        with tarfile.open(archive) as unpacked:
            # Pythons before 3.10.12 and 3.11.4 have no filters
            if hasattr(tarfile, "data_filter"):
                unpacked.extraction_filter = tarfile.data_filter
            unpacked.extractall(scratch)
        source = archive.with_name(archive.name.removesuffix(".tar.gz"))
        if not (source / "tests").is_dir():
            raise RuntimeError(f"the source distribution of {requirement} holds no folder 'tests'")
        # Last and at once, so that what is there is whole
        source.rename(folder)
    return folder


if __name__ == "__main__":
    for name in PACKAGES:
        print(f"{name}: {fetch(name)}")
