"""Actions of one agent's model outside of its own ``learn()``."""

import inspect
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize

# Recurrent state of a policy, as SB3's predict() takes and returns it
PolicyState = tuple[np.ndarray, ...] | None


class Predictor:
    """
    Predicts with a model on observations as they come from the team's environment.

    :param model: of the agent
    :param statistics: its normalisation, if it has one; it is used as it is, never updated
    """

    def __init__(self, model: BaseAlgorithm, statistics: VecNormalize | None):
        self._model, self._statistics = model, statistics
        #: Whether the model's ``predict`` takes action masks
        self.takes_masks = "action_masks" in inspect.signature(model.predict).parameters
        self._state: PolicyState = None

    def predict(
        self,
        obs: np.ndarray,
        state: PolicyState = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
        masks: np.ndarray | None = None,
    ) -> tuple[np.ndarray, PolicyState]:
        """
        :param obs: one observation or a batch of them, not normalised
        :param state: recurrent state, None at first
        :param episode_start: bool [n_envs]: where the recurrent state starts anew
        :param deterministic: the most likely action instead of a sample
        :param masks: bool [n_envs, k] or [k]: possible actions; for models whose ``predict`` takes them
        :return: action(s) and the next recurrent state
        """
        if self._statistics is not None:
            obs = self._statistics.normalize_obs(obs)  # type: ignore[assignment]
        kwargs: dict[str, Any] = {} if masks is None or not self.takes_masks else {"action_masks": masks}
        return self._model.predict(obs, state, episode_start, deterministic, **kwargs)

    def go_on(self, obs: np.ndarray, episode_start: np.ndarray, masks: np.ndarray | None) -> np.ndarray:
        """
        Act as in training, for an agent that has finished learning while others have not.

        :param obs: array [num_envs, ...]
        :param episode_start: bool [num_envs]
        :param masks: bool [num_envs, k] or None
        :return: sampled actions [num_envs, ...]
        """
        actions, self._state = self.predict(obs, self._state, episode_start, masks=masks)
        return actions
