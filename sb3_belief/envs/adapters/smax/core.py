"""Battles of SMAX with numpy arrays as inputs and outputs, for the single environment and the vectorised one."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sb3_belief.envs.adapters.smax.program import BattleConfig, BattleView, battle_program


class BattleStep(NamedTuple):
    """
    Result of one step of n copies with A agents.

    :param rewards: Team rewards, float32 [n]
    :param ended: Whether the battle has ended, bool [n]
    :param won: Whether it was won, bool [n]
    :param cut: Whether it ended by the step limit, bool [n]
    :param active: Whether each agent was alive when it acted, bool [n, A]
    :param alive: Whether it is alive after the step, bool [n, A]
    :param visible: Whose action of this step each agent could observe, bool [n, A, A-1]
    """

    rewards: np.ndarray
    ended: np.ndarray
    won: np.ndarray
    cut: np.ndarray
    active: np.ndarray
    alive: np.ndarray
    visible: np.ndarray


class Battles:
    """
    ``n_copies`` independent battles that are stepped together.

    Each copy has a random generator of its own, so what happens in it depends on its own seed and actions alone. The
    attributes ``observations``, float32 [A, n, width], and ``masks``, bool [A, n, k], are those for the next action.

    :param n_copies: Number of environment copies, at least 1
    :param config: The rules
    """

    def __init__(self, n_copies: int, config: BattleConfig):
        self.n_copies, self.config = n_copies, config
        self._program = battle_program(config)
        self.agents, self.stop = self._program.agents, self._program.stop
        self.n_actions, self.width, self.drawing = self._program.n_actions, self._program.width, self._program.drawing
        self.state_width = self._program.state_width
        self._keys: Any = np.random.SeedSequence().generate_state(2 * n_copies).reshape(n_copies, 2)
        self._states: Any = None
        # Before the first reset only "stop" is possible
        n_agents = len(self.agents)
        self.observations = np.zeros((n_agents, n_copies, self.width), dtype=np.float32)
        self.masks = np.zeros((n_agents, n_copies, self.n_actions), dtype=bool)
        self.masks[:, :, self.stop] = True
        self._alive = np.ones((n_copies, n_agents), dtype=bool)

    @property
    def action_names(self) -> tuple[str, ...]:
        """The names of the actions: four directions, "stop", and one for each enemy."""
        moves = ("up", "right", "down", "left", "stop")
        return (*moves, *(f"attack {enemy}" for enemy in range(self.n_actions - len(moves))))

    def seed(self, copy: int, seed: int) -> None:
        """
        Seed the random generator of one copy. The seed takes effect at its next reset.

        :param copy: Index of the copy
        :param seed: Seed, >= 0
        """
        keys = np.array(self._keys)
        # The same as jax.random.PRNGKey(seed), which does not accept seeds of 2**31 and more without 64-bit arrays
        keys[copy] = seed >> 32 & 0xFFFFFFFF, seed & 0xFFFFFFFF
        self._keys = keys

    def reset(self, copies: np.ndarray | None = None) -> None:
        """
        Start new battles.

        :param copies: Indices of the copies to reset, int [k]. None for all
        """
        if copies is None:
            self._keys, self._states, view = self._program.begin(self._keys)
            self._set_view(view)
            return
        # A battle begins in every copy, and the results of the others are dropped, random generators included. A compiled
        # function has fixed shapes, so one for k copies would have to be compiled for each k
        chosen = np.zeros(self.n_copies, dtype=bool)
        chosen[copies] = True
        new_keys, new_states, view = self._program.begin(self._keys)
        self._keys, self._states = self._program.choose(chosen, (new_keys, new_states), (self._keys, self._states))
        # New arrays, because a model may have kept the old ones
        self.observations, self.masks = self.observations.copy(), self.masks.copy()
        self.observations[:, copies] = np.asarray(view.observations)[:, copies]
        self.masks[:, copies] = np.asarray(view.masks)[:, copies]
        self._alive = self._alive.copy()
        self._alive[copies] = True

    def step(self, actions: np.ndarray) -> BattleStep:
        """
        Advance all copies by one step. No copy is reset.

        An action that the mask forbids is replaced by "stop". That includes all other actions of dead agents.

        :param actions: int [n, A], each in 0 .. n_actions-1
        :return: Rewards and events of the step
        """
        possible = np.take_along_axis(self.masks, actions.T[:, :, None], axis=2)[:, :, 0].T
        legal = np.where(possible, actions, self.stop).astype(np.int32)
        active = self._alive
        self._keys, self._states, view, outcome = self._program.advance(self._keys, self._states, legal)
        self._set_view(view)
        rewards, ended, won, cut = (np.array(values) for values in outcome)
        return BattleStep(rewards, ended, won, cut, active, self._alive, np.array(view.visible))

    def _set_view(self, view: BattleView) -> None:
        # Copies, because arrays from jax are read-only, which PyTorch does not support
        self.observations, self.masks = np.array(view.observations), np.array(view.masks)
        self._alive = np.array(view.alive)

    def world_states(self) -> np.ndarray:
        """
        Return what is known of all units of each copy, as SMAX has it.

        :return: float32 [n, ``state_width``]
        """
        return np.array(self._program.world_states(self._states), dtype=np.float32)

    def units(self, copy: int) -> dict[str, np.ndarray]:
        """
        Return the units of one copy, for rendering.

        :param copy: Index of the copy
        :return: ``positions`` [m, 2], ``types`` [m], ``health`` [m] and ``alive`` [m] of all units, the allies first
        """
        units = self._states.state
        return {name: np.array(getattr(units, f"unit_{name}")[copy]) for name in ("positions", "types", "health", "alive")}

    def get_states(self) -> list[dict[str, Any]]:
        """
        Return everything that determines the following steps of each copy.

        :return: One state for each copy
        :raises ValueError: Before the first ``reset``
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
        Restore the states of all copies.

        :param states: One state for each copy, as ``get_states`` returned them
        :raises ValueError: If the number of copies or the map differs
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

    # Compiled functions can be neither copied nor pickled, but the rules determine them, so a copy gets them from its config

    def __getstate__(self) -> dict[str, Any]:
        states = None if self._states is None else self.get_states()
        return {"n_copies": self.n_copies, "config": self.config, "keys": np.array(self._keys), "states": states}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["n_copies"], state["config"])  # type: ignore[misc]
        self._keys = state["keys"]
        if state["states"] is not None:
            self.set_states(state["states"])
