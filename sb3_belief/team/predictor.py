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
    Predicts with a model from observations as the team's environment returns them, before normalisation.

    :param model: Of the agent
    :param statistics: Its normalisation, if it has one; it is used as it is and never updated
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
        Predict as SB3's ``predict`` does.

        :param obs: One observation or a batch of them, not normalised
        :param state: Recurrent state, None at first
        :param episode_start: Where the recurrent state starts anew, bool ``[n_envs]``
        :param deterministic: Whether to take the most likely action instead of a sample
        :param masks: Possible actions, bool ``[n_envs, k]`` or ``[k]``; for models whose ``predict`` takes them
        :return: Action(s) and the next recurrent state
        """
        if self._statistics is not None:
            obs = self._statistics.normalize_obs(obs)  # type: ignore[assignment]
        kwargs: dict[str, Any] = {} if masks is None or not self.takes_masks else {"action_masks": masks}
        return self._model.predict(obs, state, episode_start, deterministic, **kwargs)

    def act(self, obs: np.ndarray, episode_start: np.ndarray, masks: np.ndarray | None) -> np.ndarray:
        """
        Sample actions as in training, keeping the recurrent state, for an agent that has finished learning before others.

        :param obs: ``[num_envs, ...]``
        :param episode_start: bool ``[num_envs]``
        :param masks: bool ``[num_envs, k]``, or None
        :return: ``[num_envs, ...]``
        """
        actions, self._state = self.predict(obs, self._state, episode_start, masks=masks)
        return actions
