"""
What decides how an agent's model goes on learning, besides what its SB3 zip holds (weights, optimisers, settings).

It is read and put back where SB3 begins a rollout, or between two calls of ``learn()``: there a rollout buffer is empty, and
nothing lies in SB3's local variables.
"""

import inspect
import warnings
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import BaseBuffer, RolloutBuffer
from stable_baselines3.common.distributions import StateDependentNoiseDistribution
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from torch import nn

from sb3_belief.belief_ppo.cut_returns import CutReturns
from sb3_belief.common.plain_data import NotPlainError, PlainData, decode, encode
from sb3_belief.common.rng import RngState
from sb3_belief.common.safe_files.trust import MODEL_PACKAGES, Trust, is_allowed
from sb3_belief.team.model_parts import holds_arrays, lasting_parts, wrappers_of

# Parts of a model that its zip or its team saves, and constants
_NO_STATE = (nn.Module, th.optim.Optimizer, spaces.Space, BaseBuffer, Logger, VecEnv, th.device, str, type)
# Of a learn() that has begun, not of the model
_OF_LEARN = {
    "start_time",
    "_total_timesteps",
    "_num_timesteps_at_start",
    "_custom_logger",
    "_logger",
    "env",
    "_vec_normalize_env",
}
_NOISE_MATRICES = ("exploration_mat", "exploration_matrices")
_OF_WRAPPER = {"venv", "class_attributes", "num_envs"}


def read_agent_state(model: BaseAlgorithm, rng: RngState) -> PlainData:
    """
    Return what decides how an agent goes on learning.

    What cannot be written as plain data is left out, with a warning.

    :param model: The agent's model, at the beginning of a rollout or outside of ``learn()``
    :param rng: Its random number generators, which are not the current ones
    :return: The state
    """
    state: dict[str, Any] = {
        "rng": rng.get(),
        # Off-policy algorithms explore by sampling from it
        "action_space": model.action_space._np_random,
        "attributes": _attributes(model),
        "modules": {path: dict(_numbers(module)) for path, module in model.policy.named_modules()},
        "noise": {path: matrices for path, matrices in _noise_matrices(model)},
        "buffers": {name: _buffer_state(buffer) for name, buffer in _buffers(model)},
        "wrappers": [_wrapper_state(wrapper) for wrapper in wrappers_of(model.env)],
    }
    try:
        return encode(state, _any_module)
    except NotPlainError:
        left_out = [name for name, value in state["attributes"].items() if not _is_plain(value)]
        for name in left_out:
            del state["attributes"][name]
        warnings.warn(
            f"{type(model).__name__} has attributes that are not plain data, {left_out}: they are not saved, and what is"
            " resumed from there may differ from an undisturbed training.",
            stacklevel=2,
        )
        return encode(state, _any_module, type(model).__name__)


def write_agent_state(model: BaseAlgorithm, rng: RngState, state: PlainData) -> None:
    """
    Put an agent's state back.

    :param model: A model of the same class, loaded from the zip that belongs to the state
    :param rng: Its random number generators, which are not the current ones
    :param state: As :func:`read_agent_state` returned it
    :raises ValueError: If the state is not that of such a model
    """
    # The model itself has been loaded, so its own package is trusted already
    module = type(model).__module__
    trust = Trust(False, () if is_allowed(module, MODEL_PACKAGES) else (module.partition(".")[0],))
    saved = decode(state, trust.allowed, "state", lambda found: found is CutReturns or trust.accepts(found))
    try:
        _put_back(model, saved)
        rng.set(saved["rng"])
    except (KeyError, AttributeError, TypeError, IndexError) as error:
        raise ValueError(f"The saved state does not fit a {type(model).__name__}: {error!r}.") from error


def _any_module(module: str) -> bool:
    return True


def _is_plain(value: Any) -> bool:
    try:
        encode(value, _any_module)
    except NotPlainError:
        return False
    return True


def _attributes(model: BaseAlgorithm) -> dict[str, Any]:
    """
    Return the numbers, arrays and containers that a model holds. Settings are among them, because SB3 changes some of them
    while it makes a model, and changes them once more at a load (DQN's ``target_update_interval``).
    """
    return {
        name: value
        for name, value in vars(model).items()
        if isinstance(value, ActionNoise)
        or not (name in _OF_LEARN or name.endswith("_kwargs") or isinstance(value, _NO_STATE) or callable(value))
    }


def _numbers(module: nn.Module) -> Iterator[tuple[str, Any]]:
    """Iterate over numbers and arrays that a module holds besides its parameters, and over buffers that are not saved."""
    for name, value in vars(module).items():
        if isinstance(value, (bool, int, float, np.ndarray, th.Tensor)):
            yield name, value
    for name in module._non_persistent_buffers_set:
        if module._buffers[name] is not None:
            yield name, module._buffers[name]


def _noise_matrices(model: BaseAlgorithm) -> Iterator[tuple[str, dict[str, th.Tensor]]]:
    """Iterate over the noise with which gSDE explores until it draws anew."""
    for path, module in model.policy.named_modules():
        distribution = getattr(module, "action_dist", None)
        if isinstance(distribution, StateDependentNoiseDistribution) and hasattr(distribution, _NOISE_MATRICES[0]):
            yield path, {name: getattr(distribution, name).detach() for name in _NOISE_MATRICES}


def _buffers(model: BaseAlgorithm) -> Iterator[tuple[str, BaseBuffer]]:
    for name, value in vars(model).items():
        if isinstance(value, BaseBuffer):
            yield name, value


def _buffer_state(buffer: BaseBuffer) -> dict[str, Any]:
    if isinstance(buffer, RolloutBuffer):
        return _states_in(lasting_parts(buffer))
    n_rows = buffer.buffer_size if buffer.full else buffer.pos + 1
    return {name: _first_rows(value, n_rows, buffer.buffer_size) for name, value in _states_in(vars(buffer)).items()}


def _states_in(parts: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in parts.items() if not (isinstance(value, _NO_STATE) or callable(value))}


def _first_rows(value: Any, n_rows: int, size: int) -> Any:
    """Return the rows of a replay buffer that have been written to, in arrays of one row for each transition."""
    if isinstance(value, dict):
        return {key: _first_rows(each, n_rows, size) for key, each in value.items()}
    return value[:n_rows] if isinstance(value, np.ndarray) and len(value) == size else value


def _wrapper_state(wrapper: VecEnvWrapper) -> dict[str, Any]:
    settings = inspect.signature(type(wrapper).__init__).parameters
    return {
        name: value
        for name, value in vars(wrapper).items()
        if not (name in _OF_WRAPPER or name in settings or isinstance(value, _NO_STATE) or callable(value))
    }


@th.no_grad()
def _put_back(model: BaseAlgorithm, saved: dict[str, Any]) -> None:
    model.action_space._np_random = saved["action_space"]
    _put_into(model, saved["attributes"])
    for path, numbers in saved["modules"].items():
        module = model.policy.get_submodule(path)
        _put_into(module, {name: value for name, value in numbers.items() if name not in module._buffers})
        for name in numbers.keys() & module._buffers.keys():
            module._buffers[name] = numbers[name]
    for path, matrices in saved["noise"].items():
        distribution = model.policy.get_submodule(path).action_dist
        for name in _NOISE_MATRICES:
            setattr(distribution, name, matrices[name])
    for name, values in saved["buffers"].items():
        for key, value in values.items():
            # A replay buffer may be most of the memory: its arrays are filled, not replaced
            if not _written_into(vars(vars(model)[name]).get(key), value):
                _put_into(vars(model)[name], {key: value})
    wrappers = list(wrappers_of(model.env))
    if len(saved["wrappers"]) != len(wrappers):
        raise ValueError(f"The saved agent had {len(saved['wrappers'])} wrappers around its environment, not {len(wrappers)}.")
    for wrapper, values in zip(wrappers, saved["wrappers"], strict=True):
        _put_into(wrapper, values)


def _put_into(owner: Any, values: Mapping[str, Any]) -> None:
    """Set attributes, writing into the tensors that are there: optimisers refer to them."""
    own = vars(owner)
    for name, value in values.items():
        if callable(getattr(type(owner), name, None)):
            raise ValueError(f"The saved state names {name!r}, which is a method of {type(owner).__name__}.")
        present = own.get(name)
        if isinstance(present, th.Tensor) and isinstance(value, th.Tensor) and present.shape == value.shape:
            present.copy_(value)
        elif isinstance(present, ActionNoise) and type(present) is type(value):
            # SB3 has taken it into a local variable before the rollout began
            vars(present).update(vars(value))
        else:
            own[name] = value


def _written_into(present: Any, value: Any) -> bool:
    """Write rows into an array that is larger, and tell whether that was so."""
    if isinstance(present, dict) and isinstance(value, dict) and present.keys() == value.keys() and holds_arrays(value):
        return all([_written_into(present[key], value[key]) for key in value])
    if not (isinstance(present, np.ndarray) and isinstance(value, np.ndarray)):
        return False
    if present.dtype != value.dtype or present.ndim != value.ndim or present.ndim == 0:
        return False
    if present.shape[1:] != value.shape[1:] or len(value) > len(present):
        return False
    present[: len(value)] = value
    return True
