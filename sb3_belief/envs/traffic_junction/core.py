"""
The rules of the Traffic Junction (Sukhbaatar et al. 2016, https://arxiv.org/abs/1605.07736), for many copies at once.

:class:`TrafficCore` knows nothing of agents' names, dictionaries or Gym interfaces: arrays [n_copies, n_cars] go in and out.
"""

from typing import Any, NamedTuple

import numpy as np

from sb3_belief.envs.traffic_junction.config import JunctionConfig, check_arrival_rate
from sb3_belief.envs.traffic_junction.layout import build_layout

GAS, BRAKE = 0, 1

COLLISION_REWARD = -5.0
"""For each step and each other car in the same cell."""
WAIT_REWARD = -0.01
"""For each step, times the number of steps since the car entered."""


class Step(NamedTuple):
    """
    What a step of all copies brought.

    :param rewards: float64 [n_copies, n_cars]
    :param acted: bool [n_copies, n_cars], the slots whose car was on the road when the actions were chosen
    :param left: bool [n_copies, n_cars], the slots whose car reached its destination
    :param partners: int [n_copies, n_cars], how many other cars the car in the slot collided with
    :param dones: bool [n_copies], whether the step limit is reached
    """

    rewards: np.ndarray
    acted: np.ndarray
    left: np.ndarray
    partners: np.ndarray
    dones: np.ndarray


class TrafficCore:
    """
    ``n_copies`` junctions side by side. Each has a random generator of its own, and all that an episode needs of it is
    drawn at the episode's start in one call: a copy therefore lives the same life alone and in a batch, and a step costs
    no call per copy.

    The order of events in a step is

    - ``commnet``: cars move, tau += 1, collisions, cars on their last cell leave, cars arrive. A car that arrives in an
      occupied entry cell collides only if it or the other is still there after the next move.
    - ``ic3net``: cars move, tau += 1, cars that drove on from their last cell leave, cars arrive, collisions. A car that
      arrives in an occupied entry cell collides at once: the episode has failed, and the car that it hits is punished; it
      is not itself, since it has not acted yet (its slot may still hold the last step of the car before).

    Arrivals: each entry wants a car with the probability ``arrival_rate``; it gets a random free slot (one freed in this
    very step too) and a random one of the entry's routes, until no slot is free. The road is empty when an episode
    starts.

    :param n_copies: number of copies
    :param config: the rules
    """

    def __init__(self, n_copies: int, config: JunctionConfig):
        self.config = config
        self.layout = build_layout(config.level)
        level = config.level_spec
        self.n_copies, self.n_cars, self.max_steps = n_copies, level.n_cars, level.max_steps
        self.n_entries = len(self.layout.entries)
        self.arrival_rate = config.start_arrival_rate
        self.generators = [np.random.default_rng() for _ in range(n_copies)]

        shape = (n_copies, self.n_cars)
        self.place = np.full(shape, self.layout.nowhere)
        self.tau = np.zeros(shape, dtype=np.int64)
        self.last_action = np.zeros(shape, dtype=np.int64)
        self.on_road = np.zeros(shape, dtype=bool)
        self.time = np.zeros(n_copies, dtype=np.int64)
        self.n_collisions = np.zeros(n_copies, dtype=np.int64)
        # per step: [wish to enter, choice of route] of each entry, and the precedence of each slot
        self.draws = np.zeros((n_copies, self.max_steps, 2 * self.n_entries + self.n_cars))
        # crashed[:, cell]: whether cars collided there in the last step; one more cell for the cars that are nowhere
        self._n_cells = level.size**2 + 1
        self.crashed = np.zeros((n_copies, self._n_cells), dtype=bool)
        self._copy = np.arange(n_copies)
        self._cell_offset = (self._copy * self._n_cells)[:, None]

    def set_arrival_rate(self, arrival_rate: float) -> None:
        """
        :param arrival_rate: from the next step on, in [0, 1]
        :raises ValueError: outside of it
        """
        self.arrival_rate = check_arrival_rate(arrival_rate)

    def seed(self, copy: int, seed: int | None) -> None:
        """
        :param copy: number of the copy
        :param seed: seed of its generator from its next reset on
        """
        self.generators[copy] = np.random.default_rng(seed)

    def reset(self, copies: np.ndarray | None = None) -> None:
        """
        Start new episodes on empty roads.

        :param copies: int [k], which copies; None: all
        """
        chosen = self._copy if copies is None else copies
        self.place[chosen] = self.layout.nowhere
        self.on_road[chosen] = False
        for array in (self.tau, self.last_action, self.time, self.n_collisions, self.crashed):
            array[chosen] = 0
        for copy in chosen:
            self.generators[copy].random(out=self.draws[copy])

    def step(self, actions: np.ndarray) -> Step:
        """
        :param actions: int [n_copies, n_cars], 0 gas, 1 brake; those of slots without a car are ignored
        :return: what happened
        """
        acted = self.on_road.copy()
        self.last_action = np.where(acted, actions, GAS)
        self.place += acted & (actions == GAS)
        self.tau += acted
        if self.config.order == "commnet":
            partners = self._collide()
            waited = acted
            rewards = COLLISION_REWARD * partners + WAIT_REWARD * self.tau
            left = self.layout.is_last[self.place]
            self._leave(left)
            self._arrive()
        else:
            left = self.layout.is_beyond[self.place]
            waited = acted & ~left
            self._leave(left)
            self._arrive()
            partners = self._collide()
            rewards = COLLISION_REWARD * partners + WAIT_REWARD * self.tau
        rewards = np.where(waited, rewards, 0.0) * self.config.reward_scale
        if self.config.reward == "team":
            rewards = np.repeat(rewards.mean(axis=1, keepdims=True), self.n_cars, axis=1)
        self.time += 1
        return Step(rewards, acted, left, partners, self.time >= self.max_steps)

    def _collide(self) -> np.ndarray:
        """
        :return: int [n_copies, n_cars], number of other cars in the same cell
        """
        cells = self.layout.cell[self.place] + self._cell_offset
        counts = np.bincount(cells.ravel(), minlength=self.crashed.size)
        partners = np.where(self.on_road, counts[cells] - 1, 0)
        self.crashed = counts.reshape(self.crashed.shape) > 1
        self.crashed[:, -1] = False
        # a pair counts once: each of the two is the other's partner
        self.n_collisions += partners.sum(axis=1) // 2
        return partners

    def _leave(self, left: np.ndarray) -> None:
        self.place[left] = self.layout.nowhere
        self.tau[left] = 0
        self.last_action[left] = GAS
        self.on_road &= ~left

    def _arrive(self) -> None:
        draws = self.draws[self._copy, self.time]
        wishes = draws[:, : self.n_entries] < self.arrival_rate
        rank = wishes.cumsum(axis=1)
        n_free = self.n_cars - self.on_road.sum(axis=1, keepdims=True)
        copies, entries = np.nonzero(wishes & (rank <= n_free))
        if not len(copies):
            return
        # the free slots first, in random order: the k-th arrival takes the k-th of them
        slots = np.argsort(draws[:, 2 * self.n_entries :] + self.on_road, axis=1)[copies, rank[copies, entries] - 1]
        routes_of = self.layout.entry_routes
        chosen = (draws[copies, self.n_entries + entries] * routes_of.shape[1]).astype(np.int64)
        self.place[copies, slots] = routes_of[entries, chosen] * self.layout.stride
        self.on_road[copies, slots] = True

    def get_state(self, copy: int) -> dict[str, Any]:
        """
        :param copy: number of the copy
        :return: all that decides its future, as arrays and plain data (copies)
        """
        state: dict[str, Any] = {name: np.copy(getattr(self, name)[copy]) for name in _STATE_ARRAYS}
        state["arrival_rate"] = self.arrival_rate
        state["generator"] = self.generators[copy].bit_generator.state
        return state

    def set_state(self, copy: int, state: dict[str, Any]) -> None:
        """
        :param copy: number of the copy
        :param state: what ``get_state`` returned, of a copy of the same level. The arrival rate is one for all copies.
        :raises ValueError: if it is the state of another level
        """
        for name in _STATE_ARRAYS:
            given, own = np.shape(state[name]), getattr(self, name)[copy].shape
            if given != own:
                raise ValueError(
                    f"The state's {name!r} has shape {given}, level {self.config.level!r} needs {own}:"
                    " a state can only be restored in an environment of the level that it was taken from."
                )
        for name in _STATE_ARRAYS:
            getattr(self, name)[copy] = state[name]
        self.set_arrival_rate(state["arrival_rate"])
        self.generators[copy].bit_generator.state = state["generator"]


_STATE_ARRAYS = ("place", "tau", "last_action", "on_road", "time", "n_collisions", "draws", "crashed")
