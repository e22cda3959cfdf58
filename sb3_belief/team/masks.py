"""Warnings about action masks that an environment gives and nobody uses."""

import warnings
from collections.abc import Mapping

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_belief.belief_ppo import BeliefPPO
from sb3_belief.team.predictor import takes_masks

EVALUATION = (
    "sb3-contrib's evaluate_policy (sb3_contrib.common.maskable.evaluation) and MaskableEvalCallback"
    " (sb3_contrib.common.maskable.callbacks) pass masks on"
)


def warn_of_unmasked_models(models: Mapping[str, BaseAlgorithm], masks: Mapping[str, np.ndarray] | None) -> None:
    """
    Warn of models that will choose impossible actions, since their algorithm takes no masks.

    :param models: The models by agent
    :param masks: The masks after a reset by agent, bool ``[n_envs, k]``; None without masks
    """
    unmasked = [agent for agent in masks or {} if not takes_masks(models[agent])]
    # An agent that has been given no mask of its own has one that allows everything; at first all others' may, too
    restricted = [agent for agent, mask in (masks or {}).items() if not mask.all()]
    concerned = [agent for agent in unmasked if agent in restricted or not restricted]
    if concerned:
        classes = sorted({type(models[agent]).__name__ for agent in concerned})
        instead = sorted({_masked_class(models[agent]) for agent in concerned})
        warnings.warn(
            f"The environment gives action masks to {concerned}, and {' and '.join(classes)} takes none: impossible actions"
            f" are chosen, too. Use {' and '.join(instead)}; {EVALUATION}."
        )


def _masked_class(model: BaseAlgorithm) -> str:
    if isinstance(model, BeliefPPO):
        return "MaskableBeliefPPO"
    return "MaskablePPO" if isinstance(model, PPO) else "MaskablePPO or MaskableBeliefPPO"
