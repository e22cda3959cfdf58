"""Action masks as sb3-contrib's ``MaskablePPO`` takes them: one row of flags, those of all dimensions side by side."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv


def mask_parts(space: spaces.Space) -> list[int]:
    """
    Return how many flags each dimension has in an action mask.

    :param space: An action space
    :return: The number of flags of each dimension, in order; none for a space that cannot be masked
    """
    if isinstance(space, spaces.Discrete):
        return [int(space.n)]
    if isinstance(space, spaces.MultiDiscrete):
        return [int(n) for n in space.nvec.ravel()]
    if isinstance(space, spaces.MultiBinary):
        return [2] * int(np.prod(space.n))
    return []


def mask_width(space: spaces.Space) -> int:
    """
    Return the number of flags in an action mask.

    :param space: An action space
    :return: The number of flags; 0 for a space that cannot be masked
    """
    return sum(mask_parts(space))


def flat_mask(mask: Any) -> np.ndarray:
    """
    Return a mask as one row.

    :param mask: Flags as an array or a list, or those of each dimension in a tuple, list or dict of arrays
    :return: The same flags side by side
    """
    if isinstance(mask, Mapping):
        mask = list(mask.values())
    if isinstance(mask, (tuple, list)):
        mask = np.concatenate([np.ravel(part) for part in mask])
    return np.asarray(mask).ravel()


def mask_row(mask: Any, space: spaces.Space, agent: str, where: str | None = None) -> np.ndarray:
    """
    Return the flags of a mask as one row.

    :param mask: The mask as ``flat_mask`` takes it
    :param space: The agent's action space
    :param agent: Name of the agent
    :param where: Copy and step, in words; None to take the mask as it is, since to check each one takes time
    :return: The flags, bool
    :raises ValueError: If it is checked and holds anything but flags, or parts that are not those of the dimensions
    """
    row = flat_mask(mask)
    flags = row if row.dtype == bool else row.astype(bool) if row.dtype.kind in "iuf" else None
    if where is not None and (flags is None or (flags != row).any()):
        raise ValueError(
            f"The action mask of {agent!r} {where} holds {row.tolist()[:8]}: a mask consists of flags, True or 1 for each"
            " action that is possible, False or 0 for the others."
        )
    parts = list(mask.values()) if isinstance(mask, Mapping) else mask
    if where is not None and isinstance(parts, (tuple, list)) and any(np.ndim(part) for part in parts):
        sizes = [np.size(part) for part in parts]
        # A single row, or that of a single dimension, may be split in any way
        if len(sizes) > 1 and len(mask_parts(space)) > 1 and sizes != mask_parts(space):
            raise ValueError(
                f"The action mask of {agent!r} {where} has parts of {sizes} flags, but {space} has dimensions of"
                f" {mask_parts(space)}: give a part for each dimension, in their order."
            )
    return row.astype(bool) if flags is None else flags


def wrong_width(agent: str, width: int, given: int, where: str) -> ValueError:
    """
    Return the error for a mask that does not fit the action space.

    :param agent: Name of the agent
    :param width: Number of flags that its mask must have
    :param given: Number that it has
    :param where: Copy and step, in words
    """
    return ValueError(f"The action mask of {agent!r} {where} must have {width} entries, one for each action, got {given}.")


def first_actions(space: spaces.Space) -> np.ndarray:
    """
    Return the mask for an agent whose action counts for nothing: a model must choose one, so the first is left.

    :param space: Its action space
    :return: bool ``[mask_width(space)]``, True for the first value of each dimension
    """
    parts = mask_parts(space)
    mask = np.zeros(sum(parts), dtype=bool)
    mask[np.cumsum([0, *parts[:-1]])] = True
    return mask


def sample_action(space: spaces.Space, mask: np.ndarray | None, rng: np.random.Generator) -> Any:
    """
    Return a random action that a mask allows.

    :param space: Action space
    :param mask: Which actions are possible, bool. None if all are
    :param rng: Random generator
    :return: An action of the type that a team passes to an environment
    """
    if isinstance(space, spaces.Discrete):
        return int(rng.choice(np.arange(space.n) if mask is None else np.flatnonzero(mask)))
    if isinstance(space, spaces.MultiDiscrete | spaces.MultiBinary):
        sizes = np.full(space.shape, 2).ravel() if isinstance(space, spaces.MultiBinary) else space.nvec.ravel()
        whole = np.ones(int(sizes.sum()), dtype=bool) if mask is None else mask
        # A component without a possible action gets 0: the environment is to blame, and its own error is reported
        parts = np.split(whole, np.cumsum(sizes)[:-1])
        chosen = [rng.choice(np.flatnonzero(part)) if part.any() else 0 for part in parts]
        return np.array(chosen, dtype=space.dtype).reshape(space.shape)
    assert isinstance(space, spaces.Box)
    # Bounds may be infinite, and a uniform draw needs finite ones
    low, high = np.maximum(space.low, -1e3), np.minimum(space.high, 1e3)
    return rng.uniform(low, high).astype(space.dtype)


def env_masks(env: VecEnv) -> np.ndarray:
    """
    Return which actions are possible now in the environment of one agent.

    It is ``get_action_masks`` of sb3-contrib, for agents that are deployed without that package.

    :param env: An environment whose copies have ``action_masks()``
    :return: bool ``[n_envs, k]``
    """
    return np.stack(env.env_method("action_masks"))
