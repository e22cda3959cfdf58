"""How much memory a model needs for its observations, estimated before any of it is allocated."""

import warnings

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim, get_obs_shape, is_image_space

_GIGABYTE = 1e9


def holds_images(observation_space: spaces.Space) -> bool:
    """
    Return whether an observation is an image, or has one among its entries.

    :param observation_space: Of the agent
    """
    if isinstance(observation_space, spaces.Dict):
        return any(holds_images(part) for part in observation_space.spaces.values())
    return is_image_space(observation_space)


def observation_bytes(observation_space: spaces.Space) -> int:
    """
    Return the size of an observation in SB3's rollout buffer.

    :param observation_space: Of the agent
    :return: In bytes
    """
    if isinstance(observation_space, spaces.Dict):
        return sum(observation_bytes(part) for part in observation_space.spaces.values())
    shape: tuple[int, ...] = get_obs_shape(observation_space)  # type: ignore[assignment]
    return int(np.prod(shape)) * np.dtype(observation_space.dtype).itemsize


def warn_of_memory(
    observation_space: spaces.Space, n_steps: int, n_envs: int, history_length: int, embedding_dim: int
) -> None:
    """
    Warn if a model needs more than a gigabyte for its observations.

    :param observation_space: Of the agent
    :param n_steps: Steps of a rollout
    :param n_envs: Copies of the environment
    :param history_length: Rows of the history, and of what is replayed, that hold whole observations; 0 for none
    :param embedding_dim: Width of the embedding of a whole observation
    """
    rollout = n_steps * n_envs * observation_bytes(observation_space)
    row = 4 * get_flattened_obs_dim(observation_space) if history_length else 0
    # The layer that embeds observations has weights, gradients and two moments of Adam
    history = history_length * row + 4 * embedding_dim * row
    if rollout + history <= _GIGABYTE:
        return
    advice = "shrink images in the environment (supersuit.resize_v1, color_reduction_v0), or use fewer n_steps or copies"
    if history:
        advice += (
            ", a shorter history_length, or policy_kwargs=dict(belief_from_features=True), which lets the belief see the"
            " features that the policy has of an observation instead of the observation itself"
        )
    warnings.warn(
        f"This model needs about {(rollout + history) / _GIGABYTE:.1f} GB for its observations"
        f" ({rollout / _GIGABYTE:.1f} GB in the rollout buffer of {n_steps} steps of {n_envs} copies,"
        f" {history / _GIGABYTE:.1f} GB in the history and the layer that embeds it). If that is too much, {advice}.",
        # The line that makes the model
        stacklevel=5,
    )
