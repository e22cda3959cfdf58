"""Whose actions of a joint step each agent could observe."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from sb3_belief.vec_env.validation import place


class VisibleOthers:
    """
    Combines who is in play with what an environment says of who can observe whom.

    :param agents: Names of the agents
    :param scripted: Names of the scripted others
    :param visibility: The environment's ``visibility()``; None if all agents in play observe each other
    :param while_inactive: Whether agents observe others also in steps in which they are inactive, because they wait for their
        turn. The environment's ``visibility()`` says whether they are there at all
    """

    def __init__(
        self,
        agents: Sequence[str],
        scripted: Sequence[str],
        visibility: Callable[[], Any] | None,
        while_inactive: bool = False,
    ):
        self._while_inactive = while_inactive
        self._agents, self._scripted, self._visibility = list(agents), list(scripted), visibility
        everyone = range(len(agents) + len(scripted))
        # Row i lists the others of agent i: the other agents in order, then the scripted others
        rows = [[j for j in everyone if j != i] for i in range(len(agents))]
        self._others = np.array(rows, dtype=int).reshape(len(agents), -1)
        self._names = dict.fromkeys(agents).keys()
        self._scripted_in_play = np.ones(len(scripted), dtype=bool)
        #: What all see while all are in play, if the environment does not say more; read-only
        self.all_visible: np.ndarray | None = None
        if visibility is None:
            self.all_visible = np.ones(self._others.shape, dtype=bool)
            self.all_visible.flags.writeable = False

    def rows(self, active: np.ndarray, copy: int, step: int) -> np.ndarray:
        """
        Return whose actions each agent could observe.

        :param active: Which agents are active, bool ``[n]``
        :param copy: Number of the environment copy, for error messages
        :param step: Number of the step, for error messages
        :return: bool ``[n, n_others]``
        :raises ValueError: If ``visibility()`` returns something else than flags by agent
        """
        # An inactive agent is not observed, and mostly observes nobody. Scripted others count as in play; an environment in
        # which they cannot always be observed says so by its visibility()
        in_play = np.concatenate([active, self._scripted_in_play])[self._others] if self._scripted else active[self._others]
        if not self._while_inactive:
            in_play = in_play & active[:, None]
        if self._visibility is None:
            return in_play
        rows = self._visibility()
        unseen = np.zeros(self._others.shape[1], dtype=bool)
        # Checking each row would take longer than all the rest, so only a failure leads to a search for its cause
        try:
            if rows.keys() <= self._names:
                given = [rows.get(agent, unseen) for agent in self._agents]
                return np.array(given, dtype=bool).reshape(in_play.shape) & in_play
        except (AttributeError, TypeError, ValueError):
            pass
        raise self._fault(rows, place(copy, step))

    def _fault(self, rows: Any, where: str) -> ValueError:
        """Return the error that says what is wrong with the result of ``visibility()``."""
        n_others = self._others.shape[1]
        scripted = f" and then the scripted others {self._scripted}" if self._scripted else ""
        rule = (
            f"It must return a dict with {n_others} flags for each agent, the other agents in the order of possible_agents"
            f"{scripted}; the agents are {self._agents}."
        )
        if not isinstance(rows, Mapping):
            return ValueError(f"visibility() returned a {type(rows).__name__} {where}. {rule}")
        for agent, row in rows.items():
            if agent not in self._names:
                return ValueError(f"visibility() has an entry for {agent!r} {where}, which is not an agent. {rule}")
            if np.size(row) != n_others:
                return ValueError(f"visibility() has {np.size(row)} flags for {agent!r} {where}. {rule}")
        return ValueError(f"visibility() returned something that cannot be read as flags {where}: {dict(rows)}. {rule}")
