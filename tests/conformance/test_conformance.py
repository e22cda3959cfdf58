"""The machinery, on a suite of a few lines: what is put in place, what is selected, what the list does."""

import subprocess
import sys
import tarfile
from pathlib import Path
from typing import Any

import pytest

from tests.conformance import fetch, run
from tests.conformance.listed import matching, read_listed

SUITE = """
import pytest
import sb3_belief
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.env_util import make_vec_env

ALGORITHMS = {"a2c": A2C, "ppo": PPO}


def build():
    return PPO("MlpPolicy", make_vec_env("CartPole-v1", n_envs=2), n_steps=8, batch_size=8, n_epochs=1)


@pytest.mark.parametrize("algorithm", [A2C, PPO])
def test_parameter(algorithm):
    assert issubclass(algorithm, sb3_belief.BeliefPPO) and PPO is algorithm


@pytest.mark.parametrize("name", ALGORITHMS)
def test_key(name):
    assert issubclass(ALGORITHMS[name], sb3_belief.BeliefPPO)


def test_helper(tmp_path):
    model = build().learn(16)
    assert model.policy.has_belief is ACTIVE
    model.save(tmp_path / "model.zip")
    loaded = PPO.load(tmp_path / "model.zip", env=make_vec_env("CartPole-v1", n_envs=2))
    loaded.learn(16, reset_num_timesteps=False)
    assert loaded.num_timesteps == 32
    assert not ACTIVE or loaded.policy.history.valid.sum() == 32


def test_of_another():
    assert A2C is None


def test_of_none():
    assert False
"""
MORE_TESTS = """

def test_wrong():
    assert PPO is None


def test_right():
    assert PPO is not None


def test_failing():
    assert issubclass(PPO, A2C)
"""


def sit(tmp_path: Path, suite: str, belief: str = "none", listed: str = "") -> tuple[int, str]:
    """
    :return: The exit code, and the summary
    """
    (tmp_path / "tests").mkdir()
    (tmp_path / "pyproject.toml").write_text("[tool.pytest.ini_options]\n")
    (tmp_path / "tests" / "test_toy.py").write_text(suite.replace("ACTIVE", str(belief == "active")))
    (tmp_path / "tests" / "test_elsewhere.py").write_text("import not_installed  # nor needed by a test of ours")
    (tmp_path / "listed.yml").write_text(listed)
    summary = tmp_path / "summary.txt"
    options = ["--belief", belief, "--listed", str(tmp_path / "listed.yml"), "--summary", str(summary), "-q"]
    code = run.run_suite(tmp_path, options, tmp_path)
    return code, summary.read_text() if summary.exists() else ""


def test_ours_in_place(tmp_path: Path) -> None:
    code, summary = sit(tmp_path, SUITE, "active")
    # by the parameter PPO, by the key "ppo", by the helper; not those of A2C, nor of no algorithm
    assert (code, summary) == (0, "sb3, belief active: 3 tests, 3 passed\n")


def test_what_is_listed_and_what_fails(tmp_path: Path) -> None:
    listed = """
        none: {sb3: {"test_toy.py::test_wrong": so it is, "test_toy.py::test_r*t": not so}}
        active: {sb3: {"test_toy.py::test_failing": in the other pass}}
    """
    code, summary = sit(tmp_path, SUITE + MORE_TESTS, listed=listed)
    assert code == pytest.ExitCode.TESTS_FAILED
    assert summary.splitlines() == [
        "sb3, belief none: 6 tests, 1 failed, 1 listed, 1 listed, but passed, 3 passed",
        "  failed: test_toy.py::test_failing",
        "  listed: test_toy.py::test_wrong: so it is",
        "  listed, but passed: test_toy.py::test_right: not so",
    ]


def test_stale_entry(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    # a test of that name there is, but ours takes no part in it
    code, _ = sit(tmp_path, SUITE, listed="none: {sb3: {'test_toy.py::test_of_another': it was renamed}}")
    assert code == pytest.ExitCode.USAGE_ERROR
    assert "no such test takes part: test_toy.py::test_of_another" in capfd.readouterr().err


def test_nothing_to_do_is_no_success(tmp_path: Path) -> None:
    code, _ = sit(tmp_path, "def test_of_none():\n    'PPO'\n")
    assert code == pytest.ExitCode.USAGE_ERROR


def test_patterns() -> None:
    tests = ["test_run.py::test_ppo[0.1]", "test_run.py::test_ppo[0.2]", "test_run.py::test_ppo_warnings"]
    assert matching("test_run.py::test_ppo[0.1]", tests) == tests[:1]
    assert matching("test_run.py::test_ppo[*]", tests) == tests[:2]
    assert matching("*::test_ppo*", tests) == tests
    assert matching("test_run.py::test_p", tests) == []


def test_reasons_are_given(tmp_path: Path) -> None:
    path = tmp_path / "listed.yml"
    path.write_text("none: {sb3: {'test_run.py::test_ppo': ' '}}")
    with pytest.raises(ValueError, match="test_ppo is listed without a reason"):
        read_listed(path, "none", "sb3")
    assert read_listed(path, "active", "sb3") == {}


@pytest.mark.parametrize("codes, code", [((0, 0), 0), ((0, 1), 1), ((0, 5), 0), ((-9, 0), 1)])
def test_any_failing_suite_fails_the_run(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str], codes: tuple[int, ...], code: int
) -> None:
    monkeypatch.setattr(run, "suite_folder", lambda suite: tmp_path)
    remaining = list(codes)
    monkeypatch.setattr(run, "run_suite", lambda *args: remaining.pop(0))
    assert run.main(["--belief", "none", "-k", "some"]) == code
    assert capsys.readouterr().out.count("did not run") == 2


def test_fetched_first(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(fetch, "FOLDER", tmp_path)
    with pytest.raises(SystemExit):
        run.main([])
    assert "make conformance" in capsys.readouterr().err


@pytest.mark.parametrize("has_tests", [True, False])
def test_fetch(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, has_tests: bool) -> None:
    monkeypatch.setattr(fetch, "FOLDER", tmp_path / "suites")
    folder = fetch.suite_folder("sb3")
    source = tmp_path / folder.name
    (source / ("tests" if has_tests else "other")).mkdir(parents=True)
    calls = []

    def download(command: list[str]) -> Any:
        calls.append(command)
        assert command[:4] == [sys.executable, "-m", "pip", "download"] and "--no-deps" in command
        with tarfile.open(Path(command[command.index("--dest") + 1]) / f"{folder.name}.tar.gz", "w:gz") as archive:
            archive.add(source, source.name)
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr(subprocess, "run", download)
    if not has_tests:
        with pytest.raises(RuntimeError, match="holds no folder 'tests'"):
            fetch.fetch("sb3")
        assert not folder.exists()
        return
    assert fetch.fetch("sb3") == fetch.fetch("sb3") == folder
    assert (folder / "tests").is_dir() and len(calls) == 1
