"""
The rules of the switching conventions, for many copies at once.

:class:`ConventionGame` knows nothing of agents' names, dictionaries or Gym interfaces: arrays [n_copies] go in and out.
"""

from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any

import numpy as np

REWARDED = ("always", "last")


@dataclass(frozen=True)
class ConventionConfig:
    """
    :param m: number of cues and of actions, >= 2
    :param K: number of rollouts for which a convention lives, >= 1; None: for ever
    :param rollout_steps: steps of one copy in a rollout, >= 1; also the length of an episode
    :param rewarded: in which of a convention's rollouts the reward counts: ``"always"``, or ``"last"`` for the last only
    :param leader_visible: whether the leader's actions can be observed
    :param seed: of the sequence of conventions, >= 0
    :raises ValueError: for a value outside of these
    """

    m: int = 4
    K: int | None = 5
    rollout_steps: int = 16
    rewarded: str = "always"
    leader_visible: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        for name, value, least, meaning in (
            ("m", self.m, 2, "the number of cues and actions"),
            ("K", 1 if self.K is None else self.K, 1, "for how many rollouts a convention lives, or None for ever"),
            ("rollout_steps", self.rollout_steps, 1, "the n_steps of the learner"),
            ("seed", self.seed, 0, "which decides the sequence of conventions"),
        ):
            if not isinstance(value, int) or isinstance(value, bool) or value < least:
                raise ValueError(f"{name}={value!r} must be an integer >= {least}: {meaning}.")
        if self.rewarded not in REWARDED:
            raise ValueError(f"rewarded={self.rewarded!r} is not one of {', '.join(map(repr, REWARDED))}.")
        if self.rewarded == "last" and self.K is None:
            raise ValueError(
                "rewarded='last' with K=None would never reward: a convention that lives for ever has no last rollout."
                " Give K a number, or use rewarded='always'."
            )
        if not isinstance(self.leader_visible, bool):
            raise ValueError(f"leader_visible={self.leader_visible!r} must be True or False.")


# The copies ask for the same ones at the same time
@lru_cache(maxsize=128)
def convention(m: int, seed: int, number: int) -> np.ndarray:
    """
    :param m: number of cues
    :param seed: of the sequence
    :param number: which convention of the sequence, from 0
    :return: int64 [m], a uniformly drawn permutation: what the leader plays at each cue; read-only
    """
    drawn = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number,))).permutation(m)
    drawn.flags.writeable = False
    return drawn


class ConventionGame:
    """
    ``n_copies`` followers, each beside the same leader. Each copy has a random generator of its own, and the cues of an
    episode are drawn at its start in one call: a copy therefore lives the same life alone and in a batch.

    :param n_copies: number of copies
    :param config: the rules
    """

    def __init__(self, n_copies: int, config: ConventionConfig):
        self.config = config
        self.n_copies = n_copies
        self.generators = [np.random.default_rng() for _ in range(n_copies)]
        # One more than there are steps: the last is the observation after the last step
        self.cues = np.zeros((n_copies, config.rollout_steps + 1), dtype=np.int64)
        self.time = np.zeros(n_copies, dtype=np.int64)
        self.age = np.zeros(n_copies, dtype=np.int64)
        self.leader = np.zeros(n_copies, dtype=np.int64)
        self.conventions = np.zeros((n_copies, config.m), dtype=np.int64)
        self._copy = np.arange(n_copies)
        self._life = None if config.K is None else config.K * config.rollout_steps
        self._renew(self._copy)

    @property
    def cue(self) -> np.ndarray:
        """
        :return: int64 [n_copies], what the followers see now
        """
        return self.cues[self._copy, self.time]

    def seed(self, copy: int, seed: int | None) -> None:
        """
        Let a copy begin its life anew: with the first convention, and from its next reset on with cues from the seed.

        :param copy: number of the copy
        :param seed: of its cues
        """
        self.generators[copy] = np.random.default_rng(seed)
        self.age[copy] = 0
        self._renew(np.array([copy]))

    def reset(self, copies: np.ndarray | None = None) -> None:
        """
        Start new episodes. Conventions stay as they are: the copies' lives go on.

        :param copies: int [k], which copies; None: all
        """
        chosen = self._copy if copies is None else copies
        self.time[chosen] = 0
        for copy in chosen:
            self.cues[copy] = self.generators[copy].integers(self.config.m, size=self.cues.shape[1])

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        :param actions: int [n_copies], of the followers, each in [0, m)
        :return: rewards float32 [n_copies], and bool [n_copies], whose episode has come to its end; what the leader did at
            the same cues is ``leader``
        """
        self.leader = self.conventions[self._copy, self.cue]
        rewards = (actions == self.leader).astype(np.float32)
        if self.config.rewarded == "last":
            rewards[self.age // self.config.rollout_steps % self.config.K != self.config.K - 1] = 0.0  # type: ignore[operator]
        self.time += 1
        self.age += 1
        if self._life is not None:
            due = np.flatnonzero(self.age % self._life == 0)
            if len(due):
                self._renew(due)
        return rewards, self.time >= self.config.rollout_steps

    def _renew(self, copies: np.ndarray) -> None:
        for copy in copies:
            number = 0 if self._life is None else int(self.age[copy]) // self._life
            self.conventions[copy] = convention(self.config.m, self.config.seed, number)

    def get_state(self, copy: int) -> dict[str, Any]:
        """
        :param copy: number of the copy
        :return: all that decides its future, as arrays and plain data (copies)
        """
        return {
            "config": asdict(self.config),
            "cues": self.cues[copy].copy(),
            "generator": self.generators[copy].bit_generator.state,
            **{name: int(getattr(self, name)[copy]) for name in ("time", "age", "leader")},
        }

    def set_state(self, copy: int, state: dict[str, Any]) -> None:
        """
        :param copy: number of the copy
        :param state: what ``get_state`` returned, of a copy with the same rules
        :raises ValueError: if the rules differ
        """
        rules = asdict(self.config)
        if state["config"] != rules:
            raise ValueError(
                f"The state is of an environment with {state['config']}, this one has {rules}: a state can only be restored in"
                " an environment with the same arguments."
            )
        self.cues[copy] = state["cues"]
        self.generators[copy].bit_generator.state = state["generator"]
        for name in ("time", "age", "leader"):
            getattr(self, name)[copy] = state[name]
        self._renew(np.array([copy]))
