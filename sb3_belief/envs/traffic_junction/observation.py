"""What the cars of a Traffic Junction see."""

from dataclasses import dataclass

import numpy as np
from gymnasium import spaces

from sb3_belief.envs.traffic_junction.config import JunctionConfig
from sb3_belief.envs.traffic_junction.core import TrafficCore
from sb3_belief.envs.traffic_junction.layout import build_layout


@dataclass(frozen=True)
class ObservationLayout:
    """
    Where what stands in an observation, see :class:`~sb3_belief.envs.TrafficJunction`.

    :param n_cars: number of slots
    :param n_routes: number of routes
    :param vision: cells seen in each direction
    :param last_actions: whether there is one more number per cell, for the cars in it that braked last
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
        :param config: the rules of an environment
        :return: the layout of its observations
        """
        n_routes = build_layout(config.level).n_routes
        return cls(config.level_spec.n_cars, n_routes, config.vision, config.observe_last_actions)

    @property
    def row(self) -> int:
        return 2 + self.n_routes

    @property
    def column(self) -> int:
        return 3 + self.n_routes

    @property
    def tau(self) -> int:
        return 4 + self.n_routes

    @property
    def cells(self) -> int:
        """Start of the first visible cell, and so the width of what a car sees of itself."""
        return 5 + self.n_routes

    @property
    def window(self) -> int:
        """Side of the square that a car sees."""
        return 2 * self.vision + 1

    @property
    def cell_width(self) -> int:
        return 1 + self.n_cars + self.n_routes + self.last_actions

    @property
    def width(self) -> int:
        return self.cells + self.window**2 * self.cell_width

    def space(self) -> spaces.Box:
        """
        :return: a new observation space
        """
        high = np.ones(self.width, dtype=np.float32)
        counts = np.arange(self.cells, self.width, self.cell_width)
        high[counts] = self.n_cars - 1
        if self.last_actions:
            high[counts + self.cell_width - 1] = self.n_cars - 1
        return spaces.Box(0.0, high, dtype=np.float32)


_FAR = 10**6


class Observer:
    """
    Builds the observations of all cars of all copies.

    :param core: the copies
    """

    def __init__(self, core: TrafficCore):
        self.core = core
        self.layout = layout = ObservationLayout.of(core.config)
        roads = core.layout
        size = roads.level.size
        row, column = roads.cell // size, roads.cell % size
        # Where a car is as a viewer (the upper left corner of what it sees) and as one of those to be seen. Who is not on the
        # road is so far away, and to opposite sides, that nobody sees it and it sees nobody.
        gone = roads.cell == size**2
        self._corner = [np.where(gone, _FAR, at - layout.vision) for at in (row, column)]
        self._seen = [np.where(gone, -_FAR, at) for at in (row, column)]
        # All that a place alone decides, to be looked up at once. Row by row zero where there is no car.
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
        :return: observations float32 [n_cars, n_copies, width] (a new array; agent by agent in memory, since each goes to a
            learner of its own) and who sees whom, bool [n_copies, n_cars, n_cars]
        """
        core, layout = self.core, self.layout
        place = core.place
        down, right = (
            seen[place][:, None, :] - corner[place][:, :, None] for seen, corner in zip(self._seen, self._corner, strict=True)
        )
        # as unsigned numbers the negative ones are huge: one comparison for both ends
        visible = down.view(np.uint64) < layout.window
        visible &= right.view(np.uint64) < layout.window
        visible &= self._pairs

        obs = np.zeros((core.n_cars, core.n_copies, layout.width), dtype=np.float32)
        obs[:, :, : layout.cells] = self._own[place.T]
        obs[:, :, layout.last_action] = core.last_action.T
        obs[:, :, layout.tau] = core.tau.T / core.max_steps

        copies, cars, others = np.nonzero(visible)
        cell = down[copies, cars, others] * layout.window + right[copies, cars, others]
        start = (cars * core.n_copies + copies) * layout.width + layout.cells + cell * layout.cell_width
        flat = obs.reshape(-1)
        np.add.at(flat, start, np.float32(1))
        flat[start + 1 + others] = 1.0
        flat[start + 1 + core.n_cars + core.layout.route[place[copies, others]]] = 1.0
        if layout.last_actions:
            braked = core.last_action[copies, others].astype(np.float32)
            np.add.at(flat, start + layout.cell_width - 1, braked)
        return obs, visible

    def of_others(self, visible: np.ndarray) -> np.ndarray:
        """
        :param visible: bool [n_copies, n_cars, n_cars]
        :return: the same without each car itself, bool [n_copies, n_cars, n_cars - 1]
        """
        return visible[:, np.arange(len(self._others))[:, None], self._others]
