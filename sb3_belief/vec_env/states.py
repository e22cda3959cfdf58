"""
The global state of a team's copies, which joint learners use in training: what the environment itself says, or all agents'
observations. No agent of a ``Team`` is ever given it.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_belief.common.action_encoding import RowEncoder
from sb3_belief.vec_env.observation_forms import map_parts, parts_of

#: Where states come from: the environment's own ``state()``, or the observations of all agents
ENVIRONMENT, OBSERVATIONS = "env", "observations"


class GlobalStates:
    """
    The part of a ``TeamVecEnv`` that says the global state.

    An environment with states of its own overrides ``state_source``, ``state_space`` and ``states``, and puts
    ``terminal_state`` into its infos.
    """

    possible_agents: list[str]
    observation_space: Any
    # Whether anybody has asked for states, and the observations of the last step or reset
    _asked_for_states = False
    _obs: dict[str, Any] | None = None
    _observed: "ObservedStates | None" = None

    @property
    def state_source(self) -> str:
        """Where :meth:`states` come from: ``"env"`` for the environment's own ``state()``, or ``"observations"``."""
        return OBSERVATIONS

    @property
    def state_space(self) -> spaces.Box:
        """The space of a state, float32 ``[d_s]``, known before the first reset."""
        return unbounded(self._observed_states().width)

    def states(self) -> np.ndarray:
        """
        Return the global state of each copy, for joint learners; no agent of a ``Team`` is given it.

        It is what the environment says by PettingZoo's ``state()``, flattened, otherwise the observations of all agents one
        after the other, each as ``gymnasium.spaces.flatten`` has it; :attr:`state_source` says which. Nothing is computed for
        it before it is asked for. From the first call on, the info of a done holds ``terminal_state`` float32 ``[d_s]``, so a
        learner asks before its first step.

        :return: float32 ``[num_envs, d_s]``, another array after each step
        :raises RuntimeError: Before the first reset
        :raises ValueError: If the environment's own state is no array of finite numbers
        """
        self._asked_for_states = True
        return self._observed_states()(self._last_observations())

    def _last_observations(self) -> dict[str, Any]:
        if self._obs is None:
            raise RuntimeError("There are no states before the first reset().")
        return self._obs

    def _observed_states(self) -> "ObservedStates":
        if self._observed is None:
            self._observed = ObservedStates({agent: self.observation_space[agent] for agent in self.possible_agents})
        return self._observed

    def _tell_terminal_states(self, dones: np.ndarray, infos: list[dict[str, Any]]) -> None:
        """Put the last state of episodes that have ended into their infos, where it consists of observations."""
        for env_idx in np.flatnonzero(dones):
            infos[env_idx]["terminal_state"] = self._observed_states().of_one(infos[env_idx]["terminal_observation"])


def unbounded(width: int) -> spaces.Box:
    """
    Return the space of a state.

    :param width: Number of its entries
    """
    return spaces.Box(-np.inf, np.inf, (width,), np.float32)


class ObservedStates:
    """
    States that consist of the observations of all agents, one after the other, each as ``gymnasium.spaces.flatten`` has it.

    :param observation_spaces: Observation space of each agent
    """

    def __init__(self, observation_spaces: Mapping[str, spaces.Space]):
        self._encoders = [
            (agent, key, RowEncoder(agent, part))
            for agent, space in observation_spaces.items()
            for key, part in parts_of(space).items()
        ]
        #: Number of entries of a state
        self.width = sum(spaces.flatdim(space) for space in observation_spaces.values())

    def __call__(self, obs: Mapping[str, Any]) -> np.ndarray:
        """
        Return the states of some copies.

        :param obs: ``[n, ...]`` by agent
        :return: float32 ``[n, width]``
        """
        parts = [encode(np.asarray(obs[agent] if key is None else obs[agent][key])) for agent, key, encode in self._encoders]
        return np.concatenate(parts, axis=1, dtype=np.float32)

    def of_one(self, obs: Mapping[str, Any]) -> np.ndarray:
        """
        Return the state of one copy.

        :param obs: ``[...]`` by agent
        :return: float32 ``[width]``
        """
        return self({agent: map_parts(lambda part: np.asarray(part)[None], own) for agent, own in obs.items()})[0]
