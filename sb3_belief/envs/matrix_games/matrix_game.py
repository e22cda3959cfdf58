"""Games of one table: all agents get the payoff of their joint action."""

from collections.abc import Sequence
from itertools import permutations
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_belief.envs.matrix_games.small_game import SmallGame


class MatrixGame(SmallGame):
    """
    Game of one payoff table, played ``n_steps`` times an episode. Observations and state are the constant 1.

    :param payoffs: The table, one axis for each agent, all of the same length, ``[n_actions] * n_agents``
    :param n_steps: Number of steps of an episode. With 1 a learner's values are the payoffs themselves
    :param reward_scale: What payoffs are multiplied by
    :raises ValueError: If the table is no cube of finite numbers
    """

    def __init__(self, payoffs: Sequence[Any] | np.ndarray, n_steps: int = 1, reward_scale: float = 1.0):
        #: The table, float64
        self.payoffs = np.array(payoffs, dtype=np.float64)
        if self.payoffs.ndim < 1 or len(set(self.payoffs.shape)) != 1 or not np.isfinite(self.payoffs).all():
            raise ValueError(
                f"payoffs has the shape {self.payoffs.shape}: it must have one axis for each agent, all of the same length,"
                " and hold finite numbers."
            )
        super().__init__(self.payoffs.ndim, len(self.payoffs), spaces.Box(0, 1, (1,)), 1, n_steps, reward_scale)
        self._one = np.ones(1, dtype=np.float32)

    def _observations(self) -> list[np.ndarray]:
        return [self._one] * len(self.possible_agents)

    def _rewards(self, actions: list[int]) -> list[float]:
        return [float(self.payoffs[tuple(actions)])] * len(actions)

    def state(self) -> np.ndarray:
        """
        Return the state, which says nothing.

        :return: float32 ``[1]``, a one
        """
        return self._one


class Penalty(MatrixGame):
    """
    Game of Claus and Boutilier (1998), whose best joint actions lie beside a penalty: ``[[k, 0, 10], [0, 2, 0], [10, 0, k]]``.

    :param k: The penalty, at most 0
    :param n_steps: Number of steps of an episode
    :param reward_scale: What payoffs are multiplied by
    :raises ValueError: If ``k`` is greater than 0
    """

    def __init__(self, k: float = -100.0, n_steps: int = 1, reward_scale: float = 1.0):
        if k > 0:
            raise ValueError(f"k={k} is the penalty of the game, and must be at most 0.")
        super().__init__([[k, 0, 10], [0, 2, 0], [10, 0, k]], n_steps, reward_scale)


class Permutation(MatrixGame):
    """
    Game of ``n`` agents with ``n`` actions each: the reward is 1 if all choose different ones, otherwise 0.

    Agents that draw from one and the same distribution win at most ``n! / n**n`` of the games: .5 with two, .2222 with three.

    :param n: Number of agents and of actions, at least 2
    :param n_steps: Number of steps of an episode
    :param reward_scale: What payoffs are multiplied by
    :raises ValueError: If ``n`` is less than 2
    """

    def __init__(self, n: int = 2, n_steps: int = 1, reward_scale: float = 1.0):
        if n < 2:
            raise ValueError(f"n={n} must be at least 2.")
        payoffs = np.zeros([n] * n)
        for joint in permutations(range(n)):
            payoffs[joint] = 1.0
        super().__init__(payoffs, n_steps, reward_scale)
