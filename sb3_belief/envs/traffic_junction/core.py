"""
The rules of the Traffic Junction (Sukhbaatar et al. 2016, https://arxiv.org/abs/1605.07736), for many copies at once.

:class:`TrafficCore` takes and returns arrays [n_copies, n_cars]. Names of agents, dictionaries and Gym interfaces are added
by the environments that use it.
"""

from typing import Any, NamedTuple

import numpy as np

from sb3_belief.envs.traffic_junction.config import JunctionConfig, check_arrival_rate
from sb3_belief.envs.traffic_junction.layout import build_layout

GAS, BRAKE = 0, 1

COLLISION_REWARD = -5.0
"""Reward per step and per other car in the same cell."""
WAIT_REWARD = -0.01
"""Reward per step, multiplied by the number of steps since the car entered."""


class Step(NamedTuple):
    """
    Result of one step of all copies.

    :param rewards: Rewards of the slots, float64 [n_copies, n_cars]
    :param acted: Slots whose car was on the road when the actions were chosen, bool [n_copies, n_cars]
    :param left: Slots whose car reached its destination, bool [n_copies, n_cars]
    :param partners: Number of other cars that the car in the slot collided with, int [n_copies, n_cars]
    :param dones: Whether the step limit is reached, bool [n_copies]
    """

    rewards: np.ndarray
    acted: np.ndarray
    left: np.ndarray
    partners: np.ndarray
    dones: np.ndarray


class TrafficCore:
    """
    ``n_copies`` independent junctions that are stepped together.

    Each copy has a random generator of its own, and all random numbers of an episode are drawn at its start in one call. A
    copy with a given seed therefore behaves the same alone and in a batch, and a step needs no call per copy.

    The order of events in a step is

    - ``commnet``: cars move, tau += 1, collisions are counted, cars on their last cell leave, new cars arrive. A car that
      arrives in an occupied entry cell collides only if both cars are in one cell after the next move.
    - ``ic3net``: cars move, tau += 1, cars that drove on from their last cell leave, new cars arrive, collisions are counted.
      A car that arrives in an occupied entry cell collides at once: the episode has failed and the car that it hits is
      punished. The new car is not punished, since it has not acted yet (in that step its slot may still belong to the
      previous car).

    Arrivals: with the probability ``arrival_rate`` a car wants to enter at an entry. It gets a random free slot, possibly one
    freed in the same step, and a random route of that entry. Entries are served in their order until no slot is free. The
    road is empty when an episode starts.

    :param n_copies: Number of environment copies
    :param config: The rules
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
        # The random numbers of each step: for each entry whether a car wants to enter, for each entry the choice of its
        # route, and for each slot its rank among the free ones. They lie in [0, 1)
        self.draws = np.zeros((n_copies, self.max_steps, 2 * self.n_entries + self.n_cars))
        # crashed[:, cell] says whether cars collided there in the last step. The additional last cell is where the layout
        # puts all cars that are not on the road
        self._n_cells = level.size**2 + 1
        self.crashed = np.zeros((n_copies, self._n_cells), dtype=bool)
        self._copy = np.arange(n_copies)
        self._cell_offset = (self._copy * self._n_cells)[:, None]

    def set_arrival_rate(self, arrival_rate: float) -> None:
        """
        Set the arrival rate of all copies from the next step on.

        :param arrival_rate: Probability in [0, 1] that a car wants to enter, per entry and step
        :raises ValueError: If it is not a number in [0, 1]
        """
        self.arrival_rate = check_arrival_rate(arrival_rate)

    def seed(self, copy: int, seed: int | None) -> None:
        """
        Seed the random generator of one copy. The seed takes effect at its next reset.

        :param copy: Index of the copy
        :param seed: Seed, or None for one from the operating system
        """
        self.generators[copy] = np.random.default_rng(seed)

    def reset(self, copies: np.ndarray | None = None) -> None:
        """
        Start new episodes on empty roads.

        :param copies: Indices of the copies to reset, int [k]. None for all
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
        Advance all copies by one step. No copy is reset.

        :param actions: 0 (gas) or 1 (brake), int [n_copies, n_cars]. Those of slots without a car are ignored
        :return: Rewards and events of the step
        """
        acted = self.on_road.copy()
        self.last_action = np.where(acted, actions, GAS)
        self.place += acted & (actions == GAS)
        self.tau += acted
        # Only cars that are on the road when collisions are counted get a reward. With commnet cars leave after that, so they
        # are all that have acted
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
        Count collisions and remember their cells.

        :return: Number of other cars in the same cell, int [n_copies, n_cars]
        """
        cells = self.layout.cell[self.place] + self._cell_offset
        counts = np.bincount(cells.ravel(), minlength=self.crashed.size)
        partners = np.where(self.on_road, counts[cells] - 1, 0)
        self.crashed = counts.reshape(self.crashed.shape) > 1
        self.crashed[:, -1] = False
        # Each of two colliding cars has the other as its partner, but the pair is one collision
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
        # The k-th entry with a wish is served if at least k slots are free
        rank = wishes.cumsum(axis=1)
        n_free = self.n_cars - self.on_road.sum(axis=1, keepdims=True)
        copies, entries = np.nonzero(wishes & (rank <= n_free))
        if not len(copies):
            return
        # Adding on_road (1 for occupied slots) to numbers in [0, 1) sorts the free slots to the front, in random order. The
        # k-th arrival takes the k-th of them
        slots = np.argsort(draws[:, 2 * self.n_entries :] + self.on_road, axis=1)[copies, rank[copies, entries] - 1]
        routes_of = self.layout.entry_routes
        chosen = (draws[copies, self.n_entries + entries] * routes_of.shape[1]).astype(np.int64)
        self.place[copies, slots] = routes_of[entries, chosen] * self.layout.stride
        self.on_road[copies, slots] = True

    def get_state(self, copy: int) -> dict[str, Any]:
        """
        Return everything that determines the following steps of one copy.

        :param copy: Index of the copy
        :return: Copies of arrays and plain data
        """
        state: dict[str, Any] = {name: np.copy(getattr(self, name)[copy]) for name in _STATE_ARRAYS}
        state["arrival_rate"] = self.arrival_rate
        state["generator"] = self.generators[copy].bit_generator.state
        return state

    def set_state(self, copy: int, state: dict[str, Any]) -> None:
        """
        Restore one copy. All copies share one arrival rate, so it is set for all of them.

        :param copy: Index of the copy
        :param state: State that ``get_state`` returned for a copy of the same level
        :raises ValueError: If it is the state of another level
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
