"""README and pages: links lead somewhere, code is code, and every page stands in a list of contents."""

import ast
import re
from pathlib import Path

import pytest

from sb3_belief.cli.main import make_parser
from sb3_belief.zoo.config import load_config
from sb3_belief.zoo.names import get_env

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
    """A package index shows it beside no other file, and without anchors of its headings: of pictures it shows the text."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    pictures = re.findall(r"!\[([^\]]*)\]\((?!https://)[^)]*\)", text)
    assert len(re.findall(r"\]\((?!https://)[^)]*\)", text)) == len(pictures) and "<img" not in text
    assert pictures and all(len(words.split()) > 10 for words in pictures)


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
    lines = (ROOT / ".ci" / "run").read_text().splitlines()
    made = {word for line in lines if line.startswith("make ") for word in line.split()[1:]}
    parts = "test test-slow test-rl-zoo3 test-trackers check-codestyle lint type docs package"
    assert set(parts.split()) <= made


def test_the_commands_for_the_papers_names_are_accepted():
    text = (DOCS / "paper.md").read_text(encoding="utf-8")
    commands = re.findall(r"`train\.py ([^`]+)`", text)
    assert len(commands) >= 8
    parser = make_parser()
    for command in commands:
        words = command.replace("ENV", "traffic-junction-medium").replace("belief:B", "belief:static").split()
        args = parser.parse_args(["train", *words])
        # StarCraft II is not installed, so its ids are looked up and no more
        get_env(args.env, "--env")
        assert load_config(args.algo, "traffic-junction-medium", params=args.params).algo == args.algo
    for setting in re.findall(r"`(?:-params )?((?:belief|similarity|history_length|keep_ratio):[\w.]+)`", text):
        load_config("belief_ppo", "traffic-junction-medium", params=[setting])
