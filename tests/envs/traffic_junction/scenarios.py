"""Hand-made situations of a Traffic Junction."""

import numpy as np

from sb3_belief.envs.traffic_junction.config import JunctionConfig
from sb3_belief.envs.traffic_junction.core import TrafficCore
from sb3_belief.envs.traffic_junction.observation import Observer

LEFT, STRAIGHT, RIGHT = 0, 1, 2
TOP, EAST, BOTTOM, WEST = range(4)


def quiet_core(n_copies: int = 1, **kwargs) -> TrafficCore:
    """
    :return: cores without arrivals
    """
    core = TrafficCore(n_copies, JunctionConfig(**{"arrival_rate": 0.0, **kwargs}))
    core.reset()
    return core


def put(core: TrafficCore, slot: int, entry: int, turn: int, cell: int, copy: int = 0, tau: int = 0) -> None:
    """
    :param cell: 0 is the entry cell
    """
    core.place[copy, slot] = core.layout.entry_routes[entry, turn] * core.layout.stride + cell
    core.on_road[copy, slot] = True
    core.tau[copy, slot] = tau


def gas(core: TrafficCore, *brakes: int) -> np.ndarray:
    """
    :return: actions of everyone: gas but for the given slots
    """
    actions = np.zeros((core.n_copies, core.n_cars), dtype=int)
    actions[:, list(brakes)] = 1
    return actions


def arrival(core: TrafficCore, time: int, entry: int, turn: int, slot: int, copy: int = 0) -> None:
    """Let a car want to enter at this time, take this turn and be given this slot if it is free (if core.arrival_rate > 0)."""
    n = core.n_entries
    core.draws[copy, time, :n] = 1.0
    core.draws[copy, time, entry] = 0.0
    core.draws[copy, time, n + entry] = (turn + 0.5) / 3
    core.draws[copy, time, 2 * n :] = 0.9
    core.draws[copy, time, 2 * n + slot] = 0.0


def observe(core: TrafficCore) -> tuple[np.ndarray, np.ndarray, Observer]:
    observer = Observer(core)
    return (*observer.observe(), observer)
