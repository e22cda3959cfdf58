"""
A model as it moves to a worker process and back.

There it is built anew from all its attributes, without environment and logger, which stay. Back comes everything that its
``learn()`` may have changed. Tensors are written into those that are there, so whoever holds a parameter, or counts its
changes by PyTorch's version counters, sees the training as if it had happened here.
"""

import random
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.save_util import recursive_getattr
from torch import nn

from sb3_belief.team.batched_forward import BatchedForward
from sb3_belief.team.model_parts import lasting_parts, modules_of, optimizers_of
from sb3_belief.team.parallel.messages import Message, dumps, loads

# Attributes of a model that stay where they are
_STAYS = ("env", "_vec_normalize_env", "_logger")
# What PyTorch keeps in every module: parameters and submodules, which travel by themselves, and hooks
_MODULE_KEYS = set(vars(nn.Module())) - {"training"}


def _tensors_of(model: BaseAlgorithm) -> dict[str, th.Tensor]:
    """Return all parameters and buffers, by path."""
    return {
        f"{path}.{name}": tensor
        for path, module in modules_of(model)
        for named in (module._parameters, module._buffers)
        for name, tensor in named.items()
        if tensor is not None
    }


def _attributes_of(model: BaseAlgorithm) -> dict[tuple[str, str], Any]:
    """Return all that belongs to a model and its modules besides tensors and submodules, by path and name."""
    found = {("", name): value for name, value in vars(model).items() if name not in _STAYS}
    for path, module in modules_of(model):
        # A module says by __getstate__() what belongs to it: recurrent ones hold weak references besides
        getstate = getattr(module, "__getstate__", None)
        state = vars(module) if getstate is None else getstate()
        found |= {(path, name): value for name, value in state.items() if name not in _MODULE_KEYS}
    # A replaced forward is the scheduler's; spaces never change, and models share them with their environments
    return {key: value for key, value in found.items() if not isinstance(value, (BatchedForward, spaces.Space))}


def _at(model: BaseAlgorithm, path: str) -> Any:
    return recursive_getattr(model, path) if path else model


# To a worker


def pack(agent: str, model: BaseAlgorithm) -> Message:
    """
    Make a message of a model.

    :param agent: Name of the agent
    :param model: Its model
    :return: The message, for :func:`unpack`
    :raises ValueError: If something of the model cannot be pickled
    """
    attributes = {name: value for name, value in vars(model).items() if name not in _STAYS}
    known: dict[int, Any] = {id(vars(model).get(name)): name for name in _STAYS if vars(model).get(name) is not None}
    known[id(model)] = type(model)
    settings = {
        "threads": th.get_num_threads(),
        "deterministic": (th.are_deterministic_algorithms_enabled(), th.is_deterministic_algorithms_warn_only_enabled()),
        "dtype": th.get_default_dtype(),
        "numpy": np.geterr(),
    }
    try:
        # Python's generator is shared by the whole team: a run repeats itself, but not with another number of jobs
        return dumps((model, attributes, random.getstate(), settings), known)
    except Exception as error:
        culprits = [name for name, value in attributes.items() if not _can_pickle(value, known)]
        raise ValueError(
            f"Agent {agent!r} cannot learn in another process. Its {type(model).__name__} cannot be sent to a worker process"
            f" because of {', '.join(culprits) or 'an attribute'} ({type(error).__name__}: {error}); use jobs=1."
        ) from error


def _can_pickle(value: Any, known: dict[int, Any]) -> bool:
    try:
        dumps(value, known)
    except Exception:
        return False
    return True


def unpack(message: Message, logger: Logger) -> BaseAlgorithm:
    """
    Build a model in a worker, and take over the settings of the main process.

    :param message: As :func:`pack` made it
    :param logger: The model's logger here
    :return: The model, without an environment
    """
    models: list[BaseAlgorithm] = []

    def find(known: Any) -> Any:
        if isinstance(known, str):
            return logger if known == "_logger" else None
        if not models:
            models.append(known.__new__(known))
        return models[0]

    model, attributes, python, settings = loads(message, find)
    vars(model).update(attributes, env=None, _vec_normalize_env=None, _logger=logger)
    if th.get_num_threads() != settings["threads"]:
        th.set_num_threads(settings["threads"])
    enabled, warn_only = settings["deterministic"]
    th.use_deterministic_algorithms(enabled, warn_only=warn_only)
    th.set_default_dtype(settings["dtype"])
    np.seterr(**settings["numpy"])
    random.setstate(python)
    return model


# Back from a worker


class StateReader:
    """
    Reads what a model has become in a worker.

    References to parts that the model had when it was unpacked are sent as their paths, so that they refer to the same parts
    in the main process.

    :param model: Just unpacked
    """

    def __init__(self, model: Any):
        self._model = model
        self._tensors = self._read_tensors = _tensors_of(model)
        self._modules = dict(modules_of(model))
        parts = {"": model, "rollout_buffer": model.rollout_buffer, "logger": model.logger}
        # Kept alive, so that no other object gets the identity of one of them
        self._parts = {**parts, **self._modules, **self._tensors, **optimizers_of(model)}
        self._known = {id(part): path for path, part in self._parts.items()}

    def read(self, with_buffer: bool) -> dict[str, Any]:
        """
        Read the state.

        :param with_buffer: Whether to include the rollout in the rollout buffer, beside what the buffer holds beyond it
        :return: The state, for :func:`write_state`
        :raises RuntimeError: If parameters or modules of a network were added, removed or replaced by other modules
        """
        # Networks that are new attributes of the model travel as a whole; those that were sent must have kept their parts
        roots = {path.partition(".")[0] for path in self._modules}
        modules = {path: module for path, module in modules_of(self._model) if path.partition(".")[0] in roots}
        attributes = {key: value for key, value in _attributes_of(self._model).items() if self._was_sent(key[0])}
        tensors = {
            path: tensor for path, tensor in _tensors_of(self._model).items() if self._was_sent(path.rpartition(".")[0])
        }
        same_modules = modules.keys() == self._modules.keys() and all(m is self._modules[path] for path, m in modules.items())
        if not same_modules or tensors.keys() != self._tensors.keys():
            raise RuntimeError(
                f"train() of {type(self._model).__name__} adds or removes parameters or modules of a network; use jobs=1."
            )
        buffer = self._model.rollout_buffer
        state = {
            "tensors": {path: (tensor is self._tensors[path], tensor) for path, tensor in tensors.items()},
            "optimizers": {
                path: optimizer.state_dict()
                for path, optimizer in optimizers_of(self._model).items()
                if id(optimizer) in self._known
            },
            "attributes": dumps(attributes, self._known),
            "buffer": dumps(vars(buffer) if with_buffer else lasting_parts(buffer), self._known),
        }
        self._read_tensors = tensors
        return state

    def mark_as_sent(self) -> None:
        """Tell that the state that was read last is sent: tensors that are replaced from now on are compared with it."""
        self._tensors = self._read_tensors

    def _was_sent(self, path: str) -> bool:
        return id(_at(self._model, path)) in self._known


@th.no_grad()
def write_state(model: Any, state: dict[str, Any]) -> None:
    """
    Make a model in the main process what it has become in a worker.

    :param model: As it was when it was packed, or when a state was last written
    :param state: As :meth:`StateReader.read` returned it
    """
    _write_tensors(model, state["tensors"])
    _write_optimizers(model, state["optimizers"])
    attributes = loads(state["attributes"], lambda path: _at(model, path))
    for path, name in _attributes_of(model).keys() - attributes.keys():
        vars(_at(model, path)).pop(name, None)
    for (path, name), value in attributes.items():
        vars(_at(model, path))[name] = value
    vars(model.rollout_buffer).update(loads(state["buffer"], lambda path: _at(model, path)))


def _write_tensors(model: BaseAlgorithm, tensors: dict[str, tuple[bool, th.Tensor]]) -> None:
    here = _tensors_of(model)
    for path, (is_same, tensor) in tensors.items():
        if is_same and here[path].shape == tensor.shape:
            here[path].copy_(tensor)
            here[path].requires_grad_(tensor.requires_grad)
            here[path].grad = tensor.grad
        else:
            # Replaced there, such as a history that was renewed: whoever holds the old one keeps it
            owner, _, name = path.rpartition(".")
            module = _at(model, owner)
            (module._parameters if name in module._parameters else module._buffers)[name] = tensor


def _write_optimizers(model: BaseAlgorithm, optimizers: dict[str, dict[str, Any]]) -> None:
    here = optimizers_of(model)
    for path, saved in optimizers.items():
        optimizer = here[path]
        params = [param for group in optimizer.param_groups for param in group["params"]]
        optimizer.state.clear()
        optimizer.state.update({params[index]: state for index, state in saved["state"].items()})
        for group, values in zip(optimizer.param_groups, saved["param_groups"], strict=True):
            group.update({name: value for name, value in values.items() if name != "params"})
