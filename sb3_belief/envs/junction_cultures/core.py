"""The Traffic Junction with scripted cars that follow a culture, for many copies at once."""

from dataclasses import asdict
from typing import Any

import numpy as np

from sb3_belief.envs.base import check_same_arguments
from sb3_belief.envs.drawn_types import DrawnTypes
from sb3_belief.envs.junction_cultures.config import CultureConfig
from sb3_belief.envs.traffic_junction.core import BRAKE, GAS, Step, TrafficCore
from sb3_belief.envs.traffic_junction.observation import Observer


class CultureCore:
    """
    ``n_copies`` independent junctions in which the first car is the learner's, and all others follow the present culture.

    A scripted car brakes if a car that it sees stands in its next cell, or has the same next cell and goes first: it comes
    from an entry of a lower rank number, or from one of the same rank and has the lower id.

    :param n_copies: Number of environment copies
    :param config: The rules
    """

    def __init__(self, n_copies: int, config: CultureConfig):
        self.config, self.n_copies = config, n_copies
        self.traffic = TrafficCore(n_copies, config.junction)
        self.types = DrawnTypes(n_copies, config, config.weights)
        # The actions of the last step, and whom the learner saw when it was chosen
        self.actions = np.zeros((n_copies, self.traffic.n_cars), dtype=np.int64)
        self.saw = np.zeros((n_copies, self.traffic.n_cars - 1), dtype=bool)
        self._observer = Observer(self.traffic)
        self._sees = np.zeros((n_copies, self.traffic.n_cars, self.traffic.n_cars), dtype=bool)
        layout = self.traffic.layout
        # The entry of each place; slots without a car follow the last route
        entry = np.empty(layout.n_routes + 1, dtype=np.int64)
        for number, routes in enumerate(layout.entry_routes):
            entry[routes] = number
        entry[layout.n_routes] = 0
        self._entry = entry[layout.route]
        ids = np.arange(self.traffic.n_cars)
        self._lower_id = ids[None, :] < ids[:, None]

    def seed(self, copy: int, seed: int | None) -> None:
        """
        Seed one copy, which starts again with the first culture of its sequence.

        :param copy: Index of the copy
        :param seed: Seed, or None for one from the operating system. Traffic follows it from the copy's next reset on
        """
        self.traffic.seed(copy, seed)
        self.types.seed(copy, seed)

    def reset(self, copies: np.ndarray | None = None) -> None:
        """
        Start new episodes on empty roads.

        :param copies: Indices of the copies to reset, int [k]. None for all
        """
        chosen = np.arange(self.n_copies) if copies is None else copies
        self.traffic.reset(chosen)
        self.types.update(chosen)
        self.saw[chosen] = False

    def step(self, actions: np.ndarray) -> Step:
        """
        Advance all copies by one step. No copy is reset. :meth:`observe` has to be called before.

        :param actions: Actions of the learners, 0 (gas) or 1 (brake), int [n_copies]
        :return: Rewards and events of the step, of all cars
        """
        self.saw = self._sees[:, 0, 1:].copy()
        self.actions = self.ruled(self.config.priorities[self.types.current])
        self.actions[:, 0] = actions
        result = self.traffic.step(self.actions)
        self.types.step(result.dones)
        return result

    @property
    def entries(self) -> np.ndarray:
        """The number of the entry of each car, int64 [n_copies, n_cars]. Without meaning for slots without a car."""
        return self._entry[self.traffic.place]

    def ruled(self, priorities: np.ndarray) -> np.ndarray:
        """
        Return what all cars do that follow a culture, given the last call of :meth:`observe`.

        :param priorities: Rank of each entry in each copy, int [n_copies, n_entries]
        :return: 0 (gas) or 1 (brake), int64 [n_copies, n_cars]. Slots without a car brake
        """
        occupied, crossing = self.conflicts()
        rank = np.take_along_axis(priorities, self.entries, axis=1)
        own, others = rank[:, :, None], rank[:, None, :]
        goes_first = (others < own) | ((others == own) & self._lower_id)
        brakes = (occupied | (crossing & goes_first)).any(axis=2) | ~self.traffic.on_road
        return np.where(brakes, BRAKE, GAS)

    def conflicts(self) -> tuple[np.ndarray, np.ndarray]:
        """
        Return which cars are in each other's way, given the last call of :meth:`observe`.

        :return: bool [n_copies, n_cars, n_cars] twice: whether the first of two cars sees the second one in its next cell, and
            whether it sees that the second one has the same next cell
        """
        layout, place = self.traffic.layout, self.traffic.place
        target = layout.next_cell[place]
        occupied = self._sees & (layout.cell[place][:, None, :] == target[:, :, None])
        crossing = self._sees & (target[:, None, :] == target[:, :, None]) & (target[:, :, None] >= 0)
        return occupied, crossing

    def observe(self) -> np.ndarray:
        """
        Build the observations of the learners.

        :return: float32 [n_copies, width], a new array: that of the Traffic Junction, and with ``reveal_partner`` the present
            culture, one-hot
        """
        obs, self._sees = self._observer.observe()
        if not self.config.reveal_partner:
            return obs[0]
        told = np.eye(len(self.config.priorities), dtype=np.float32)[self.types.current]
        return np.concatenate([obs[0], told], axis=1)

    def get_state(self, copy: int) -> dict[str, Any]:
        """
        Return everything that determines the following steps of one copy.

        :param copy: Index of the copy
        :return: Copies of arrays and plain data
        """
        return {
            "config": asdict(self.config),
            "traffic": self.traffic.get_state(copy),
            "types": self.types.get_state(copy),
            "actions": self.actions[copy].copy(),
            "saw": self.saw[copy].copy(),
        }

    def set_state(self, copy: int, state: dict[str, Any]) -> None:
        """
        Restore one copy.

        :param copy: Index of the copy
        :param state: State that ``get_state`` returned for a copy with the same rules
        :raises ValueError: If the rules differ
        """
        check_same_arguments(state["config"], asdict(self.config))
        self.traffic.set_state(copy, state["traffic"])
        self.types.set_state(copy, state["types"])
        self.actions[copy], self.saw[copy] = state["actions"], state["saw"]
        _, self._sees = self._observer.observe()
