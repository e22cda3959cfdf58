"""The partners of one agent, which act in many copies of an environment at once."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_belief.team.agent_models import agent_seed
from sb3_belief.team.fixed_partners.partners import Partner
from sb3_belief.team.partners.stacked import StackedMembers, can_be_stacked
from sb3_belief.team.predictor import Predictor
from sb3_belief.vec_env.observation_forms import map_parts


class CopiesPartner(Partner):
    """A partner that acts for several copies of an environment in one pass, with a recurrent state for each."""

    # The copies of which the recurrent state is kept
    _copies = np.zeros(0, dtype=int)

    @property
    def own_predictor(self) -> Predictor | None:
        """What it predicts with, if that is a model of its own."""
        return self._predictor if self._owns_model else None

    def act_for(self, copies: np.ndarray, obs: Any, starts: np.ndarray, masks: np.ndarray | None) -> np.ndarray:
        """
        Choose the agent's actions in some copies.

        :param copies: Their numbers, in order, int ``[n]``
        :param obs: The agent's observations in them, ``[n, ...]``
        :param starts: Where its return ended at the last step, bool ``[n]``
        :param masks: Its possible actions, bool ``[n, k]``; None if the environment has no masks for it
        :return: The actions, ``[n, ...]``
        :raises TypeError: If ``predict`` does not return actions and a state, or a state whose copies cannot be told apart
        """
        if self._predictor is None:
            return self._function.several(obs, masks, self.rng.generator(), len(copies))
        if not np.array_equal(copies, self._copies):
            starts = starts | ~np.isin(copies, self._copies)
            self._keep_state_of(copies)
        actions, self._state = self._predict(obs, self._state, starts, masks)
        return actions

    def _keep_state_of(self, copies: np.ndarray) -> None:
        """Have the recurrent state be that of these copies, with zeros for those in which the partner has not acted yet."""
        before, self._copies = self._copies, copies
        if self._state is None or not np.isin(copies, before).any():
            self._state = None
            return
        parts: list[np.ndarray] = []
        for part in self._state:
            # As sb3-contrib's recurrent policies have it
            if not (isinstance(part, np.ndarray) and part.ndim >= 2 and part.shape[1] == len(before)):
                raise TypeError(
                    f"The partner {self._name!r} keeps a state of which the copies cannot be told apart: in a pool whose"
                    " members differ among copies it must be a tuple of arrays [layers, n_copies, ...], as that of"
                    " RecurrentPPO."
                )
            rows = np.zeros((part.shape[0], len(copies), *part.shape[2:]), dtype=part.dtype)
            _, here, there = np.intersect1d(copies, before, assume_unique=True, return_indices=True)
            rows[:, here] = part[:, there]
            parts.append(rows)
        self._state = tuple(parts)

    def reset(self, seed: int | None = None) -> None:
        super().reset(seed)
        self._copies = np.zeros(0, dtype=int)

    def leave(self, copies: np.ndarray) -> None:
        """
        Have it start anew where it acts next in these copies.

        :param copies: Their numbers
        """
        stays = ~np.isin(self._copies, copies)
        if not stays.all():
            self._keep_state_of(self._copies[stays])

    def get_state(self) -> dict[str, Any]:
        """Return random numbers and recurrent state, as plain data."""
        return {"rng": self.rng.get(), "state": self._state, "copies": self._copies}

    def set_state(self, state: dict[str, Any]) -> None:
        """
        Go on where another partner of the same kind was.

        :param state: As :meth:`get_state` returned it
        """
        self.rng.set(state["rng"])
        self._state, self._copies = state["state"], state["copies"]


class Seat:
    """
    One agent that partners act for: a single one, or in each copy the present member of a pool.

    :param agent: Name of the agent
    :param index: Its place in the environment's ``possible_agents``
    :param space: Its action space
    :param members: The partners, of which exactly one acts in each copy
    :param n_envs: Number of copies
    """

    def __init__(self, agent: str, index: int, space: spaces.Space, members: Sequence[CopiesPartner], n_envs: int):
        self.agent, self._index, self._members = agent, index, list(members)
        self._space, self._shape = space, (n_envs, *(space.shape or ()))
        self._all = np.arange(n_envs)
        #: The agent's observations, ``[n_envs, ...]``
        self.obs: Any = None
        self._starts = np.ones(n_envs, dtype=bool)
        self._present = np.full(n_envs, -1)
        # Who is present, with the numbers of its copies
        self._groups: list[tuple[int, np.ndarray]] = []
        predictors = [member.own_predictor for member in self._members]
        self._stacked = StackedMembers(predictors) if can_be_stacked(predictors) else None  # type: ignore[arg-type]

    def reset(self, obs: Any, seed: int | None = None) -> None:
        """
        Begin episodes in all copies.

        :param obs: The agent's observations, ``[n_envs, ...]``
        :param seed: Seed of the environment's first copy, from which those of the partners follow; None lets their random
            numbers go on
        """
        own_seed = None if seed is None else agent_seed(seed, self._index)
        for k, member in enumerate(self._members):
            # The first has the seed that it would have in an AgentEnv
            member.reset(own_seed if own_seed is None or k == 0 else agent_seed(own_seed, k))
        self.obs, self._starts = obs, np.ones(len(self._all), dtype=bool)

    def act(self, present: np.ndarray, masks: np.ndarray | None) -> np.ndarray:
        """
        Choose the agent's actions, in one pass for all members that are present if they can be stacked, with the first one's
        random numbers, or in one for each.

        :param present: Index of the member in each copy, int ``[n_envs]``
        :param masks: The agent's possible actions, bool ``[n_envs, k]``, or None
        :return: The actions, ``[n_envs, ...]``
        :raises ValueError: If they are none of the agent's actions
        """
        if not np.array_equal(present, self._present):
            self._replace(present)
        if len(self._groups) == 1:
            return self._act_of(self._groups[0][0], self._all, self.obs, self._starts, masks)
        if self._stacked is not None:
            first = self._members[0]
            first.rng.resume()
            actions = self._stacked.act(present, self.obs, masks, first.deterministic)
            first.rng.suspend()
            return actions
        parts = [
            self._act_of(k, rows, _rows_of(self.obs, rows), self._starts[rows], None if masks is None else masks[rows])
            for k, rows in self._groups
        ]
        return np.concatenate(parts)[np.argsort(np.concatenate([rows for _, rows in self._groups]))]

    def _replace(self, present: np.ndarray) -> None:
        """Group the copies by who is present, and have those who come again after others start anew."""
        changed = present != self._present
        for k, member in enumerate(self._members):
            member.leave(np.flatnonzero(changed & (self._present == k)))
        self._group(present)

    def _group(self, present: np.ndarray) -> None:
        self._present = present.copy()
        self._groups = [(int(k), np.flatnonzero(present == k)) for k in np.unique(present)]

    def _act_of(self, k: int, copies: np.ndarray, obs: Any, starts: np.ndarray, masks: np.ndarray | None) -> np.ndarray:
        member = self._members[k]
        member.rng.resume()
        actions = member.act_for(copies, obs, starts, masks)
        member.rng.suspend()
        wanted = (len(copies), *self._shape[1:])
        if actions.shape != wanted:
            raise ValueError(
                f"The partner {self.agent!r} must return actions of the shape {wanted}, one for each of {len(copies)} copies,"
                f" got {actions.shape}."
            )
        if not _is_of(actions, self._space):
            got = ", ".join(list(dict.fromkeys(map(str, actions.tolist())))[:20])
            raise ValueError(f"The partner {self.agent!r} must return actions of its action space, {self._space}, got {got}.")
        return actions

    def observe(self, obs: Any, ended: np.ndarray) -> None:
        """
        Take the agent's part of a step.

        :param obs: Its observations, ``[n_envs, ...]``
        :param ended: Where its own return has ended or been cut off, bool ``[n_envs]``
        """
        self.obs, self._starts = obs, ended

    def get_state(self) -> dict[str, Any]:
        """Return what decides how the partners go on, as plain data."""
        members = [member.get_state() for member in self._members]
        return {"obs": self.obs, "starts": self._starts, "present": self._present, "members": members}

    def set_state(self, state: dict[str, Any]) -> None:
        """
        Go on where the partners of another environment were.

        :param state: As :meth:`get_state` returned it
        """
        self.obs, self._starts = state["obs"], state["starts"]
        self._group(state["present"])
        for member, saved in zip(self._members, state["members"], strict=True):
            member.set_state(saved)


def _is_of(actions: np.ndarray, space: spaces.Space) -> bool:
    """Return whether actions are numbers of a space's kind, and within it where it is finite."""
    if isinstance(space, spaces.Box):
        return actions.dtype.kind in "iufb"
    if actions.dtype.kind not in "iub":
        return False
    if isinstance(space, spaces.Discrete):
        low, high = space.start, space.start + space.n
    elif isinstance(space, spaces.MultiDiscrete):
        low, high = space.start, space.start + space.nvec
    else:
        low, high = 0, 2
    return bool(((actions >= low) & (actions < high)).all())


def _rows_of(obs: Any, rows: np.ndarray) -> Any:
    return map_parts(lambda part: part[rows], obs)
