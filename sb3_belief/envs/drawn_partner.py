"""Which partner one copy of an environment has now: arguments and state that tasks of changing teammates have in common."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from sb3_belief.common.checks import check_flag
from sb3_belief.common.redraws import RedrawSchedule


def partner_schedule(redraw_every: int | None, redraw_unit: str, per_copy: bool, partner_seed: int) -> RedrawSchedule:
    """
    Return the schedule that the common arguments of these tasks stand for.

    :param redraw_every: Number of rollouts or episodes for which a partner stays, >= 1. None for one that stays for ever
    :param redraw_unit: ``"rollouts"`` or ``"episodes"``
    :param per_copy: Whether each copy draws by itself
    :param partner_seed: Seed of the draws, >= 0
    :return: The schedule
    :raises ValueError: For any other value, and for ``"episodes"`` without ``per_copy``
    """
    try:
        return RedrawSchedule(redraw_every, redraw_unit, per_copy, partner_seed)
    except ValueError as error:
        given = f"redraw_every={redraw_every!r}, {redraw_unit=}, {per_copy=}, {partner_seed=}"
        raise ValueError(f"Partners cannot be drawn by {given}: {error}") from None


class DrawnPartner:
    """
    The type of partner that one copy has now. It is drawn at the beginning of an episode.

    :param names: Names of the types, which are drawn with equal probability
    :param schedule: How long one stays
    :param rollout_steps: Steps of one copy in a rollout, the learner's ``n_steps``; needed by a schedule of rollouts only
    :param reveal: Whether the learner is told the type
    :raises ValueError: If ``rollout_steps`` is no such number, or a schedule of rollouts lacks it
    """

    def __init__(self, names: Sequence[str], schedule: RedrawSchedule, rollout_steps: int | None, reveal: bool):
        self.names = tuple(names)
        self._schedule, self._rollout_steps = schedule, rollout_steps
        self._by_rollouts = schedule.unit == "rollouts" and schedule.every is not None
        is_count = isinstance(rollout_steps, int) and not isinstance(rollout_steps, bool) and rollout_steps >= 1
        if not (is_count or (rollout_steps is None and not self._by_rollouts)):
            raise ValueError(
                f"rollout_steps={rollout_steps!r} must be an integer >= 1, the learner's n_steps: with redraw_unit='rollouts'"
                " it says how many steps of a copy are a rollout. Without rollouts it may be None."
            )
        check_flag("reveal_partner", reveal)
        self._reveal = reveal
        self._begin(None)

    def _begin(self, seed: int | None) -> None:
        # A copy that nobody has seeded has a seed of the operating system
        self._copy_seed = int(np.random.SeedSequence().generate_state(1)[0]) if seed is None else seed
        self._steps, self._episode, self.index = 0, -1, 0

    @property
    def name(self) -> str:
        """The name of the present type."""
        return self.names[self.index]

    def begin_episode(self, seed: int | None = None) -> None:
        """
        Draw who plays in the episode that begins.

        :param seed: The copy's seed, with which draws begin anew. None in later episodes
        """
        if seed is not None:
            self._begin(seed)
        self._episode += 1
        passed = self._steps // (self._rollout_steps or 1) if self._by_rollouts else self._episode
        self.index = self._schedule.draw(self._schedule.number(passed), (1.0,) * len(self.names), self._copy_seed)

    def count_step(self) -> None:
        """Count a step of the copy."""
        self._steps += 1

    @property
    def revealed(self) -> int:
        """Entries that the type takes in the learner's observation: none unless it is revealed."""
        return len(self.names) if self._reveal else 0

    def told(self, observation: np.ndarray) -> np.ndarray:
        """
        Return what the learner observes.

        :param observation: Its own observation, [width]
        :return: The same, and where the type is revealed its one-hot code behind it, [width + n_types]
        """
        if not self._reveal:
            return observation
        code = np.zeros(len(self.names), dtype=observation.dtype)
        code[self.index] = 1
        return np.concatenate([observation, code])

    def get_state(self) -> dict[str, int]:
        """Return everything that determines who is there now and later."""
        return {
            "copy_seed": self._copy_seed,
            "steps": self._steps,
            "episode": self._episode,
            "index": self.index,
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """
        Restore a state.

        :param state: What ``get_state`` returned
        """
        self._copy_seed, self._steps = state["copy_seed"], state["steps"]
        self._episode, self.index = state["episode"], state["index"]
