"""Base class of the vectorised environments whose copies are stepped at once."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, Protocol

from sb3_belief.vec_env.team_vec_env import TeamObs, TeamVecEnv


class BatchedGame(Protocol):
    """All copies of a game in one object."""

    def seed(self, copy: int, seed: int) -> None:
        """
        Seed the random number generator of a copy.

        :param copy: Number of the copy
        :param seed: The seed
        """

    def reset(self) -> None:
        """Start an episode in all copies."""

    def get_state(self, copy: int) -> dict[str, Any]:
        """
        Return everything that determines the following steps of a copy.

        :param copy: Number of the copy
        """

    def set_state(self, copy: int, state: dict[str, Any]) -> None:
        """
        Restore the state of a copy.

        :param copy: Number of the copy
        :param state: A state that ``get_state`` returned
        """


class BatchedVecEnv(TeamVecEnv):
    """A ``TeamVecEnv`` over one :class:`BatchedGame`, whose state can be saved and restored."""

    @property
    @abstractmethod
    def batched_game(self) -> BatchedGame:
        """The game that holds all copies."""

    @abstractmethod
    def _observe(self) -> TeamObs:
        """Return the current observations, ``[num_envs, ...]`` by agent."""

    def _reset_joint(self) -> TeamObs:
        for copy, seed in enumerate(self._seeds):
            if seed is not None:
                self.batched_game.seed(copy, seed)
        self.batched_game.reset()
        return self._observe()

    def get_state(self) -> list[dict[str, Any]]:
        """
        Return everything that determines the following steps of each copy.

        :return: One state for each copy
        """
        return [self.batched_game.get_state(copy) for copy in range(self.num_envs)]

    def set_state(self, states: Sequence[dict[str, Any]]) -> TeamObs:
        """
        Restore the states of all copies. The monitored returns and lengths of the running episodes start from zero.

        :param states: States that ``get_state`` returned for as many copies with the same arguments
        :return: The current observations, ``[num_envs, ...]`` by agent
        :raises ValueError: If the number of copies or the arguments differ
        """
        if len(states) != self.num_envs:
            raise ValueError(f"Got the states of {len(states)} copies for {self.num_envs}.")
        for copy, state in enumerate(states):
            self.batched_game.set_state(copy, state)
        self._zero_episode_sums()
        return self._observe()
