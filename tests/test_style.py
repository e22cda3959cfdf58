"""Rules of CONTRIBUTING.md that can be read off the files."""

import ast
import re
from collections import defaultdict
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = sorted((ROOT / "sb3_belief").rglob("*.py"))
ALL = sorted(
    path for folder in ("sb3_belief", "benchmarks", "studies", "examples", "tests") for path in (ROOT / folder).rglob("*.py")
)
# Every adapter has the first two, by which the registry names them, and every command the others
ENTRY_POINTS = {"make", "names", "add_flags", "run"}


def name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def public_definitions(tree: ast.Module) -> list[ast.FunctionDef | ast.ClassDef]:
    """Functions and classes of a file, and methods of its classes, without private ones."""
    found: list[ast.FunctionDef | ast.ClassDef] = []
    for node in tree.body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and not node.name.startswith("_"):
            found.append(node)
            if isinstance(node, ast.ClassDef):
                found += [each for each in node.body if isinstance(each, ast.FunctionDef) and not each.name.startswith("_")]
    return found


@pytest.mark.parametrize("path", ALL, ids=name)
def test_no_file_is_longer_than_400_lines(path):
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 400


@pytest.mark.parametrize("path", PACKAGE, ids=name)
def test_docstrings_begin_with_a_sentence_and_capitalise(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    assert ast.get_docstring(tree), "the file does not say what it is"
    for node in public_definitions(tree):
        text = ast.get_docstring(node)
        if text is None:
            # Methods that override SB3's, Gymnasium's or PettingZoo's are described there
            assert isinstance(node, ast.FunctionDef) and node not in tree.body, f"{node.name} has no docstring"
            continue
        assert not text.startswith(":"), f"{node.name} does not say what it does"
        # Types of numbers and code may stand first
        for field, word in re.findall(r"^:(param \w+|return|raises \w+): (\S+)", text, re.MULTILINE):
            plain = not word[0].islower() or re.match(r"(float|u?int)\d*\b|bool\b", word)
            assert plain, f":{field}: of {node.name} begins with {word!r}"


def test_no_two_public_functions_or_classes_share_a_name():
    places = defaultdict(list)
    for path in PACKAGE:
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and not node.name.startswith("_"):
                places[node.name].append(name(path))
    doubled = {key: files for key, files in places.items() if len(files) > 1 and key not in ENTRY_POINTS}
    assert doubled == {}
