"""docs/how_it_works.md lists the files of three paths through the code: here each path is run, and the files are compared."""

import re
import sys
from collections import defaultdict
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

import pytest
from stable_baselines3.common.env_util import make_vec_env

import sb3_belief
from sb3_belief import BeliefPPO, Team, make_team_env
from tests.belief_ppo.toy_envs import AmongOthers
from tests.team.toy_envs import ToyEnv

ROOT = Path(sb3_belief.__file__).parent
TEXT = (Path(__file__).parents[2] / "docs" / "how_it_works.md").read_text(encoding="utf-8")
SMALL: dict[str, Any] = dict(n_steps=14, batch_size=14, n_epochs=1, history_length=20, seed=0)
Entered = dict[str, set[str]]


class Recorder:
    """Records which functions of which of our files are called."""

    def __init__(self) -> None:
        self.entered: Entered = defaultdict(set)

    def _on_event(self, frame: Any, event: str, argument: Any) -> None:
        path = Path(frame.f_code.co_filename)
        if event == "call" and path.is_relative_to(ROOT):
            self.entered[path.relative_to(ROOT).as_posix()].add(frame.f_code.co_name)

    def start(self) -> None:
        sys.setprofile(self._on_event)

    def stop(self) -> None:
        sys.setprofile(None)


def listed(title: str) -> dict[str, list[str]]:
    """The files of a section's list, each with the functions named beside it."""
    (section,) = re.findall(rf"^## {title}\n(.*?)(?=^## |\Z)", TEXT, re.DOTALL | re.MULTILINE)
    items = re.findall(r"^\d+\. `([\w/]+\.py)`, (.*?):", section, re.DOTALL | re.MULTILINE)
    assert [int(number) for number in re.findall(r"^(\d+)\. ", section, re.MULTILINE)] == list(range(1, len(items) + 1))
    return {path: re.findall(r"`([\w.]+)`", functions) for path, functions in items}


def between(recorder: Recorder, call: Callable[..., Any], first: int) -> Callable[..., Any]:
    """Record from the end of the ``first`` call of a function to the beginning of the next."""
    n_calls = 0

    def watched(*args: Any, **kwargs: Any) -> Any:
        nonlocal n_calls
        recorder.stop()
        n_calls += 1
        result = call(*args, **kwargs)
        if n_calls == first:
            recorder.start()
        return result

    return watched


def rollout_step() -> Entered:
    recorder, model = Recorder(), BeliefPPO("BeliefPolicy", make_vec_env(AmongOthers, n_envs=3, seed=0), **SMALL)
    model.learn(42)
    assert model.env is not None
    model.env.step_wait = between(recorder, model.env.step_wait, first=3)  # type: ignore[method-assign]
    model.learn(42, reset_num_timesteps=False)
    return recorder.entered


def minibatch() -> Entered:
    recorder, model = Recorder(), BeliefPPO("BeliefPolicy", make_vec_env(AmongOthers, n_envs=3, seed=0), **SMALL)
    model.learn(42)
    get = model.rollout_buffer.get

    def watched(batch_size: int | None = None) -> Generator[Any, None, None]:
        minibatches = get(batch_size)
        yield next(minibatches)
        # From when SB3 asks for the second one to when it asks for the third
        recorder.start()
        yield next(minibatches)
        recorder.stop()
        yield from minibatches

    model.rollout_buffer.get = watched  # type: ignore[method-assign]
    model.learn(42, reset_num_timesteps=False)
    return recorder.entered


def joint_step() -> Entered:
    env, recorder = make_team_env(ToyEnv, n_envs=2, seed=0), Recorder()
    team = Team(BeliefPPO, "BeliefPolicy", env, **SMALL).learn(2 * 14)
    steps = 0
    step = env.step

    def watched(actions: Any) -> Any:
        # From the beginning of one step to that of the next, in the middle of a rollout
        nonlocal steps
        steps += 1
        (recorder.start if steps == 3 else recorder.stop)()
        return step(actions)

    env.step = watched  # type: ignore[method-assign]
    team.learn(2 * 14, reset_num_timesteps=False)
    return recorder.entered


@pytest.mark.parametrize(
    "title, path, most",
    [
        ("A rollout step of BeliefPPO", rollout_step, 8),
        ("A minibatch of an update", minibatch, 9),
        ("A joint step of a team", joint_step, 18),
    ],
)
def test_the_lists_are_the_paths(title, path, most):
    files = listed(title)
    try:
        entered = path()
    finally:
        sys.setprofile(None)
    assert set(files) == set(entered)
    assert len(files) <= most
    # Called before the recording began, and not left since; and one that stands for its like
    not_recorded = {"_run", "cross_entropy"}
    for file, functions in files.items():
        names = {function.rpartition(".")[2] for function in functions}
        assert names - not_recorded <= entered[file], file
