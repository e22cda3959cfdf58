"""What a model knows of the others: their action spaces, and where their actions stand in one vector."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_belief.belief import ActionLayout
from sb3_belief.common.action_encoding import action_encoding

ActionSpaces = dict[str, spaces.Space]


class OthersPrediction(NamedTuple):
    """
    What an agent believes, for inspection. The arrays have no batch dimension for a single observation.

    :param actions: The expected action of each other, ``[B, width of its action]``: the probability of each action
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
    Return the layout of the others' actions in one vector.

    :param others_action_spaces: The others' action spaces, in their fixed order
    :return: Where each of them stands, encoded as in :func:`~sb3_belief.common.action_encoding.action_encoding`
    :raises ValueError: If a space is of another kind
    """
    encodings = [action_encoding(name, space) for name, space in others_action_spaces.items()]
    return ActionLayout([encoding.widths for encoding in encodings], [encoding.kind for encoding in encodings])


def others_of(env: VecEnv) -> ActionSpaces:
    """
    Return the action spaces of the others that an environment names.

    :param env: The vectorised environment of one agent
    :return: The spaces by name, in order; empty for an environment without others
    """
    # Asked first, because a worker process does not survive being asked for an attribute that it does not have
    return dict(env.get_attr("others_action_spaces")[0]) if env.has_attr("others_action_spaces") else {}
