"""Models and what changes in them, as messages between processes."""

import io
import pickle
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

import cloudpickle
import numpy as np
import torch as th
from torch import nn


class Message(NamedTuple):
    """
    :param head: a pickle
    :param buffers: the large arrays that it leaves out
    """

    head: bytes
    buffers: list[Any]


# Bytes from which on an array is one
_LARGE = 1 << 12
# Finds what stands for itself in the message that is being read
_find: Callable[[Any], Any] = id


class _Pickler(cloudpickle.Pickler):
    """
    Also takes functions and classes that cannot be imported, and tensors in a tenth of the time of PyTorch's own way.

    :param file: where to write
    :param known: {id of an object: what is written in its place}
    :param buffers: where large arrays go
    """

    def __init__(self, file: io.BytesIO, known: dict[int, Any], buffers: list[Any]):
        super().__init__(file, protocol=5, buffer_callback=self._is_small)
        self._known, self._buffers = known, buffers

    def _is_small(self, buffer: pickle.PickleBuffer) -> bool:
        if buffer.raw().nbytes < _LARGE:
            return True
        self._buffers.append(buffer)
        return False

    # Unlike persistent_id() it is not asked for every number and string
    def reducer_override(self, obj: Any) -> Any:
        if id(obj) in self._known:
            return _recall, (self._known[id(obj)],)
        if type(obj) in (th.Tensor, nn.Parameter) and obj.device.type == "cpu" and obj.layout == th.strided:
            if obj._backward_hooks:
                raise pickle.PicklingError("a tensor has backward hooks, which exist in this process only")
            if obj.dtype != th.bfloat16 and not (obj.is_conj() or obj.is_neg()):
                is_leaf = obj.is_leaf
                array = obj.detach().numpy()
                grad = obj.grad if is_leaf else None
                return _tensor, (array, obj.stride(), type(obj) is nn.Parameter, obj.requires_grad and is_leaf, grad)
        return super().reducer_override(obj)


def dumps(obj: Any, known: dict[int, Any]) -> Message:
    """
    :param obj: what is to be sent
    :param known: {id of an object: what is sent in its place}
    :return: to be sent before anything in it changes
    """
    file, buffers = io.BytesIO(), list[Any]()
    _Pickler(file, known, buffers).dump(obj)
    return Message(file.getvalue(), buffers)


def loads(message: Message, find: Callable[[Any], Any] = id) -> Any:
    """
    :param message: as it was received
    :param find: gives the object that something stands for that was sent in its place
    :return: what was sent
    """
    global _find
    before, _find = _find, find
    try:
        return pickle.loads(message.head, buffers=message.buffers)
    finally:
        _find = before


def _recall(known: Any) -> Any:
    return _find(known)


def send(connection: Connection, agent: str | None, content: Any) -> None:
    """
    :param connection: to the other process
    :param agent: whom it is about; None for a branch
    :param content: a ``Message``, or something small without tensors, whose pickle does not need one
    """
    if not isinstance(content, Message):
        connection.send((agent, None, content))
        return
    buffers = [buffer.raw() for buffer in content.buffers]
    connection.send((agent, [buffer.nbytes for buffer in buffers], content.head))
    for buffer in buffers:
        connection.send_bytes(buffer)


def receive(connection: Connection) -> tuple[str | None, Any]:
    """
    :param connection: to the other process
    :return: as they were sent: whom it is about, and what
    """
    agent, sizes, content = connection.recv()
    if sizes is None:
        return agent, content
    buffers = [bytearray(size) for size in sizes]
    for buffer in buffers:
        connection.recv_bytes_into(buffer)
    return agent, Message(content, buffers)


def own_tensor(array: np.ndarray, stride: tuple[int, ...]) -> th.Tensor:
    """
    :param array: the values
    :param stride: of the tensor that they were
    :return: the same in memory and order of PyTorch's own: by where a tensor lies, matrix products may differ in the last bit
    """
    source = th.from_numpy(array)
    return th.empty_strided(source.shape, stride, dtype=source.dtype).copy_(source)


def _tensor(
    array: np.ndarray, stride: tuple[int, ...], is_parameter: bool, requires_grad: bool, grad: th.Tensor | None
) -> th.Tensor:
    tensor = own_tensor(array, stride)
    if is_parameter:
        tensor = nn.Parameter(tensor, requires_grad)
    else:
        tensor.requires_grad_(requires_grad)
    tensor.grad = grad
    return tensor
