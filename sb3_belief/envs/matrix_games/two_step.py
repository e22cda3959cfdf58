"""The game of two steps of the QMIX paper."""

import numpy as np
from gymnasium import spaces

from sb3_belief.envs.matrix_games.small_game import SmallGame

# The payoffs of the second step, by the first agent's choice in the first one
_SECOND = (((7.0, 7.0), (7.0, 7.0)), ((0.0, 1.0), (1.0, 8.0)))


class TwoStep(SmallGame):
    """
    Game of two agents with two actions each, and two steps (Rashid et al. 2018, "QMIX").

    In the first step the first agent's action chooses the table of the second step, and nothing is paid: 0 leads to 2A, in
    which every joint action pays 7, and 1 to 2B, which pays ``[[0, 1], [1, 8]]``. Observations and state are one-hot: first
    step, 2A, 2B. After the second step they remain what they were.

    :param reward_scale: What payoffs are multiplied by
    """

    def __init__(self, reward_scale: float = 1.0) -> None:
        super().__init__(2, 2, spaces.Box(0, 1, (3,)), 3, 2, reward_scale)
        self._one_hot = np.eye(3, dtype=np.float32)
        self.place = 0

    def _begin(self) -> None:
        self.place = 0

    def _observations(self) -> list[np.ndarray]:
        return [self._one_hot[self.place]] * 2

    def _rewards(self, actions: list[int]) -> list[float]:
        if not self.place:
            self.place = 1 + actions[0]
            return [0.0, 0.0]
        return [_SECOND[self.place - 1][actions[0]][actions[1]]] * 2

    def state(self) -> np.ndarray:
        """
        Return where the game is.

        :return: float32 ``[3]``, one-hot
        """
        return self._one_hot[self.place]
