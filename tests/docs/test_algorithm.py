"""docs/algorithm.md quotes the code: here it is kept in step with it."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
QUOTES = re.findall(r"```python\n# (\S+)\n(.*?)```", (ROOT / "docs" / "algorithm.md").read_text(encoding="utf-8"), re.DOTALL)


def test_every_equation_has_its_lines():
    text = (ROOT / "docs" / "algorithm.md").read_text(encoding="utf-8")
    assert all(f"q. {number}" in text for number in range(3, 9)) and len(QUOTES) >= 8
    assert text.count("```python") == len(QUOTES)  # none without the file that it is from


@pytest.mark.parametrize("path, quote", QUOTES)
def test_quoted_lines_are_in_the_code(path, quote):
    code = (ROOT / path).read_text(encoding="utf-8").splitlines()
    for line in quote.splitlines():
        assert line in code, f"docs/algorithm.md quotes a line that {path} does not have"
