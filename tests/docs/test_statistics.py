"""The example and the numbers of the page on statistics."""

import re
from pathlib import Path

import pytest

from sb3_belief.report.resampling import widening
from sb3_belief.report.verdicts import MOST_SEEDS
from tests.report.coverage import rates

PAGE = (Path(__file__).parents[2] / "docs" / "statistics.md").read_text(encoding="utf-8")


def test_the_example_prints_what_it_says(capsys):
    code = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)[0]
    exec(code, {})
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("IntervalEstimate(value=") and lines[0].endswith("n_seeds=5)")
    assert lines[2] in ("better", "worse", "undecided") and lines[3] == "better"


def test_the_factors_are_those_of_the_code():
    found = re.search(
        r"factor is ([\d.]+) for 3 seeds in one environment, ([\d.]+) for 5, ([\d.]+) for 10, and\s+([\d.]+)", PAGE
    )
    assert found and [float(each) for each in found.groups()] == [round(widening(s), 2) for s in ([3], [5], [10], [5] * 4)]
    assert f"up to {MOST_SEEDS:,}" in PAGE


@pytest.mark.slow
@pytest.mark.parametrize(("n_environments", "n_seeds"), [(1, 3), (1, 5), (4, 5)])
def test_the_table_is_what_its_command_prints(n_environments, n_seeds):
    shapes = [rates(shape, n_environments, n_seeds, "corrected") for shape in ("normal", "beta", "lognormal")]
    row = re.search(rf"^\| {n_environments} \| {n_seeds} \| ([\d.]+) to ([\d.]+) \|", PAGE, re.MULTILINE)
    shares = [100 * each.iqm for each in shapes]
    assert row and [float(each) for each in row.groups()] == pytest.approx([min(shares), max(shares)], abs=0.11)
