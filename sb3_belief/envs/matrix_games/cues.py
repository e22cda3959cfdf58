"""A game of who is to blame: each agent has a cue of its own, and all get the number of those that follow theirs."""

import numpy as np
from gymnasium import spaces

from sb3_belief.envs.matrix_games.small_game import SmallGame


class Cues(SmallGame):
    """
    Game of one step in which each agent observes a bit and should play it; all get the number of agents that do.

    To an agent the others' luck is noise: given its own cue and action, the return has a variance of ``(n_agents - 1) / 4``
    under uniform play, of which a counterfactual baseline leaves nothing. The state is the cues of all.

    :param n_agents: Number of agents
    """

    def __init__(self, n_agents: int = 5):
        super().__init__(n_agents, 2, spaces.Box(0, 1, (1,)), n_agents)
        self.cues = np.zeros(n_agents, dtype=np.float32)

    def _begin(self) -> None:
        self.cues = self.rng.integers(2, size=len(self.possible_agents)).astype(np.float32)

    def _observations(self) -> list[np.ndarray]:
        return [self.cues[i : i + 1].copy() for i in range(len(self.cues))]

    def _rewards(self, actions: list[int]) -> list[float]:
        return [float((self.cues == actions).sum())] * len(actions)

    def state(self) -> np.ndarray:
        """
        Return the cues of all agents.

        :return: float32 ``[n_agents]``
        """
        return self.cues.copy()
