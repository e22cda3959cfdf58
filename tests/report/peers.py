"""Python with the packages that our statistics are compared with, whose pins clash with ours."""

import os
import subprocess
from pathlib import Path

import pytest

#: Names another Python than that of ``make test-statistics``
VARIABLE = "STATISTICS_PYTHON"
PYTHON = Path(os.environ.get(VARIABLE) or Path(__file__).parents[2] / ".venv-statistics" / "bin" / "python")
HOW = f"make test-statistics, or set {VARIABLE} to a Python that has it"


def run_with(package: str, script: Path, *arguments: str) -> str:
    """Run a script there and return what it printed; skip the test where the package is not installed."""
    if not PYTHON.exists() or subprocess.run([PYTHON, "-c", f"import {package}"], capture_output=True).returncode:
        pytest.skip(f"{package} is not installed in {PYTHON}: {HOW}")
    done = subprocess.run([PYTHON, script, *arguments], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout
