"""Environment copies that are made anew after a fault: how often, with which seed, and what becomes of the broken episode."""

import warnings
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from sb3_belief.vec_env.events import StepRecord, no_flags
from sb3_belief.vec_env.observation_forms import copied, row_of
from sb3_belief.vec_env.validation import place

_FLAGS = ("active", "life_end", "truncated")
CutStep = tuple[dict[str, Any], float, bool, StepRecord, np.ndarray | None, dict[str, Any]]


class LastStep(NamedTuple):
    """
    What the last step or reset of all copies returned, as far as a broken step needs it.

    :param observations: ``[num_envs, ...]`` by agent
    :param dones: bool ``[num_envs]``; None after a reset
    :param infos: Those of the step
    """

    observations: Mapping[str, Any]
    dones: np.ndarray | None = None
    infos: Sequence[Mapping[str, Any]] = ()


class Restarts:
    """
    Counts the restarts of each copy, and keeps what they need.

    :param num_envs: Number of copies
    :param limit: How often each copy may be made anew
    """

    def __init__(self, num_envs: int, limit: int):
        self.limit = limit
        #: How often each copy has been made anew
        self.counts = [0] * num_envs
        #: The last seed that each copy was given; None for none
        self.seeds: list[int | None] = [None] * num_envs
        #: What all copies returned last
        self.last = LastStep({})

    def keep_seeds(self, seeds: Sequence[int | None]) -> None:
        """
        Keep the seeds of a reset.

        :param seeds: One for each copy; None where it goes on with its random numbers
        """
        self.seeds = [old if new is None else new for old, new in zip(self.seeds, seeds, strict=True)]

    def state(self) -> dict[str, Any]:
        """Return the state as plain data, for :meth:`set_state`."""
        last = self.last
        flags = [[info[name] for name in _FLAGS] for info in last.infos]
        return {
            "counts": list(self.counts),
            "seeds": list(self.seeds),
            "last": (dict(last.observations), last.dones, np.array(flags)) if self.limit else None,
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """
        Restore a state, after a reset.

        :param state: As :meth:`state` returned it
        """
        self.counts, self.seeds = list(state["counts"]), list(state["seeds"])
        if state["last"] is not None:
            observations, dones, flags = state["last"]
            self.last = LastStep(observations, dones, [dict(zip(_FLAGS, row, strict=True)) for row in flags])

    def allow(self, copy: int) -> bool:
        """
        Return whether a copy may be made anew.

        :param copy: Number of the copy
        """
        return self.counts[copy] < self.limit

    def count(self, copy: int, step: int, cause: BaseException) -> int | None:
        """
        Count a restart, and warn of it.

        :param copy: Number of the copy
        :param step: Of its episode; 0 for a reset
        :param cause: What has happened to it
        :return: Seed of the new copy: drawn from the copy's last seed and the number of its restarts; None if it has none
        """
        self.counts[copy] += 1
        n, seed = self.counts[copy], self.seeds[copy]
        told = f"{type(cause).__name__}: {cause}" if str(cause) else type(cause).__name__
        broken = "; its episode is cut off there, and counted as truncated" if step else ""
        warnings.warn(
            f"The environment has failed {place(copy, step)}, and the copy is made anew (restart {n} of {self.limit}){broken}."
            f" Cause: {told}",
            RuntimeWarning,
            stacklevel=2,
        )
        return None if seed is None else int(np.random.SeedSequence((seed, n)).generate_state(1)[0] % 2**31)


def cut_step(
    copy: int, last: LastStep, scripted_spaces: Mapping[str, spaces.Space], obs: dict[str, Any], masks: np.ndarray | None
) -> CutStep:
    """
    Return the step at which an episode broke off, as ``step_and_reset`` would.

    Nothing is gained in it, and learners bootstrap from the last observations, as they do at a time limit.

    :param copy: Number of the copy
    :param last: What it returned last
    :param scripted_spaces: Action spaces of the scripted others
    :param obs: First observations of the copy that takes its place
    :param masks: Masks there
    :return: As of ``step_and_reset``
    """
    n = len(last.observations)
    flags = no_flags(n)
    if last.dones is None or last.dones[copy]:
        flags.active[:] = True
    else:
        active, life_end, truncated = (last.infos[copy][name] for name in _FLAGS)
        # Whose return ended in the last step may have left
        flags.active[:] = active & ~(life_end | truncated)
        if not flags.active.any():
            flags.active[:] = active
    flags.truncated[:] = flags.active
    # Nobody has seen what followed
    visible = np.zeros((n, n - 1 + len(scripted_spaces)), dtype=bool)
    width = sum(map(spaces.flatdim, scripted_spaces.values()))
    scripted = np.zeros(width, dtype=np.float32) if scripted_spaces else None
    seen = {agent: copied(row_of(each, copy)) for agent, each in last.observations.items()}
    others = {"TimeLimit.truncated": True, "terminal_observation": seen, "worker_restarted": True}
    return obs, 0.0, True, StepRecord([0.0] * n, flags, visible, masks, scripted), masks, others
