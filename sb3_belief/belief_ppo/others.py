"""What a model knows of the others: how their actions are flattened into one vector, and how to read them from `info`."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

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


def read_others(infos: Sequence[Mapping[str, Any]], layout: ActionLayout) -> tuple[np.ndarray, np.ndarray]:
    """
    :param infos: One step's `info` of each env copy
    :param layout: Whose actions are expected
    :return: The others' actions, float32 ``[n_envs, W]``, zero where not visible, and visibility, bool
        ``[n_envs, n_others]``. Zeroed here once more, so that a careless environment cannot leak what the agent did not see
    """
    actions = _rows("others_actions", layout.width, infos).astype(np.float32, copy=False)
    visible = _rows("others_visible", layout.n_others, infos).astype(bool, copy=False)
    return np.where(visible.take(layout.owners, axis=1), actions, np.float32(0.0)), visible


def _rows(key: str, width: int, infos: Sequence[Mapping[str, Any]]) -> np.ndarray:
    try:
        rows = [np.asarray(info[key]) for info in infos]
    except KeyError:
        raise ValueError(
            f"the environment names others in 'others_action_spaces', but its info lacks {key!r}; every step must bring "
            "'others_actions' and 'others_visible' (a Team provides both)"
        ) from None
    wrong = {row.shape for row in rows} - {(width,)}
    if wrong:
        raise ValueError(
            f"info brings {key} of shape {sorted(wrong)[0]}; the others' action spaces ask for {(width,)}, see "
            "sb3_belief.belief_ppo.others.action_layout (actions) and one truth value for each other (visible)"
        )
    # A third of the time of stack()
    return np.concatenate(rows).reshape(len(rows), width)
