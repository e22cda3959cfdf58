"""Python with the packages that our statistics are compared with, whose pins clash with ours."""

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from sb3_belief.report.resampling import Statistic, bootstrap_interval

#: Names another Python than that of ``make test-statistics``
VARIABLE = "STATISTICS_PYTHON"
PYTHON = Path(os.environ.get(VARIABLE) or Path(__file__).parents[2] / ".venv-statistics" / "bin" / "python")
HOW = f"make test-statistics, or set {VARIABLE} to a Python that has it"

#: What ``rliable_reference.py`` printed
REFERENCE = json.loads(Path(__file__).with_name("rliable_reference.json").read_text(encoding="utf-8"))


def check_interval(expected: list, strata: list[np.ndarray], statistic: Statistic) -> None:
    """
    Check that an interval of rliable equals ours within the noise of both bootstraps.

    Of its 4,000 resamples a share of 2.5 % lies outside each end, with a standard error of 0.25 %, of our 10,000 one with
    0.16 %. So its ends lie between those that leave out 1.5 % and 3.5 % of ours, which holds where statistics jump too.
    """
    for level, inside in [(0.97, -1), (0.93, 1)]:
        found = bootstrap_interval(strata, statistic, method="percentile", level=level)
        assert found is not None
        assert np.all(inside * (found[0] - np.array(expected[0])) >= -1e-9), (expected, found)
        assert np.all(inside * (np.array(expected[1]) - found[1]) >= -1e-9), (expected, found)


def run_with(package: str, script: Path, *arguments: str) -> str:
    """Run a script there and return what it printed; skip the test where the package is not installed."""
    if not PYTHON.exists() or subprocess.run([PYTHON, "-c", f"import {package}"], capture_output=True).returncode:
        pytest.skip(f"{package} is not installed in {PYTHON}: {HOW}")
    done = subprocess.run([PYTHON, script, *arguments], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout
