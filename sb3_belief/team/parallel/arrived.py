"""A model that has arrived in a worker process: as it was, what it logs and what becomes different in it."""

import io
import random
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger
from torch import nn

from sb3_belief.team.batched_forward import BatchedForward
from sb3_belief.team.parallel.messages import Message, dumps, loads
from sb3_belief.team.parallel.updating import STAYS, modules_of, optimizers_of, tensors_of, write_stream

# What PyTorch keeps in every module: parameters and submodules, which are looked at by themselves, and hooks
_MODULE_KEYS = set(vars(nn.Module())) - {"training"}
_PLAIN = (bool, int, float, str, type(None), type)


class Recorder(Logger):
    """Notes what is logged, for the model's own logger."""

    def __init__(self) -> None:
        super().__init__(None, [])
        self.calls: list[tuple[str, tuple, dict[str, Any]]] = []

    def take(self) -> list[tuple[str, tuple, dict[str, Any]]]:
        """
        :return: what was noted since the last time: methods and their arguments
        """
        calls, self.calls = self.calls, []
        return calls

    def record(self, *args: Any, **kwargs: Any) -> None:
        self.calls.append(("record", args, kwargs))
        super().record(*args, **kwargs)

    def record_mean(self, *args: Any, **kwargs: Any) -> None:
        self.calls.append(("record_mean", args, kwargs))
        super().record_mean(*args, **kwargs)

    def log(self, *args: Any, **kwargs: Any) -> None:
        self.calls.append(("log", args, kwargs))

    def dump(self, *args: Any, **kwargs: Any) -> None:
        self.calls.append(("dump", args, kwargs))
        super().dump(*args, **kwargs)


class ModelSnapshot:
    """What a model was when it arrived, or was last looked at, to tell what has become different."""

    def __init__(self, model: BaseAlgorithm):
        self._model = model
        self._tensors, optimizers = tensors_of(model), optimizers_of(model)
        parts = {"": model, "rollout_buffer": model.rollout_buffer, "logger": model.logger}  # type: ignore[attr-defined]
        # Held, so that no other object gets the identity of one of them
        self._parts: dict[str, Any] = {**parts, **dict(modules_of(model)), **self._tensors, **optimizers}
        self._known = {id(part): path for path, part in self._parts.items()}
        self._attributes = self._fingerprints()

    def _values(self) -> Iterator[tuple[tuple[str, str], Any]]:
        for name, value in vars(self._model).items():
            if name not in STAYS:
                yield ("", name), value
        for path, module in modules_of(self._model):
            # A module says by __getstate__() what belongs to it: recurrent ones hold weak references besides
            getstate = getattr(module, "__getstate__", None)
            state = vars(module) if getstate is None else getstate()
            for name, value in state.items() if id(module) in self._known else ():
                if name not in _MODULE_KEYS and not isinstance(value, BatchedForward):
                    yield (path, name), value

    def _fingerprints(self) -> dict[tuple[str, str], Any]:
        values = [(key, value) for key, value in self._values() if id(value) not in self._known]
        # A policy has its model's spaces, so once for each object
        objects = {id(value): value for _, value in values if type(value) not in _PLAIN}
        prints = {number: self._fingerprint(value) for number, value in objects.items()}
        return {key: prints.get(id(value), value) for key, value in values}

    def _fingerprint(self, value: Any) -> tuple[bytes, list[bytes]]:
        head, buffers = dumps(value, self._known)
        return head, [buffer.raw().tobytes() for buffer in buffers]

    def check(self) -> dict[tuple[str, str], Any]:
        """
        :return: fingerprints of all attributes
        :raises RuntimeError: if the model has become one that cannot be sent back
        """
        if self._own_tensors().keys() != self._tensors.keys():
            raise RuntimeError(f"train() of {type(self._model).__name__} adds or removes parameters of a network; use jobs=1.")
        return self._fingerprints()

    def _own_tensors(self) -> dict[str, th.Tensor]:
        # Networks that train() has made are attributes like any other
        new = tuple(f"{name}." for name, value in vars(self._model).items() if id(value) not in self._known)
        return {path: tensor for path, tensor in tensors_of(self._model).items() if not path.startswith(new)}

    def changes(self) -> dict[str, Any]:
        """
        :return: the part of a result that is about the model
        :raises RuntimeError: as ``check``
        """
        attributes, tensors = self.check(), self._own_tensors()
        changed = {
            key: value
            for key, value in self._values()
            if key in attributes and (key not in self._attributes or attributes[key] != self._attributes[key])
        }
        found = {
            "tensors": {path: (tensor is self._tensors[path], tensor) for path, tensor in tensors.items()},
            "optimizers": {
                path: optimizer.state_dict()
                for path, optimizer in optimizers_of(self._model).items()
                if id(optimizer) in self._known
            },
            "attributes": dumps(changed, self._known),
            "removed": [key for key in self._attributes if key not in attributes],
        }
        self._attributes, self._tensors = attributes, tensors
        return found

    def buffer(self) -> Message:
        """
        :return: what is in the rollout buffer, which an update uses up
        """
        return dumps(vars(self._model.rollout_buffer), self._known)  # type: ignore[attr-defined]


@contextmanager
def captured(found: dict[str, Any]) -> Iterator[None]:
    """
    :param found: what is printed and warned within the block is added to its ``output`` and ``warnings``
    """
    output = io.StringIO()
    with warnings.catch_warnings(record=True) as caught, redirect_stdout(output):
        warnings.simplefilter("always")
        yield
    found["output"] += output.getvalue()
    found["warnings"] += [(str(w.message), w.category, w.filename, w.lineno) for w in caught]


def rebuild(job: Message, recorder: Recorder) -> BaseAlgorithm:
    """
    :param job: as ``pack`` made it
    :param recorder: the model's logger here
    :return: the model; its random stream is the current one now
    """
    models: list[BaseAlgorithm] = []

    def find(known: Any) -> Any:
        if isinstance(known, str):
            return recorder if known == "_logger" else None
        if not models:
            models.append(known.__new__(known))
        return models[0]

    model, attributes, stream, python, settings = loads(job, find)
    vars(model).update(attributes, env=None, _vec_normalize_env=None, _logger=recorder)
    if th.get_num_threads() != settings["threads"]:
        th.set_num_threads(settings["threads"])
    enabled, warn_only = settings["deterministic"]
    th.use_deterministic_algorithms(enabled, warn_only=warn_only)
    th.set_default_dtype(settings["dtype"])
    np.seterr(**settings["numpy"])
    random.setstate(python)
    write_stream(stream)
    return model


def failure_of(error: BaseException) -> dict[str, Any]:
    """
    :param error: that was raised
    :return: the same so that it can be sent
    """
    text = "".join(traceback.format_exception(type(error), error, error.__traceback__))
    try:
        loads(dumps(error, {}))
    except Exception:
        error = RuntimeError(f"{type(error).__name__}: {error}")
    return {"error": error, "traceback": text}
