"""A worker process: it updates models as they are sent, and chooses actions with the policies that it has updated."""

import io
import queue
import random
import threading
import traceback
import warnings
from collections.abc import Iterator
from contextlib import redirect_stdout
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger
from torch import nn

from sb3_belief.team.jobs.acting import do_passes
from sb3_belief.team.jobs.messages import Message, dumps, loads, receive, send
from sb3_belief.team.jobs.updating import STAYS, modules_of, optimizers_of, read_stream, tensors_of, write_stream
from sb3_belief.team.processes import leave_interrupts_to_main
from sb3_belief.team.stacking import Part

# What PyTorch keeps in every module: parameters and submodules, which are looked at by themselves, and hooks
_MODULE_KEYS = set(vars(nn.Module())) - {"training"}
_PLAIN = (bool, int, float, str, type(None), type)


def serve(connection: Connection) -> None:
    """
    What a worker process does until its team is gone.

    :param connection: brings jobs, one after the other, and takes their results
    """
    leave_interrupts_to_main()
    # The team sends without waiting for results, so both ways must always be free
    jobs: queue.SimpleQueue[tuple[Any, Any] | None] = queue.SimpleQueue()
    results: queue.SimpleQueue[tuple[Any, Any]] = queue.SimpleQueue()
    threading.Thread(target=_receive_jobs, args=(connection, jobs), daemon=True).start()
    threading.Thread(target=_send_results, args=(connection, results), daemon=True).start()
    parts: dict[str, Part] = {}
    while (given := jobs.get()) is not None:
        agent, job = given
        if agent is None:
            results.put((None, do_passes(parts, job)))
        else:
            result, policy = update(job)
            parts.pop(agent, None)
            if policy is not None:
                parts[agent] = Part(policy)
            results.put((agent, result))


def _receive_jobs(connection: Connection, jobs: queue.SimpleQueue) -> None:
    try:
        while True:
            jobs.put(receive(connection))
    except (EOFError, OSError):
        jobs.put(None)


def _send_results(connection: Connection, results: queue.SimpleQueue) -> None:
    try:
        while True:
            send(connection, *results.get())
    except OSError:
        # The team is gone, as the other thread notices
        pass


class _Recorder(Logger):
    """Notes what is logged, for the model's own logger."""

    def __init__(self) -> None:
        super().__init__(None, [])
        self.calls: list[tuple[str, tuple, dict[str, Any]]] = []

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


class _Before:
    """What a model was before its update, to tell afterwards what has become different."""

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
                if name not in _MODULE_KEYS:
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

    def changes(self) -> dict[str, Any]:
        """
        :return: the part of a result that is about the model
        """
        attributes = self._fingerprints()
        # Networks that train() has made are attributes like any other
        new = tuple(f"{name}." for name, value in vars(self._model).items() if id(value) not in self._known)
        tensors = {path: tensor for path, tensor in tensors_of(self._model).items() if not path.startswith(new)}
        if tensors.keys() != self._tensors.keys():
            raise RuntimeError(f"train() of {type(self._model).__name__} adds or removes parameters of a network; use jobs=1.")
        changed = {
            key: value
            for key, value in self._values()
            if key in attributes and (key not in self._attributes or attributes[key] != self._attributes[key])
        }
        return {
            "tensors": {path: (tensor is self._tensors[path], tensor) for path, tensor in tensors.items()},
            "optimizers": {
                path: optimizer.state_dict()
                for path, optimizer in optimizers_of(self._model).items()
                if id(optimizer) in self._known
            },
            "attributes": dumps(changed, self._known),
            "removed": [key for key in self._attributes if key not in attributes],
        }


def update(job: Message) -> tuple[Message, Any]:
    """
    :param job: as ``pack`` made it
    :return: the result, for ``unpack_result``, and the updated policy
    """
    recorder, output = _Recorder(), io.StringIO()
    content: dict[str, Any] = {"tensors": None, "error": None}
    before: _Before | None = None
    policy = None
    with warnings.catch_warnings(record=True) as caught, redirect_stdout(output):
        warnings.simplefilter("always")
        try:
            model = _rebuild(job, recorder)
            before = _Before(model)
            model.train()  # type: ignore[attr-defined]
        except BaseException as error:
            content.update(_failure(error))
        try:
            if before is not None:
                content.update(before.changes(), stream=read_stream())
                policy = model.policy
        except Exception as error:
            content.update(_failure(error), tensors=None)
    content.update(output=output.getvalue(), log=recorder.calls)
    content["warnings"] = [(str(w.message), w.category, w.filename, w.lineno) for w in caught]
    try:
        return dumps(content, {}), policy
    except Exception as error:
        return dumps({**content, **_failure(error), "tensors": None, "log": []}, {}), None


def _rebuild(job: Message, recorder: _Recorder) -> BaseAlgorithm:
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


def _failure(error: BaseException) -> dict[str, Any]:
    text = "".join(traceback.format_exception(type(error), error, error.__traceback__))
    try:
        loads(dumps(error, {}))
    except Exception:
        error = RuntimeError(f"{type(error).__name__}: {error}")
    return {"error": error, "traceback": text}
