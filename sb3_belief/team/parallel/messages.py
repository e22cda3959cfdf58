"""Models as messages between processes."""

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
    A pickle whose large arrays travel beside it.

    :param head: The pickle
    :param buffers: The large arrays that it leaves out
    """

    head: bytes
    buffers: list[Any]


# The least number of bytes of a large array
_LARGE = 1 << 12
# Finds the object for a placeholder in the message that is being read
_find: Callable[[Any], Any] = id


class _Pickler(cloudpickle.Pickler):
    """
    Pickles functions and classes that cannot be imported, too, and tensors in a tenth of the time that PyTorch takes.

    :param file: Gets the pickle
    :param known: For the ids of some objects, the placeholders that are written instead
    :param buffers: Gets the large arrays
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
    Pickle an object.

    :param obj: The object
    :param known: For the ids of some objects, the placeholders that are sent instead
    :return: The message, which shares the memory of the object's large arrays: to be sent before they change
    """
    file, buffers = io.BytesIO(), list[Any]()
    _Pickler(file, known, buffers).dump(obj)
    return Message(file.getvalue(), buffers)


def loads(message: Message, find: Callable[[Any], Any] = id) -> Any:
    """
    Unpickle a message.

    :param message: As it was received
    :param find: Returns the object for a placeholder
    :return: The object
    """
    global _find
    before, _find = _find, find
    try:
        return pickle.loads(message.head, buffers=message.buffers)
    finally:
        _find = before


def _recall(known: Any) -> Any:
    return _find(known)


def send(connection: Connection, content: Any) -> None:
    """
    Send something to another process.

    :param connection: To the other process
    :param content: A ``Message``, or something small without tensors that a plain pickle can hold
    """
    if not isinstance(content, Message):
        connection.send((None, content))
        return
    buffers = [buffer.raw() for buffer in content.buffers]
    connection.send(([buffer.nbytes for buffer in buffers], content.head))
    for buffer in buffers:
        connection.send_bytes(buffer)


def receive(connection: Connection) -> Any:
    """
    Receive what :func:`send` has sent.

    :param connection: To the other process
    :return: The content
    """
    sizes, content = connection.recv()
    if sizes is None:
        return content
    buffers = [bytearray(size) for size in sizes]
    for buffer in buffers:
        connection.recv_bytes_into(buffer)
    return Message(content, buffers)


def own_tensor(array: np.ndarray, stride: tuple[int, ...]) -> th.Tensor:
    """
    Make a tensor in PyTorch's own memory, with the strides that it had. Matrix products may differ in the last bit depending
    on alignment and strides.

    :param array: The values
    :param stride: The strides of the original tensor
    :return: The tensor
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
