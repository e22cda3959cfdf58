"""
What an agent's update takes to a worker process and what it brings back.

A job is the model as it is, without environment and logger, and where its random stream stands: no update builds on what a
worker has kept of the one before. A result is what has become different. Tensors are written into those that are there, so
that whoever holds a parameter, or counts its changes as PyTorch's version counters do, sees the update as if made here.
"""

import random
import sys
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import recursive_getattr
from torch import nn

from sb3_belief.team.parallel.messages import Message, dumps, loads

#: Attributes of a model that stay where they are; a rollout buffer is used up by the update
STAYS = ("env", "_vec_normalize_env", "_logger")
#: Replaced in models while a team learns (see ``sharing``)
REPLACED = ("train", "_excluded_save_params")
# For Python's rule that a warning is shown once per place
_shown: dict[Any, Any] = {}


def read_stream() -> tuple[th.Tensor, dict[str, Any]]:
    """
    :return: where the global generators of torch and numpy stand
    """
    return th.get_rng_state(), np.random.get_state(legacy=False)


def write_stream(stream: tuple[th.Tensor, dict[str, Any]]) -> None:
    """
    :param stream: as ``read_stream`` returned it
    """
    th.set_rng_state(stream[0])
    np.random.set_state(stream[1])


def modules_of(model: BaseAlgorithm) -> Iterator[tuple[str, nn.Module]]:
    """
    :param model: a model
    :return: the path and the module, for each of its networks and all within
    """
    for name, root in vars(model).items():
        if isinstance(root, nn.Module):
            for path, module in root.named_modules():
                yield f"{name}.{path}".rstrip("."), module


def optimizers_of(model: BaseAlgorithm) -> dict[str, th.optim.Optimizer]:
    """
    :param model: a model
    :return: {path: optimizer}
    """
    owners = [("", model), *((f"{path}.", module) for path, module in modules_of(model))]
    return {
        f"{path}{name}": value
        for path, owner in owners
        for name, value in vars(owner).items()
        if isinstance(value, th.optim.Optimizer)
    }


def tensors_of(model: BaseAlgorithm) -> dict[str, th.Tensor]:
    """
    :param model: a model
    :return: {path: parameter or buffer}
    """
    return {
        f"{path}.{name}": tensor
        for path, module in modules_of(model)
        for named in (module._parameters, module._buffers)
        for name, tensor in named.items()
        if tensor is not None
    }


def _at(model: BaseAlgorithm, path: str) -> Any:
    return recursive_getattr(model, path) if path else model


def pack(model: BaseAlgorithm) -> Message:
    """
    :param model: about to be updated, its random stream being the current one
    :return: the job
    :raises ValueError: if something about the model cannot be pickled
    """
    attributes = {name: value for name, value in vars(model).items() if name not in (*STAYS, *REPLACED)}
    known: dict[int, Any] = {id(vars(model).get(name)): name for name in STAYS if vars(model).get(name) is not None}
    known[id(model)] = type(model)
    settings = {
        "threads": th.get_num_threads(),
        "deterministic": (th.are_deterministic_algorithms_enabled(), th.is_deterministic_algorithms_warn_only_enabled()),
        "dtype": th.get_default_dtype(),
        "numpy": np.geterr(),
    }
    try:
        # Python's generator is the team's: with it a run repeats itself, but is not that of another number of jobs
        return dumps((model, attributes, read_stream(), random.getstate(), settings), known)
    except Exception as error:
        culprits = [name for name, value in attributes.items() if not _can_pickle(value, known)]
        raise ValueError(
            f"Its {type(model).__name__} cannot be sent to a worker process because of {', '.join(culprits) or 'an attribute'}"
            f" ({type(error).__name__}: {error}); use jobs=1."
        ) from error


def pack_of(agent: str, model: BaseAlgorithm) -> Message:
    """
    :param agent: whose model it is
    :param model: the model
    :return: the same as a message
    :raises ValueError: if it cannot be one
    """
    try:
        return pack(model)
    except ValueError as error:
        raise ValueError(f"Agent {agent!r} cannot be updated in another process. {error}") from error


def _can_pickle(value: Any, known: dict[int, Any]) -> bool:
    try:
        dumps(value, known)
    except Exception:
        return False
    return True


def unpack_result(model: BaseAlgorithm, result: Message) -> None:
    """
    Make the model what it is after the update, and its random stream the current one.

    :param model: as it was when the job was packed
    :param result: of the job
    :raises BaseException: what ``train()`` raised, after the model is what it was then
    """
    content = loads(result)
    if content["tensors"] is not None:
        write_changes(model, content)
        write_stream(content["stream"])
    show(content)
    tell(model, content["log"])
    raise_failure(content)


@th.no_grad()
def write_changes(model: BaseAlgorithm, changes: dict[str, Any]) -> None:
    """
    :param model: as it was before
    :param changes: what has become different since then
    """
    _write_tensors(model, changes["tensors"])
    _write_optimizers(model, changes["optimizers"])
    attributes = loads(changes["attributes"], lambda path: _at(model, path))
    for (path, name), value in attributes.items():
        vars(_at(model, path))[name] = value
    for path, name in changes["removed"]:
        del vars(_at(model, path))[name]


def write_buffer(model: BaseAlgorithm, content: Message) -> None:
    """
    :param model: whose rollout buffer it is
    :param content: of the buffer
    """
    vars(model.rollout_buffer).update(loads(content, lambda path: _at(model, path)))  # type: ignore[attr-defined]


def tell(model: BaseAlgorithm, log: list[tuple[str, tuple, dict[str, Any]]]) -> None:
    """
    :param model: to whose logger it goes
    :param log: what was logged elsewhere
    """
    for method, args, kwargs in log:
        getattr(model.logger, method)(*args, **kwargs)


def show(content: dict[str, Any]) -> None:
    """
    :param content: with what was printed and warned elsewhere
    """
    if content["output"]:
        sys.stdout.write(content["output"])
    for message, category, filename, lineno in content["warnings"]:
        warnings.warn_explicit(message, category, filename, lineno, registry=_shown)


def raise_failure(content: dict[str, Any]) -> None:
    """
    :param content: with what was raised elsewhere, if anything
    :raises BaseException: this
    """
    if content["error"] is not None:
        # As concurrent.futures shows where it happened
        raise content["error"] from _WorkerTraceback(content["traceback"])


class _WorkerTraceback(Exception):
    def __str__(self) -> str:
        return f'\n"""\n{self.args[0]}"""'


def _write_tensors(model: BaseAlgorithm, tensors: dict[str, tuple[bool, th.Tensor]]) -> None:
    here = tensors_of(model)
    for path, (same, tensor) in tensors.items():
        if same and here[path].shape == tensor.shape:
            here[path].copy_(tensor)
            here[path].grad = tensor.grad
        else:
            # Such as a history that was renewed: who holds the old one keeps it
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
