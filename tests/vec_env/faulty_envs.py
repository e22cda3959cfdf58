"""Environments that fail, hang or die at a given place, in one file that imports little, since workers import it."""

import os
import re
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

from tests.team.toy_envs import ToyEnv


class OwnError(Exception):
    """An error of the user's own that can be rebuilt."""


class TwoPartsError(Exception):
    """Its constructor takes other arguments than it keeps."""

    def __init__(self, what, where):
        super().__init__(f"{what} at {where}")


class CodeError(Exception):
    """Rebuilt, it would have another message."""

    def __init__(self, code):
        super().__init__(f"code {code}")


def unpicklable():
    error = OwnError("with a lock")
    error.lock = threading.Lock()  # type: ignore[attr-defined]
    return error


def keep_python_busy():
    """Hang within one instruction that holds Python's lock."""
    re.match(r"(a+)+$", 50 * "a" + "b")


FAULTS: dict[str, Any] = {
    "own": lambda: OwnError("broken, 1 of 2"),
    "key": lambda: KeyError("fuel"),
    "two parts": lambda: TwoPartsError("smoke", "the rear"),
    "code": lambda: CodeError(7),
    "lock": unpicklable,
    "hang": lambda: time.sleep(1000),
    "busy": keep_python_busy,
    "exit": lambda: os._exit(3),
}


class Troubled(ToyEnv):
    """
    A ``ToyEnv`` with a fault.

    :param place: Where: "constructor", "space", "reset", "step", "render", "method", "attribute" or "close"
    :param fault: Which, a key of ``FAULTS``
    :param at: At which step of an episode, or at which reset
    :param copies: How many copies have it: those of the first names in ``folder``
    :param folder: Folder in which copies count each other and their faults; without one all have the fault, always
    :param times: How often the fault happens, counted in ``folder``; None for always
    """

    def __init__(self, place, fault="own", at=3, copies=None, folder=None, times=None, **kwargs):
        self.place, self.fault, self.at, self.folder, self.times = place, fault, at, folder, times
        self.n_resets = 0
        self.is_faulty = copies is None or self.numbered("copy") < copies
        super().__init__(**kwargs)
        self.maybe("constructor")

    def numbered(self, what):
        """Make the next of the numbered files."""
        for number in range(1000):
            try:
                Path(self.folder, f"{what}-{number}").touch(exist_ok=False)
                return number
            except FileExistsError:
                continue
        raise AssertionError("too many files")

    def maybe(self, place):
        if place != self.place or not self.is_faulty:
            return
        if self.times is not None and self.numbered("fault") >= self.times:
            return
        error = FAULTS[self.fault]()
        if error is not None:
            raise error

    def observation_space(self, agent):
        self.maybe("space")
        return super().observation_space(agent)

    def reset(self, seed=None, options=None):
        self.n_resets += 1
        if self.place == "reset" and self.n_resets >= self.at:
            self.maybe("reset")
        return super().reset(seed, options)

    def step(self, actions):
        if self.place == "step" and self.t + 1 >= self.at:
            self.maybe("step")
        return super().step(actions)

    def render(self):
        self.maybe("render")
        return super().render()

    def method(self):
        self.maybe("method")
        return self.t

    @property
    def attribute(self):
        self.maybe("attribute")
        return self.t

    def close(self):
        self.maybe("close")


class WithChild(Troubled):
    """Has started a process of its own, which waits for a long time."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        # Not kept: nobody waits for it
        subprocess.Popen([sys.executable, "-c", "import time; time.sleep(1000)"])


class Troubling:
    """
    Another environment with a fault at a step, once.

    :param env_class: Its class
    :param at: At which step of the first episode
    :param folder: Folder in which the fault is counted
    """

    def __new__(cls, env_class, at, folder):
        env, counted = env_class(), Path(folder, "fault")
        step = env.step

        def troubled(actions):
            if env.t + 1 == at and not counted.exists():
                counted.touch()
                raise OwnError("once")
            return step(actions)

        env.step = troubled
        return env
