"""A game of two roles: six actions of two kinds, and two agents that have to swap theirs at half-time."""

import numpy as np
from gymnasium import spaces

from sb3_belief.envs.matrix_games.small_game import SmallGame

_N_STEPS = 10


class Levers(SmallGame):
    """
    Game of two agents and ten steps. The actions 0, 1 and 2 raise an agent's own counter A, the others its counter B.

    Each step pays 1 if the first agent raises A and the second B in the first five steps, and the reverse in the last five.
    Uniform play earns 2.5, the best play 10. An agent observes its own counters, so it knows the time; the state is the
    counters of both.
    """

    def __init__(self) -> None:
        super().__init__(2, 6, spaces.Box(0, _N_STEPS, (2,)), 4, _N_STEPS)
        self.counters = np.zeros((2, 2), dtype=np.float32)

    def _begin(self) -> None:
        self.counters = np.zeros((2, 2), dtype=np.float32)

    def _observations(self) -> list[np.ndarray]:
        return [row.copy() for row in self.counters]

    def _rewards(self, actions: list[int]) -> list[float]:
        kinds = [action // 3 for action in actions]
        self.counters[[0, 1], kinds] += 1
        wanted = [0, 1] if self.t < _N_STEPS // 2 else [1, 0]
        return [float(kinds == wanted)] * 2

    def state(self) -> np.ndarray:
        """
        Return the counters of both agents.

        :return: float32 ``[4]``: A and B of the first agent, A and B of the second
        """
        return self.counters.ravel().copy()
