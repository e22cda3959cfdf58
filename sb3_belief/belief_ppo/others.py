"""What a model knows of the others: their action spaces, and where their actions stand in one vector."""

from collections.abc import Mapping
from typing import Any, NamedTuple

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
    :param rows: The rows of ``policy.history`` that were attended to, int ``[B, N_h]``; -1 for the null row of an adaptive
        belief, which has no step behind it
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


def others_rows(
    others_action_spaces: Mapping[str, spaces.Space], actions: Any, visible: Mapping[str, Any] | None, n_steps: int
) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the others' actions of some steps as the rows of a history hold them.

    :param others_action_spaces: The others' action spaces, in their fixed order
    :param actions: Their actions by name, each ``[N, ...]`` in its own space, without the others that were not visible at all,
        or None for these; or rows as in ``info["others_actions"]``, ``[N, W]``
    :param visible: At which steps each of them was visible, bool ``[N]`` by name. If it is left out, at all for which there is
        an action by name, and in rows where it is not all zeros
    :param n_steps: ``N``
    :return: float32 ``[N, W]``, zero where not visible, and whether each was, bool ``[N, n_others]``
    :raises ValueError: If a name is unknown, or actions or flags have another shape or are none of their space
    """
    layout, visible = action_layout(others_action_spaces), visible or {}
    if isinstance(actions, Mapping):
        actions = {name: given for name, given in actions.items() if given is not None or name not in others_action_spaces}
    names = ", ".join(others_action_spaces)
    for name in (*(actions if isinstance(actions, Mapping) else ()), *visible):
        if name not in others_action_spaces:
            raise ValueError(f"{name!r} is none of the others that the belief is about: {names}")
    for name, flags in visible.items():
        if np.shape(flags) != (n_steps,) or np.asarray(flags).dtype != bool:
            raise ValueError(
                f"visible[{name!r}] is {np.asarray(flags).dtype} of the shape {np.shape(flags)}; it must be one truth value "
                f"for each of the {n_steps} steps"
            )
    if isinstance(actions, Mapping):
        rows = np.zeros((n_steps, layout.width), dtype=np.float32)
    else:
        rows = np.array(actions, dtype=np.float32)
        if rows.shape != (n_steps, layout.width):
            raise ValueError(
                f"the others' actions have the shape {rows.shape}; {n_steps} steps beside {names} need "
                f"{(n_steps, layout.width)}, coded as in the environment's info['others_actions']: one-hot for Discrete and "
                "each dimension of MultiDiscrete, else the values. Or give each other's actions by its name, in its own space"
            )
    seen_at = np.zeros((n_steps, len(others_action_spaces)), dtype=bool)
    for owner, (name, space) in enumerate(others_action_spaces.items()):
        columns, seen = layout.columns_of(owner), np.asarray(visible.get(name, np.ones(n_steps, dtype=bool)))
        if not isinstance(actions, Mapping):
            rows[~seen, columns] = 0
            seen_at[:, owner] = seen if name in visible else rows[:, columns].any(axis=1)
        elif name in actions:
            rows[seen, columns] = _encoded(name, space, actions[name], seen)
            seen_at[:, owner] = seen
    return rows, seen_at


def _encoded(name: str, space: spaces.Space, actions: Any, seen: np.ndarray) -> np.ndarray:
    """Encode those of an other's actions that were seen, ``[n_seen, width]``."""
    values = np.asarray(actions)
    if len(seen) == 1 and values.shape == space.shape:
        values = values[None]
    if values.shape != (len(seen), *(space.shape or ())):
        raise ValueError(
            f"the actions of {name!r} have the shape {values.shape}; {len(seen)} steps in {space} need "
            f"{(len(seen), *(space.shape or ()))}"
        )
    rows = np.zeros((int(seen.sum()), spaces.flatdim(space)), dtype=np.float32)
    for row, value in zip(rows, values[seen], strict=True):
        if not is_action_of(space, value):
            raise ValueError(f"{value!r} is no action of {name!r}, whose space is {space}")
        row[:] = np.asarray(spaces.flatten(space, value))
    return rows


def is_action_of(space: spaces.Space, value: Any) -> bool:
    """
    Return whether a value can have been somebody's action. Bounds of numbers do not count: one may act beyond them, which an
    environment clips.

    :param space: The action space
    :param value: The action
    """
    return bool(np.isfinite(value).all()) if isinstance(space, spaces.Box) else space.contains(value)


def others_of(env: VecEnv) -> ActionSpaces:
    """
    Return the action spaces of the others that an environment names.

    :param env: The vectorised environment of one agent
    :return: The spaces by name, in order; empty for an environment without others
    """
    # Asked first, because a worker process does not survive being asked for an attribute that it does not have
    return dict(env.get_attr("others_action_spaces")[0]) if env.has_attr("others_action_spaces") else {}


def check_same_others(env: VecEnv, others_action_spaces: ActionSpaces) -> None:
    """
    Check that an environment has the others that a model has been made for.

    :param env: The vectorised environment of one agent
    :param others_action_spaces: The others' action spaces that the model knows, in order
    :raises ValueError: If it has others, or the same in another order or with other action spaces
    """
    found = others_of(env)
    if list(found.items()) != list(others_action_spaces.items()):
        raise ValueError(
            f"The others of this environment are {found}, but the model has been made for {others_action_spaces}: it predicts"
            " these others with these action spaces, in this order."
        )
