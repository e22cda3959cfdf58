"""The networks and optimizers of a model, by the paths at which they are found, and the wrappers around its environment."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from torch import nn


def modules_of(model: BaseAlgorithm) -> Iterator[tuple[str, nn.Module]]:
    """
    Iterate over all networks of a model and the modules in them.

    :param model: A model
    :return: Path and module
    """
    for name, root in vars(model).items():
        if isinstance(root, nn.Module):
            for path, module in root.named_modules():
                yield f"{name}.{path}".rstrip("."), module


def optimizers_of(model: BaseAlgorithm) -> dict[str, th.optim.Optimizer]:
    """
    Return the optimizers of a model and of its networks.

    :param model: A model
    :return: The optimizers by path
    """
    owners = [("", model), *((f"{path}.", module) for path, module in modules_of(model))]
    return {
        f"{path}{name}": value
        for path, owner in owners
        for name, value in vars(owner).items()
        if isinstance(value, th.optim.Optimizer)
    }


def wrappers_of(env: VecEnv | None) -> Iterator[VecEnvWrapper]:
    """
    Iterate over SB3 wrappers around an environment.

    :param env: Of a model or a team, if it has one
    :return: The wrappers, the outermost first
    """
    while isinstance(env, VecEnvWrapper):
        yield env
        env = env.venv


# What reset() makes anew in a rollout buffer, besides its arrays
_OF_ROLLOUT = {"pos", "full", "generator_ready"}


def lasting_parts(buffer: RolloutBuffer) -> dict[str, Any]:
    """
    Return the attributes of a rollout buffer that hold beyond its rollout, such as what is replayed of past ones.

    :param buffer: The buffer
    :return: Those that ``reset()`` does not make anew, by name
    """
    return {name: value for name, value in vars(buffer).items() if name not in _OF_ROLLOUT and not holds_arrays(value)}


def holds_arrays(value: Any) -> bool:
    """
    Return whether a value is an array, or a dict with one, at any depth.

    :param value: The value
    """
    if isinstance(value, dict):
        return any(holds_arrays(each) for each in value.values())
    return isinstance(value, np.ndarray)


def shown_space(model: BaseAlgorithm, kind: str) -> spaces.Space:
    """
    Return the space of what a model is shown in the team's environment, or of what it does there.

    :param model: A model. One that cuts what it is shown into rows, whose spaces are its own, has ``team_observation_space``
        and ``team_action_space``
    :param kind: ``"observation"`` or ``"action"``
    """
    return getattr(model, f"team_{kind}_space", getattr(model, f"{kind}_space"))
