"""A warning of models that take no action masks in an environment that gives some."""

import warnings
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_belief.common.action_masks import mask_parts
from sb3_belief.common.exceptions import add_note
from sb3_belief.team.model_parts import shown_space
from sb3_belief.team.predictor import takes_masks
from sb3_belief.vec_env.team_vec_env import TeamObs, TeamStep

# An agent that is not masked chooses what is impossible within its first random actions, or hardly ever
N_STEPS = 200
# Algorithms of which there is one with masks, whose name begins with "Maskable"
_WITH_MASKS = ("AMFPPO", "BeliefPPO", "MAPPO", "PPO")


class MaskCheck:
    """
    Watches whether agents without masks choose impossible actions while they are in play, in the first joint steps.

    A mask that only says what an agent may do while it is out of play concerns nobody, so the masks alone do not tell. A model
    that acts for several agents is not watched, since it is in play as long as one of them is.

    :param models: The models by agent
    :param masks: The masks after a reset by agent, bool ``[n_envs, k]``; None without masks
    """

    def __init__(self, models: Mapping[str, BaseAlgorithm], masks: Mapping[str, np.ndarray] | None):
        self._models = {
            agent: models[agent]
            for agent in masks or {}
            if not takes_masks(models[agent]) and shown_space(models[agent], "action") == models[agent].action_space
        }
        self._agents = list(models)
        self._n_steps = 0
        #: Whether there is nothing to watch any more
        self.is_done = not self._models

    def step(self, env_step: Callable[[Any], Any], actions: TeamObs, masks: Mapping[str, np.ndarray] | None) -> TeamStep:
        """
        Step the environment, and warn if an agent in play has chosen an impossible action.

        :param env_step: Steps the environment
        :param actions: The actions by agent, ``[n_envs, ...]``
        :param masks: The masks of these actions by agent
        :return: The step
        :raises Exception: What the environment raises, with a note if an action is impossible
        """
        impossible = {
            agent: ~_possible(model.action_space, actions[agent], masks[agent])
            for agent, model in self._models.items()
            if masks is not None and agent in masks
        }
        try:
            step: TeamStep = env_step(actions)
        except Exception as error:
            concerned = [agent for agent, where in impossible.items() if where.any()]
            if concerned:
                add_note(error, self._message(concerned))
            raise
        active = np.array([info["active"] for info in step[3]])
        concerned = [agent for agent, where in impossible.items() if (where & active[:, self._agents.index(agent)]).any()]
        if concerned:
            warnings.warn(self._message(concerned))
        self._n_steps += 1
        self.is_done = bool(concerned) or self._n_steps == N_STEPS
        return step

    def _message(self, concerned: list[str]) -> str:
        classes = sorted({type(self._models[agent]).__name__ for agent in concerned})
        instead = sorted({_masked_class(self._models[agent]) for agent in concerned})
        return (
            f"The action masks of {concerned} are not heeded: {' and '.join(classes)} takes none and chooses impossible"
            f" actions, too. Use {' and '.join(instead)}, and for evaluation sb3-contrib's evaluate_policy"
            " (sb3_contrib.common.maskable.evaluation) and MaskableEvalCallback (sb3_contrib.common.maskable.callbacks), which"
            " pass masks on."
        )


def _possible(space: spaces.Space, actions: np.ndarray, masks: np.ndarray) -> np.ndarray:
    """Return whether masks allow actions, bool ``[n_envs]``."""
    offsets = np.cumsum([0, *mask_parts(space)[:-1]])
    chosen = actions - getattr(space, "start", 0)
    allowed = np.take_along_axis(masks, chosen.reshape(len(masks), -1).astype(int) + offsets, axis=1)
    return np.logical_and.reduce(allowed, axis=1)


def _masked_class(model: BaseAlgorithm) -> str:
    found = next((each.__name__ for each in type(model).__mro__ if each.__name__ in _WITH_MASKS), None)
    return "MaskablePPO or MaskableBeliefPPO" if found is None else f"Maskable{found}"
