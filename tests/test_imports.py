"""Imports point one way: from what uses to what is used, between the packages and between the files."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent / "sb3_belief"
# Each may import from those before it; those of one line know nothing of each other
LAYERS = [
    {"common"},
    {"belief"},
    {"belief_ppo", "vec_env"},
    {"envs"},
    {"team"},
    {"baselines", "references"},
    {"report", "export"},
    {"zoo"},
    {"study"},
    {"cli"},
]
LEVEL = {package: level for level, packages in enumerate(LAYERS) for package in packages}


def module_of(path: Path) -> str:
    parts = path.relative_to(ROOT.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_of(path): path for path in sorted(ROOT.rglob("*.py"))}


def imported(source: str, module: str) -> set[str]:
    """All modules of the package that a file names in an import, wherever it stands, also those only for type checkers."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module} imports relatively"
            # "from package import module" as well as "from module import name"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            names = [name if name in MODULES else str(node.module) for name in names]
        else:
            continue
        found |= {name for name in names if name in MODULES}
    return found - {module}


GRAPH = {module: imported(path.read_text(), module) for module, path in MODULES.items()}


def upward(graph: dict[str, set[str]]) -> list[str]:
    """Imports from a package that stands above, or beside."""
    found = []
    for module, others in graph.items():
        for other in others:
            above, below = (name.split(".")[1:2] for name in (module, other))
            # __init__ and __main__ of the package itself stand above all
            if above in ([], ["__main__"]):
                continue
            if not below or (above != below and LEVEL[above[0]] <= LEVEL[below[0]]):
                found.append(f"{module} -> {other}")
    return sorted(found)


def circle(graph: dict[str, set[str]]) -> list[str]:
    """A circle of files, if there is one."""
    done: set[str] = set()

    def visit(module: str, path: list[str]) -> list[str]:
        if module in path:
            return [*path[path.index(module) :], module]
        if module in done:
            return []
        for other in sorted(graph[module]):
            if found := visit(other, [*path, module]):
                return found
        done.add(module)
        return []

    for module in graph:
        if found := visit(module, []):
            return found
    return []


def test_every_package_has_its_level():
    assert {path.name for path in ROOT.iterdir() if (path / "__init__.py").exists()} == set(LEVEL)


def test_no_import_points_up():
    assert upward(GRAPH) == []


def test_no_circle_of_files():
    assert circle(GRAPH) == []


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("sb3_belief.envs.registry", "from sb3_belief.team import Team"),
        ("sb3_belief.envs.registry", "def f():\n    import sb3_belief.cli.main"),
        ("sb3_belief.vec_env.joint_env", "from sb3_belief.belief_ppo import others"),
        ("sb3_belief.belief.network", "from sb3_belief import Team"),
    ],
)
def test_an_import_that_points_up_is_found(module, line):
    assert len(upward({module: imported(line, module)})) == 1


def test_a_circle_is_found():
    assert circle({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c", "b"]
