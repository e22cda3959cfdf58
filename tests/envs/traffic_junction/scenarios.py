"""Situations of a Traffic Junction that tests put together by hand."""

import numpy as np

from sb3_belief.envs.traffic_junction.config import JunctionConfig
from sb3_belief.envs.traffic_junction.core import TrafficCore
from sb3_belief.envs.traffic_junction.observation import Observer

LEFT, STRAIGHT, RIGHT = 0, 1, 2
TOP, EAST, BOTTOM, WEST = range(4)


def quiet_core(n_copies: int = 1, **kwargs) -> TrafficCore:
    """Return the core of ``n_copies`` games, reset, into which no cars arrive unless ``kwargs`` say otherwise."""
    core = TrafficCore(n_copies, JunctionConfig(**{"arrival_rate": 0.0, **kwargs}))
    core.reset()
    return core


def put(core: TrafficCore, slot: int, entry: int, turn: int, cell: int, copy: int = 0, tau: int = 0) -> None:
    """
    Put a car on the road.

    :param core: The games
    :param slot: Slot of the car
    :param entry: Entry that its route begins at
    :param turn: Turn that its route takes
    :param cell: Number of the cell on its route, 0 for the entry cell
    :param copy: Number of the game
    :param tau: Number of steps that it has been on the road
    """
    core.place[copy, slot] = core.layout.entry_routes[entry, turn] * core.layout.stride + cell
    core.on_road[copy, slot] = True
    core.tau[copy, slot] = tau


def gas(core: TrafficCore, *brakes: int) -> np.ndarray:
    """Return actions with which all slots choose gas but the given ones, which brake."""
    actions = np.zeros((core.n_copies, core.n_cars), dtype=int)
    actions[:, list(brakes)] = 1
    return actions


def arrival(core: TrafficCore, time: int, entry: int, turn: int, slot: int, copy: int = 0) -> None:
    """
    Let a car arrive at a given time, which needs an arrival rate above 0.

    :param core: The games
    :param time: Step at which the car arrives
    :param entry: Entry at which it arrives
    :param turn: Turn that its route takes
    :param slot: Slot that it is given if that is free
    :param copy: Number of the game
    """
    n = core.n_entries
    core.draws[copy, time, :n] = 1.0
    core.draws[copy, time, entry] = 0.0
    core.draws[copy, time, n + entry] = (turn + 0.5) / 3
    core.draws[copy, time, 2 * n :] = 0.9
    core.draws[copy, time, 2 * n + slot] = 0.0


def observe(core: TrafficCore) -> tuple[np.ndarray, np.ndarray, Observer]:
    """Return the observations, the visibility and the observer that made them."""
    observer = Observer(core)
    return (*observer.observe(), observer)
