"""What a dry run of a study tries settings on in place of an environment that is not installed."""

from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_belief.envs.base import ResetResult
from sb3_belief.envs.traffic_junction.parallel_env import TrafficJunction

# As many as on maps of SMAX: settings such as RODE's number of roles must fit the number of actions
_N_ACTIONS = 16


class StandIn(TrafficJunction):
    """An environment of vectors with masks and a number of actions, of which the first two are possible. It is not played."""

    def __init__(self) -> None:
        super().__init__("easy")
        self.action_spaces = {agent: spaces.Discrete(_N_ACTIONS) for agent in self.possible_agents}

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> ResetResult:
        """
        Start an episode.

        :param seed: As in ``TrafficJunction``
        :param options: Not used
        :return: Observations, and infos with masks as wide as the action space
        """
        obs, infos = super().reset(seed, options)
        masks = {agent: np.pad(info["action_mask"], (0, _N_ACTIONS - 2)) for agent, info in infos.items()}
        return obs, {agent: {**infos[agent], "action_mask": mask} for agent, mask in masks.items()}
