"""
The rules of the switching conventions, for many copies at once.

:class:`ConventionGame` takes and returns arrays [n_copies]. Names of agents, dictionaries and Gym interfaces are added by
the environments that use it.
"""

from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from sb3_belief.common.checks import check_flag, check_integer
from sb3_belief.common.redraws import RedrawSchedule
from sb3_belief.envs.base import check_same_arguments

REWARDED = ("always", "last")


@dataclass(frozen=True)
class ConventionConfig:
    """
    The rules of a switching convention.

    :param m: Number of cues and of actions, >= 2
    :param K: Number of rollouts, or of episodes, for which a convention is valid, >= 1. None if it never changes
    :param rollout_steps: Steps of one copy in a rollout, >= 1. Also the length of an episode
    :param rewarded: In which of a convention's rollouts the follower is rewarded: ``"always"``, or ``"last"`` for the last
        one only
    :param leader_visible: Whether the follower can observe the leader's actions
    :param seed: Seed of the sequence of conventions, >= 0
    :param redraw_unit: What K counts: ``"rollouts"``, which pass with the steps, or ``"episodes"``, which pass with the resets
    :param per_copy: Whether each copy has conventions of its own
    :raises ValueError: For any other value, and for ``"episodes"`` without ``per_copy``
    """

    m: int = 4
    K: int | None = 5
    rollout_steps: int = 16
    rewarded: str = "always"
    leader_visible: bool = True
    seed: int = 0
    redraw_unit: str = "rollouts"
    per_copy: bool = False

    def __post_init__(self) -> None:
        check_integer("m", self.m, 2, "the number of cues and actions")
        if self.K is not None:
            check_integer("K", self.K, 1, "for how many rollouts a convention is valid, or None for all")
        check_integer("rollout_steps", self.rollout_steps, 1, "the n_steps of the learner")
        check_integer("seed", self.seed, 0, "which decides the sequence of conventions")
        if self.rewarded not in REWARDED:
            raise ValueError(f"rewarded={self.rewarded!r} is not one of {', '.join(map(repr, REWARDED))}.")
        if self.rewarded == "last" and self.K is None:
            raise ValueError(
                "rewarded='last' with K=None would never reward: a convention that never changes has no last rollout."
                " Give K a number, or use rewarded='always'."
            )
        check_flag("leader_visible", self.leader_visible)
        # Which checks the rest
        _ = self.schedule

    @property
    def schedule(self) -> RedrawSchedule:
        """How long a convention is valid, and for whom."""
        return RedrawSchedule(self.K, self.redraw_unit, self.per_copy, self.seed)


# Cached, because all copies need the same convention at the same time unless each has its own
@lru_cache(maxsize=1024)
def convention(m: int, seed: int, *key: int) -> np.ndarray:
    """
    Return one convention of a sequence.

    :param m: Number of cues
    :param seed: Seed of the sequence
    :param key: Position in the sequence, from 0, and for a copy with conventions of its own the copy's seed
    :return: The leader's action at each cue, int64 [m], a permutation drawn uniformly. The array is read-only
    """
    # A seed of its own for each position, as RedrawSchedule has it. That one draws numbers of a list, and a list of all
    # permutations would be long
    drawn = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key)).permutation(m)
    drawn.flags.writeable = False
    return drawn


class ConventionGame:
    """
    ``n_copies`` independent followers that are stepped together, each with a leader that follows the same conventions, or
    with ``per_copy`` conventions of its own.

    Each copy has a random generator of its own, and the cues of an episode are drawn at its start in one call. A copy with a
    given seed therefore behaves the same alone and in a batch.

    :param n_copies: Number of environment copies
    :param config: The rules
    """

    def __init__(self, n_copies: int, config: ConventionConfig):
        self.config = config
        self.n_copies = n_copies
        self.generators = [np.random.default_rng() for _ in range(n_copies)]
        # One cue more than there are steps, since there is an observation after the last step too
        self.cues = np.zeros((n_copies, config.rollout_steps + 1), dtype=np.int64)
        self.time = np.zeros(n_copies, dtype=np.int64)
        # Steps since the copy was last seeded. Unlike time it is not reset with an episode. With it, or with the number of the
        # present episode since then (-1 before the first), the convention is determined
        self.age = np.zeros(n_copies, dtype=np.int64)
        self.episode = np.full(n_copies, -1, dtype=np.int64)
        # The seeds of copies with conventions of their own
        self.copy_seeds = [_own_seed(None) for _ in range(n_copies)]
        self.leader = np.zeros(n_copies, dtype=np.int64)
        # The actions of the last step, for pictures only
        self.follower = self.leader
        self.conventions = np.zeros((n_copies, config.m), dtype=np.int64)
        self._copy = np.arange(n_copies)
        self._schedule, self._by_episodes = config.schedule, config.redraw_unit == "episodes"
        # With episodes, conventions change at resets only
        changes_with_steps = config.K is not None and not self._by_episodes
        self._convention_steps = config.K * config.rollout_steps if changes_with_steps else None  # type: ignore[operator]
        self._update_conventions(self._copy)

    @property
    def cue(self) -> np.ndarray:
        """The cues that the followers observe now, int64 [n_copies]."""
        return self.cues[self._copy, self.time]

    def seed(self, copy: int, seed: int | None) -> None:
        """
        Seed one copy, which starts again with the first convention.

        The convention changes at once. The new random generator is used for cues from the copy's next reset on.

        :param copy: Index of the copy
        :param seed: Seed of its cues, or None for one from the operating system
        """
        self.generators[copy] = np.random.default_rng(seed)
        self.copy_seeds[copy] = _own_seed(seed)
        self.age[copy], self.episode[copy] = 0, -1
        self._update_conventions(np.array([copy]))

    def reset(self, copies: np.ndarray | None = None) -> None:
        """
        Start new episodes. The conventions change only if they are valid for a number of episodes.

        :param copies: Indices of the copies to reset, int [k]. None for all
        """
        chosen = self._copy if copies is None else copies
        self.time[chosen] = 0
        self.episode[chosen] += 1
        if self._by_episodes:
            self._update_conventions(chosen)
        for copy in chosen:
            self.cues[copy] = self.generators[copy].integers(self.config.m, size=self.cues.shape[1])

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Advance all copies by one step and store the leader's actions at the same cues in ``leader``. No copy is reset.

        :param actions: Actions of the followers, int [n_copies], each in [0, m)
        :return: Rewards, float32 [n_copies], and whether the episode has ended, bool [n_copies]
        """
        self.leader, self.follower = self.conventions[self._copy, self.cue], actions
        rewards = (actions == self.leader).astype(np.float32)
        if self.config.rewarded == "last":
            # A convention is valid for K rollouts or episodes
            rewards[self._passed % self.config.K != self.config.K - 1] = 0.0  # type: ignore[operator]
        self.time += 1
        self.age += 1
        if self._convention_steps is not None:
            due = np.flatnonzero(self.age % self._convention_steps == 0)
            if len(due):
                self._update_conventions(due)
        return rewards, self.time >= self.config.rollout_steps

    @property
    def _passed(self) -> np.ndarray:
        """Rollouts or episodes that have ended since the copies were seeded, int64 [n_copies]."""
        return np.maximum(self.episode, 0) if self._by_episodes else self.age // self.config.rollout_steps

    def _update_conventions(self, copies: np.ndarray) -> None:
        passed = self._passed
        for copy in copies:
            key = [self._schedule.number(int(passed[copy]))]
            if self.config.per_copy:
                key.append(self.copy_seeds[copy])
            self.conventions[copy] = convention(self.config.m, self.config.seed, *key)

    def get_state(self, copy: int) -> dict[str, Any]:
        """
        Return everything that determines the following steps of one copy.

        :param copy: Index of the copy
        :return: Copies of arrays and plain data
        """
        return {
            "config": asdict(self.config),
            "cues": self.cues[copy].copy(),
            "generator": self.generators[copy].bit_generator.state,
            **{name: int(getattr(self, name)[copy]) for name in ("time", "age", "leader", "episode", "copy_seeds")},
        }

    def set_state(self, copy: int, state: dict[str, Any]) -> None:
        """
        Restore one copy.

        :param copy: Index of the copy
        :param state: State that ``get_state`` returned for a copy with the same rules
        :raises ValueError: If the rules differ
        """
        # A state that was saved before there were these rules lacks them, and the counts that they need
        check_same_arguments({**asdict(ConventionConfig()), **state["config"]}, asdict(self.config))
        self.cues[copy] = state["cues"]
        self.generators[copy].bit_generator.state = state["generator"]
        for name in ("time", "age", "leader", "episode", "copy_seeds"):
            getattr(self, name)[copy] = state.get(name, 0)
        # The convention is not part of the state, since the rest determines it
        self._update_conventions(np.array([copy]))


def _own_seed(seed: int | None) -> int:
    """Return the seed of a copy's conventions; one that was seeded by nobody has one of the operating system."""
    return int(np.random.SeedSequence().generate_state(1)[0]) if seed is None else seed
