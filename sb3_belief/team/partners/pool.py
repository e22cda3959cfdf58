"""Pools of partners, of which another is met from time to time."""

import math
from collections.abc import Iterable, Mapping, Sequence
from copy import copy as copied
from dataclasses import replace
from numbers import Real
from typing import Any

import numpy as np

from sb3_belief.common.redraws import RedrawSchedule
from sb3_belief.team.fixed_partners.partners import PartnerLike


class PartnerPool:
    """
    Partners of which one is drawn at a time, by a schedule that a seed determines.

    One pool that is given for several agents is drawn once for all of them: its members act for each of these agents. A member
    is a partner as ``AgentEnv`` takes it, the path of a saved team (whose agent of the same name acts), or a dict of a partner
    for each of these agents.

    :param members: The partners by name. Names show in the log and in ``info["partner"]``, and never reach a learner
    :param redraw_every: Number of rollouts or episodes for which a partner stays, >= 1; None for one that stays for ever
    :param redraw_unit: ``"episodes"`` of a copy, or ``"rollouts"`` of the team that learns. A pool that counts rollouts keeps
        its first draw in an environment in which no team learns
    :param per_copy: Whether each copy draws by itself; False for the same partner in all copies, which needs rollouts
    :param weights: How often each member is drawn relative to the others, in their order, >= 0; None for equally often
    :param seed: Seed of the draws, >= 0
    :param held_out: Names of members that are met only in evaluations, see :meth:`evaluation`
    :raises TypeError: If ``members`` or ``weights`` are of an unsuitable type
    :raises ValueError: If there is no member to be drawn, or for a name, weight or schedule that cannot be
    """

    def __init__(
        self,
        members: Mapping[str, PartnerLike | Mapping[str, PartnerLike]],
        redraw_every: int | None = 1,
        redraw_unit: str = "episodes",
        per_copy: bool = True,
        weights: Sequence[float] | None = None,
        seed: int = 0,
        held_out: Iterable[str] = (),
    ):
        if not isinstance(members, Mapping):
            raise TypeError(f"The members of a pool are a dict {{name: partner}}, not {type(members).__name__}.")
        if not members:
            raise ValueError("The pool is empty: it needs at least one member, {name: partner}.")
        for name in members:
            if not (isinstance(name, str) and name):
                raise ValueError(f"A member of the pool has the name {name!r}; it must be a text that is not empty.")
        self.members = dict(members)
        self.names = list(self.members)
        self.schedule = RedrawSchedule(redraw_every, redraw_unit, per_copy, seed)
        if not isinstance(held_out, Iterable):
            raise TypeError(f"held_out of a pool is a list of names of members, not {held_out!r}.")
        self.held_out = [held_out] if isinstance(held_out, str) else list(held_out)
        unknown = [name for name in self.held_out if name not in self.members]
        if unknown:
            raise ValueError(f"{unknown} are held out but not in the pool, which has {self.names}.")
        if len(set(self.held_out)) == len(self.names):
            raise ValueError(f"All members of the pool are held out, so none is left to train with: {self.names}.")
        self.weights = _checked_weights(weights, self.names)
        for which, names in (("not held out", self._training_names), ("held out", self.held_out)):
            if names and not any(self.weights[name] for name in names):
                raise ValueError(f"All members of the pool that are {which} have the weight 0, so none can be drawn: {names}.")

    @property
    def _training_names(self) -> list[str]:
        return [name for name in self.names if name not in self.held_out]

    def training(self) -> "PartnerPool":
        """Return the pool without what is held out."""
        return self._only(self._training_names, self.schedule)

    def evaluation(self) -> "PartnerPool":
        """
        Return the pool of evaluations: the members that are held out, or all of them if none is.

        In each copy another one is drawn for each episode, whatever the schedule of training is: what an agent would learn of
        a partner who stays for several episodes does not show, see ``sb3-belief adapt`` for that.
        """
        names = [name for name in self.names if name in self.held_out] or self.names
        return self._only(names, RedrawSchedule(1, "episodes", True, self.schedule.seed))

    def with_seed(self, seed: int) -> "PartnerPool":
        """
        Return the pool with other draws.

        :param seed: Seed of the draws, >= 0
        """
        pool = copied(self)
        pool.schedule = replace(self.schedule, seed=seed)
        return pool

    def _only(self, names: Sequence[str], schedule: RedrawSchedule) -> "PartnerPool":
        return PartnerPool(
            {name: self.members[name] for name in names},
            schedule.every,
            schedule.unit,
            schedule.per_copy,
            [self.weights[name] for name in names],
            schedule.seed,
        )


def _checked_weights(weights: Any, names: list[str]) -> dict[str, float]:
    if weights is None:
        return dict.fromkeys(names, 1.0)
    if isinstance(weights, str) or not isinstance(weights, (Sequence, np.ndarray)):
        raise TypeError(f"The weights of a pool are a list of one number for each member, not {weights!r}.")
    if len(weights) != len(names):
        raise ValueError(f"The pool has {len(names)} members, {names}, but {len(weights)} weights: give one for each.")
    for weight in weights:
        if not isinstance(weight, Real) or isinstance(weight, bool) or not 0 <= float(weight) < math.inf:
            raise ValueError(f"{weight!r} is no weight of a member: weights are numbers of at least 0, and not all are 0.")
    return {name: float(weight) for name, weight in zip(names, weights, strict=True)}


class PoolDraws:
    """
    Who of a pool is present in each copy of an environment.

    :param pool: The pool, of which all members can be drawn
    :param n_envs: Number of copies
    :param stream: Number of the pool in its environment: pools with the same seed draw apart
    """

    def __init__(self, pool: PartnerPool, n_envs: int, stream: int = 0):
        self.names = pool.names
        self._stream = stream
        self._schedule, self._weights = pool.schedule, list(pool.weights.values())
        #: Index of the member in each copy, int ``[n_envs]``
        self.present = np.zeros(n_envs, dtype=int)
        self.restart(list(range(n_envs)))

    def restart(self, copy_seeds: Sequence[int]) -> None:
        """
        Begin with the first draws again.

        :param copy_seeds: Seed of each copy, for draws of their own
        """
        self._copy_seeds = list(copy_seeds)
        self._rollouts, self._episodes = 0, [0] * len(copy_seeds)
        self._draw(range(len(copy_seeds)))

    def begin_rollout(self) -> None:
        """Count a rollout that begins, and draw again where one is due."""
        self._rollouts += 1
        if self._schedule.unit == "rollouts":
            self._draw(range(len(self.present)))

    def end_episodes(self, copies: Iterable[int]) -> None:
        """
        Count an episode that has ended in some copies, and draw again where one is due.

        :param copies: Numbers of the copies
        """
        copies = list(copies)
        for copy in copies:
            self._episodes[copy] += 1
        if self._schedule.unit == "episodes":
            self._draw(copies)

    def _draw(self, copies: Iterable[int]) -> None:
        for copy in copies:
            # The first rollout that begins ends none
            passed = self._episodes[copy] if self._schedule.unit == "episodes" else max(self._rollouts - 1, 0)
            number = self._schedule.number(passed)
            self.present[copy] = self._schedule.draw(number, self._weights, self._copy_seeds[copy], self._stream)

    def get_state(self) -> dict[str, Any]:
        """Return how far the draws are, as plain data."""
        return {
            "names": list(self.names),
            "copy_seeds": list(self._copy_seeds),
            "rollouts": self._rollouts,
            "episodes": list(self._episodes),
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """
        Go on with the draws of another environment with the same pool.

        :param state: As :meth:`get_state` returned it
        :raises ValueError: If the pool had other members
        """
        if state["names"] != self.names:
            raise ValueError(
                f"The saved state is of a pool of the members {state['names']}, but this one has {self.names}: give the same"
                " partners."
            )
        self._copy_seeds, self._rollouts, self._episodes = state["copy_seeds"], state["rollouts"], list(state["episodes"])
        self._draw(range(len(self.present)))
