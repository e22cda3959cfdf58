"""
Runs the suites: `python -m tests.conformance.run [--suite sb3|contrib] [--belief none|active] [options of pytest]`.

Without options it runs both suites in both passes. `python -m tests.conformance.fetch` gets the suites first.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from tests.conformance.fetch import PACKAGES, suite_folder

BELIEFS = ("none", "active")
#: Modules that do not name them may need what we do not install, and hold no test for us
NAMES = re.compile(r"\b(PPO|MaskablePPO)\b")


def run_suite(folder: Path, options: list[str], scratch: Path) -> int:
    """
    Run the tests of a suite that our classes take part in, in a process of its own.

    :param folder: The unpacked source distribution
    :param options: Options of the plugin and of pytest
    :param scratch: Where the tests run and leave their files
    :return: pytest's exit code
    """
    modules = [path for path in sorted((folder / "tests").glob("test_*.py")) if NAMES.search(path.read_text())]
    command = [sys.executable, "-m", "pytest", "-p", "tests.conformance.plugin", "-p", "no:cacheprovider"]
    # its own settings of pytest, not ours
    command += ["-c", str(folder / "pyproject.toml"), "--rootdir", str(folder), *options, *map(str, modules)]
    search_path = [str(Path(__file__).parents[2]), *filter(None, [os.environ.get("PYTHONPATH")])]
    return subprocess.run(command, cwd=scratch, env={**os.environ, "PYTHONPATH": os.pathsep.join(search_path)}).returncode


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.conformance.run", description=__doc__, allow_abbrev=False)
    parser.add_argument("--suite", choices=list(PACKAGES), action="append", help="one suite; default: both")
    parser.add_argument("--belief", choices=BELIEFS, action="append", help="one pass; default: both")
    chosen, options = parser.parse_known_args(arguments)
    suites, beliefs = chosen.suite or list(PACKAGES), chosen.belief or BELIEFS
    for suite in suites:
        if not (folder := suite_folder(suite)).exists():
            parser.error(f"{folder} is not there; 'make conformance' or 'python -m tests.conformance.fetch' gets it")
    codes, summaries = [], []
    for belief in beliefs:
        for suite in suites:
            with tempfile.TemporaryDirectory() as scratch:
                summary = Path(scratch) / "summary.txt"
                own = ["--suite", suite, "--belief", belief, "--summary", str(summary)]
                codes.append(run_suite(suite_folder(suite), [*own, *options], Path(scratch)))
                summaries.append(summary.read_text() if summary.exists() else f"{suite}, belief {belief}: did not run\n")
    print("\n" + "".join(summaries), end="")
    # whoever chooses tests with -k may leave a suite without any
    return int(any(code not in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED) for code in codes))


if __name__ == "__main__":
    sys.exit(main())
