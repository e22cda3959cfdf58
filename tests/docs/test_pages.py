"""README and pages: links lead somewhere, code is code, and every page stands in a list of contents."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(path for path in DOCS.rglob("*.md") if "_build" not in path.parts)
TEXTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *PAGES]


def name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def anchors(path: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("path", TEXTS, ids=name)
def test_links_lead_somewhere(path):
    text = re.sub(r"```.*?```", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if target.startswith(("http://", "https://")):
            continue
        file, _, anchor = target.partition("#")
        found = (path.parent / file).resolve() if file else path
        assert found.exists(), target
        assert not anchor or anchor in anchors(found), target
    for target in re.findall(r"\{doc\}`([^`]+)`", text):
        assert (path.parent / f"{target}.md").resolve().exists(), target


@pytest.mark.parametrize("path", TEXTS, ids=name)
def test_python_is_python(path):
    for code in re.findall(r"```python\n(.*?)```", path.read_text(encoding="utf-8"), re.DOTALL):
        # Quotes of lines from the middle of a file are compared with that file (test_algorithm.py)
        if not code.startswith("# sb3_belief/"):
            ast.parse(code)


def test_every_page_stands_in_a_list_of_contents():
    listed = set()
    for path in PAGES:
        for block in re.findall(r"```\{toctree\}\n(.*?)```", path.read_text(encoding="utf-8"), re.DOTALL):
            entries = [line for line in block.splitlines() if line and not line.startswith(":")]
            listed |= {(path.parent / f"{entry}.md").resolve() for entry in entries}
    assert listed == {path.resolve() for path in PAGES} - {DOCS / "index.md"}


def test_the_readme_stands_alone():
    """A package index shows it beside no other file, and without anchors of its headings."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert re.findall(r"\]\((?!https://)[^)]*\)", text) == [] and "<img" not in text


def test_the_readme_stays_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 160


def test_the_files_that_pages_name_are_there():
    for path in TEXTS:
        for file in re.findall(
            r"`((?:examples|studies|benchmarks|zoo_configs|tests|docs)/[\w/]+\.\w+)`", path.read_text(encoding="utf-8")
        ):
            assert (ROOT / file).exists(), f"{name(path)} names {file}"


def test_hosted_ci_runs_the_claimed_versions():
    claimed = re.findall(r"Programming Language :: Python :: (3\.\d+)$", (ROOT / "setup.cfg").read_text(), re.MULTILINE)
    assert claimed and set(re.findall(r'"(3\.\d+)"', (ROOT / ".github" / "workflows" / "ci.yml").read_text())) == set(claimed)
    assert "make docs" in (ROOT / ".ci" / "run").read_text()
