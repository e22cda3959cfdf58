"""What a model knows of the others: how their actions are flattened into one vector, and how to read them from `info`."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_belief.belief import ActionLayout

ActionSpaces = dict[str, spaces.Space]


class OthersPrediction(NamedTuple):
    """
    What an agent believes, to be looked at; arrays without the batch dimension for a single observation.

    :param actions: For each other what it is expected to do, ``[B, width of its action]``: the probability of each action
        (Discrete), of each value dimension after dimension (MultiDiscrete), of a one (MultiBinary), or the mean (Box)
    :param mean: Mean of the belief, ``[B, z]``
    :param std: Its standard deviation, ``[B, z]``; 0 where the belief is a single point
    :param rows: The rows of ``policy.history`` that were attended to, int ``[B, N_h]``
    :param weights: Their weights in the attention, ``[B, N_h]``, adding up to 1
    """

    actions: dict[str, np.ndarray]
    mean: np.ndarray
    std: np.ndarray
    rows: np.ndarray
    weights: np.ndarray


def action_layout(others_action_spaces: Mapping[str, spaces.Space]) -> ActionLayout:
    """
    :param others_action_spaces: The others' action spaces, in the fixed order of the others
    :return: Where each of them stands in the flattened vector: one-hot for Discrete, a one-hot a dimension for
        MultiDiscrete, the numbers themselves for Box and MultiBinary
    """
    widths: list[list[int]] = []
    kinds: list[str] = []
    for name, space in others_action_spaces.items():
        if isinstance(space, spaces.Discrete):
            widths.append([int(space.n)])
            kinds.append("categorical")
        elif isinstance(space, spaces.MultiDiscrete):
            widths.append([int(n) for n in space.nvec.flatten()])
            kinds.append("categorical")
        elif isinstance(space, (spaces.Box, spaces.MultiBinary)):
            widths.append([spaces.flatdim(space)])
            kinds.append("number" if isinstance(space, spaces.Box) else "binary")
        else:
            raise ValueError(
                f"{name} has the action space {space}; a belief can be held about Discrete, MultiDiscrete, MultiBinary "
                "and Box actions. Flatten its action space in the environment."
            )
    return ActionLayout(widths, kinds)


def others_of(env: VecEnv) -> ActionSpaces:
    """
    :param env: The vectorised environment of one agent
    :return: The others' action spaces in order, empty for an environment without others
    """
    # Asked first, because a worker process does not survive being asked for what it does not have
    return dict(env.get_attr("others_action_spaces")[0]) if env.has_attr("others_action_spaces") else {}
