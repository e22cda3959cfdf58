"""Each example is short and runs on a small budget, and what it prints makes sense."""

import ast
import importlib
import io
import subprocess
import sys
import tokenize
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parent.parent / "examples"
MAX_LINES = 45
LAYOUT = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
# Number of timesteps, part of the output, and a check of the returned numbers
RUNS = {
    "own_environment": (6_000, "Steps in the same cell", lambda r: r["before"] < 2 and r["after"] > 5),
    "belief_team": (5_120, "Episodes without a collision", lambda r: r["before"] < r["after"] and 0 < r["accuracy"] <= 1),
    "fixed_partners": (3_072, "Equal actions", lambda r: r["known"] > 7 and r["new"] < 1 and r["adapted"] > 7),
    "mixed_algorithms": (5_000, "DQN", lambda r: len(r) == 5 and all(before < after for before, after in r.values())),
    "action_masks": (4_096, "Different jobs", lambda r: r["before"] < r["after"] <= 2),
    "deploy_one_agent": (20_000, "expects the previous leader", lambda r: r["before"] < 0.4 and r["after"] > 0.9),
}


def test_every_example_is_listed():
    assert {path.stem for path in EXAMPLES.glob("*.py")} == set(RUNS)


def lines_of_code(source: str) -> int:
    """Return the number of lines that are neither blank nor only a comment or a docstring."""
    tokens = [token for token in tokenize.generate_tokens(io.StringIO(source).readline) if token.type not in LAYOUT]
    lines = {line for token in tokens for line in range(token.start[0], token.end[0] + 1)}
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)) and ast.get_docstring(node) is not None:
            lines -= set(range(node.body[0].lineno, (node.body[0].end_lineno or 0) + 1))
    return len(lines)


def test_lines_of_code_are_counted():
    assert lines_of_code('"""Two\nlines."""\n\n# A comment\nx = (\n    1  # one\n)\n\n\ndef f():\n    """One line."""\n') == 4


@pytest.mark.parametrize("name", RUNS)
def test_an_example_stays_short(name):
    assert lines_of_code((EXAMPLES / f"{name}.py").read_text()) <= MAX_LINES


@pytest.mark.parametrize("name", RUNS)
def test_example(name, monkeypatch, capsys):
    total_timesteps, printed, makes_sense = RUNS[name]
    monkeypatch.syspath_prepend(EXAMPLES)
    returned = importlib.import_module(name).main(total_timesteps=total_timesteps)
    assert printed in capsys.readouterr().out
    assert makes_sense(returned), returned


def test_an_example_runs_as_a_script(tmp_path):
    command = [sys.executable, str(EXAMPLES / "deploy_one_agent.py")]
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert run.returncode == 0, run.stderr
    assert "100% after watching" in run.stdout
    assert not run.stderr and not list(tmp_path.iterdir())
