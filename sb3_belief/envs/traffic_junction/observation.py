"""Observations of the cars of a Traffic Junction."""

from dataclasses import dataclass

import numpy as np
from gymnasium import spaces

from sb3_belief.envs.traffic_junction.config import JunctionConfig
from sb3_belief.envs.traffic_junction.core import TrafficCore
from sb3_belief.envs.traffic_junction.layout import build_layout


@dataclass(frozen=True)
class ObservationLayout:
    """
    Indices of the parts of an observation, which :class:`~sb3_belief.envs.TrafficJunction` describes.

    :param n_cars: Number of slots
    :param n_routes: Number of routes
    :param vision: Number of cells seen in each direction
    :param last_actions: Whether each cell has one more number, which counts the cars in it that braked at the last step
    """

    n_cars: int
    n_routes: int
    vision: int
    last_actions: bool

    active = 0
    last_action = 1
    route = 2

    @classmethod
    def of(cls, config: JunctionConfig) -> "ObservationLayout":
        """
        Return the layout for the rules of an environment.

        :param config: The rules
        :return: The layout of its observations
        """
        n_routes = build_layout(config.level).n_routes
        return cls(config.level_spec.n_cars, n_routes, config.vision, config.observe_last_actions)

    @property
    def row(self) -> int:
        """The index of the car's row."""
        return 2 + self.n_routes

    @property
    def column(self) -> int:
        """The index of the car's column."""
        return 3 + self.n_routes

    @property
    def tau(self) -> int:
        """The index of the time since the car entered."""
        return 4 + self.n_routes

    @property
    def cells(self) -> int:
        """The index of the first visible cell, which is also the width of what a car sees of itself."""
        return 5 + self.n_routes

    @property
    def window(self) -> int:
        """The side of the square that a car sees, in cells."""
        return 2 * self.vision + 1

    @property
    def cell_width(self) -> int:
        """The number of entries per visible cell."""
        return 1 + self.n_cars + self.n_routes + self.last_actions

    @property
    def width(self) -> int:
        """The number of entries of an observation."""
        return self.cells + self.window**2 * self.cell_width

    def space(self) -> spaces.Box:
        """
        Return a new observation space.

        :return: Box from 0 to the largest possible value of each entry, float32 [width]
        """
        high = np.ones(self.width, dtype=np.float32)
        counts = np.arange(self.cells, self.width, self.cell_width)
        high[counts] = self.n_cars - 1
        if self.last_actions:
            high[counts + self.cell_width - 1] = self.n_cars - 1
        return spaces.Box(0.0, high, dtype=np.float32)


# Coordinate of cars that are not on the road
_FAR = 10**6


class Observer:
    """
    Builder of the observations of all cars in all copies.

    :param core: The copies
    """

    def __init__(self, core: TrafficCore):
        self.core = core
        self.layout = layout = ObservationLayout.of(core.config)
        roads = core.layout
        size = roads.level.size
        row, column = roads.cell // size, roads.cell % size
        # The coordinates of each place as a viewer (the upper left corner of the cells in view) and as a car to be seen. A car
        # that is not on the road is very far away, to opposite sides in the two roles, so it neither sees nor is seen
        gone = roads.cell == size**2
        self._corner = [np.where(gone, _FAR, at - layout.vision) for at in (row, column)]
        self._seen = [np.where(gone, -_FAR, at) for at in (row, column)]
        # The entries of an observation that depend on the car's place alone, as a lookup table. Rows of places without a car
        # stay zero
        self._own = np.zeros((len(roads.cell), layout.cells), dtype=np.float32)
        on_road = np.flatnonzero(roads.cell < size**2)
        self._own[on_road, layout.active] = 1.0
        self._own[on_road, layout.route + roads.route[on_road]] = 1.0
        self._own[on_road, layout.row] = row[on_road] / (size - 1)
        self._own[on_road, layout.column] = column[on_road] / (size - 1)
        slots = np.arange(core.n_cars)
        self._pairs = ~np.eye(core.n_cars, dtype=bool)
        self._others = np.array([np.delete(slots, i) for i in slots])

    def observe(self) -> tuple[np.ndarray, np.ndarray]:
        """
        Build the observations of the current state.

        :return: Observations, float32 [n_cars, n_copies, width], and which car sees which, bool [n_copies, n_cars, n_cars].
            Both are new arrays. The observations of one agent are contiguous in memory, since each agent has its own learner
        """
        core, layout = self.core, self.layout
        place = core.place
        down, right = (
            seen[place][:, None, :] - corner[place][:, :, None] for seen, corner in zip(self._seen, self._corner, strict=True)
        )
        # Negative numbers become huge when read as unsigned ones, so one comparison checks both ends of the window
        visible = down.view(np.uint64) < layout.window
        visible &= right.view(np.uint64) < layout.window
        visible &= self._pairs

        obs = np.zeros((core.n_cars, core.n_copies, layout.width), dtype=np.float32)
        obs[:, :, : layout.cells] = self._own[place.T]
        obs[:, :, layout.last_action] = core.last_action.T
        obs[:, :, layout.tau] = core.tau.T / core.max_steps

        # One row per pair of a car and another one that it sees; start is the index of the seen cell in the flat array
        copies, cars, others = np.nonzero(visible)
        cell = down[copies, cars, others] * layout.window + right[copies, cars, others]
        start = (cars * core.n_copies + copies) * layout.width + layout.cells + cell * layout.cell_width
        flat = obs.reshape(-1)
        # add.at, because several cars in one cell share an index, for which flat[start] += 1 would count only one
        np.add.at(flat, start, np.float32(1))
        flat[start + 1 + others] = 1.0
        flat[start + 1 + core.n_cars + core.layout.route[place[copies, others]]] = 1.0
        if layout.last_actions:
            braked = core.last_action[copies, others].astype(np.float32)
            np.add.at(flat, start + layout.cell_width - 1, braked)
        return obs, visible

    def of_others(self, visible: np.ndarray) -> np.ndarray:
        """
        Remove the diagonal, that is each car's entry for itself.

        :param visible: Which car sees which, bool [n_copies, n_cars, n_cars]
        :return: The same for the other cars in order, bool [n_copies, n_cars, n_cars - 1]
        """
        return visible[:, np.arange(len(self._others))[:, None], self._others]
