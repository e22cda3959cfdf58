"""Battles of SMAX with numpy arrays outside: what the single environment and the batch of copies have in common."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sb3_belief.envs.adapters.smax.program import BattleConfig, View, battle_program


class BattleStep(NamedTuple):
    """
    A step of n copies with A agents.

    :param rewards: the team's, float32 [n]
    :param ended: bool [n]
    :param won: bool [n]
    :param cut: ended by the step limit, bool [n]
    :param active: who was alive when it acted, bool [n, A]
    :param visible: whose action of this step each agent could observe, bool [n, A, A-1]
    """

    rewards: np.ndarray
    ended: np.ndarray
    won: np.ndarray
    cut: np.ndarray
    active: np.ndarray
    visible: np.ndarray


class Battles:
    """
    ``n_copies`` battles with one random generator each, so that a copy's life depends on its own seed alone.

    ``observations`` float32 [A, n, width] and ``masks`` bool [A, n, k] are those of the next action.

    :param n_copies: number of copies, at least 1
    :param config: the rules
    """

    def __init__(self, n_copies: int, config: BattleConfig):
        self.n_copies, self.config = n_copies, config
        self._program = battle_program(config)
        self.agents, self.stop = self._program.agents, self._program.stop
        self.n_actions, self.width, self.look = self._program.n_actions, self._program.width, self._program.look
        self._keys: Any = np.random.SeedSequence().generate_state(2 * n_copies).reshape(n_copies, 2)
        self._states: Any = None
        # Who asks before the first reset learns that nothing can be done
        n_agents = len(self.agents)
        self.observations = np.zeros((n_agents, n_copies, self.width), dtype=np.float32)
        self.masks = np.zeros((n_agents, n_copies, self.n_actions), dtype=bool)
        self.masks[:, :, self.stop] = True
        self._alive = np.ones((n_copies, n_agents), dtype=bool)

    def seed(self, copy: int, seed: int) -> None:
        """
        :param copy: whose random generator is restarted
        :param seed: not negative
        """
        keys = np.array(self._keys)
        # jax.random.PRNGKey(seed), which does not take seeds above 2**31 without 64-bit arrays
        keys[copy] = seed >> 32 & 0xFFFFFFFF, seed & 0xFFFFFFFF
        self._keys = keys

    def reset(self, copies: np.ndarray | None = None) -> None:
        """
        :param copies: indices of the copies in which a new battle begins; None: all
        """
        if copies is None:
            self._keys, self._states, view = self._program.begin(self._keys)
            self._look(view)
            return
        chosen = np.zeros(self.n_copies, dtype=bool)
        chosen[copies] = True
        new_keys, new_states, view = self._program.begin(self._keys)
        self._keys, self._states = self._program.choose(chosen, (new_keys, new_states), (self._keys, self._states))
        # New arrays, because a model may have kept the others
        self.observations, self.masks = self.observations.copy(), self.masks.copy()
        self.observations[:, copies] = np.asarray(view.observations)[:, copies]
        self.masks[:, copies] = np.asarray(view.masks)[:, copies]
        self._alive = self._alive.copy()
        self._alive[copies] = True

    def step(self, actions: np.ndarray) -> BattleStep:
        """
        What the masks forbid is not sent to SMAX: such an agent stops. So do the dead, whatever they choose.

        :param actions: int [n, A], each in 0 .. n_actions-1
        :return: what happened; no battle is reset
        """
        possible = np.take_along_axis(self.masks, actions.T[:, :, None], axis=2)[:, :, 0].T
        legal = np.where(possible, actions, self.stop).astype(np.int32)
        active = self._alive
        self._keys, self._states, view, outcome = self._program.advance(self._keys, self._states, legal)
        self._look(view)
        rewards, ended, won, cut = (np.array(values) for values in outcome)
        return BattleStep(rewards, ended, won, cut, active, np.array(view.visible))

    def _look(self, view: View) -> None:
        # One copy: what comes from jax is read-only, which PyTorch does not take
        self.observations, self.masks = np.array(view.observations), np.array(view.masks)
        self._alive = np.array(view.alive)

    def units(self, copy: int) -> dict[str, np.ndarray]:
        """
        :param copy: which battle
        :return: of all units, the allies first: positions [m, 2], types [m], health [m] and alive [m]
        """
        units = self._states.state
        return {name: np.array(getattr(units, f"unit_{name}")[copy]) for name in ("positions", "types", "health", "alive")}

    def get_states(self) -> list[dict[str, Any]]:
        """
        :return: for each copy all that decides how it goes on
        :raises ValueError: before the first ``reset``
        """
        if self._states is None:
            raise ValueError("There is no state before the first reset().")
        leaves = [np.asarray(leaf) for leaf in self._program.leaves(self._states)]
        keys = np.asarray(self._keys)
        return [
            {
                "map_name": self.config.map_name,
                "key": keys[copy].copy(),
                "leaves": [leaf[copy].copy() for leaf in leaves],
                "observations": self.observations[:, copy].copy(),
                "masks": self.masks[:, copy].copy(),
                "alive": self._alive[copy].copy(),
            }
            for copy in range(self.n_copies)
        ]

    def set_states(self, states: Sequence[dict[str, Any]]) -> None:
        """
        :param states: one for each copy, as ``get_states`` returned them
        :raises ValueError: if the number of copies or the map differs
        """
        if len(states) != self.n_copies:
            raise ValueError(f"Got the states of {len(states)} copies for {self.n_copies}.")
        wrong = [state["map_name"] for state in states if state["map_name"] != self.config.map_name]
        if wrong:
            raise ValueError(f"Got a state of smax/{wrong[0]} for smax/{self.config.map_name}.")
        self._states = self._program.states([np.stack(leaf) for leaf in zip(*(s["leaves"] for s in states), strict=True)])
        self._keys = np.stack([state["key"] for state in states])
        self.observations = np.stack([state["observations"] for state in states], axis=1)
        self.masks = np.stack([state["masks"] for state in states], axis=1)
        self._alive = np.stack([state["alive"] for state in states])

    # Compiled functions cannot be copied or pickled, but they are the same for all with these rules

    def __getstate__(self) -> dict[str, Any]:
        states = None if self._states is None else self.get_states()
        return {"n_copies": self.n_copies, "config": self.config, "keys": np.array(self._keys), "states": states}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["n_copies"], state["config"])  # type: ignore[misc]
        self._keys = state["keys"]
        if state["states"] is not None:
            self.set_states(state["states"])
