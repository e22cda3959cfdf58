"""A game whose return depends mostly on what only the global state shows."""

import numpy as np
from gymnasium import spaces

from sb3_belief.envs.matrix_games.small_game import SmallGame


class HiddenOffset(SmallGame):
    """
    Game of one step in which an agent gets 1 for the action 1, and 10 h, where h is 1 or -1 by chance.

    Only the state shows h. A critic that sees it explains the return; one that sees the constant observation cannot.

    :param n_agents: Number of agents
    """

    def __init__(self, n_agents: int = 2):
        super().__init__(n_agents, 2, spaces.Box(0, 1, (1,)), 1)
        self._one = np.ones(1, dtype=np.float32)
        self.offset = 1.0

    def _begin(self) -> None:
        self.offset = float(self.rng.choice((-1.0, 1.0)))

    def _observations(self) -> list[np.ndarray]:
        return [self._one] * len(self.possible_agents)

    def _rewards(self, actions: list[int]) -> list[float]:
        return [action + 10 * self.offset for action in actions]

    def state(self) -> np.ndarray:
        """
        Return h.

        :return: float32 ``[1]``
        """
        return np.array([self.offset], dtype=np.float32)
