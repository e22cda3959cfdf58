"""The writer of plain data."""

import collections
import enum
import pathlib
import random
import struct
import types
from collections.abc import Callable, Iterable, Mapping
from math import isfinite
from types import MappingProxyType
from typing import Any

import numpy as np
import torch as th

from sb3_belief.common.plain_data import kinds
from sb3_belief.common.plain_data.kinds import ATOMS, BIT_GENERATORS, DATA_TYPES, Misfit, NotPlainError, PlainData, name_of

_Node = dict[str, Any]
_TH_DTYPES = {dtype: name for name, dtype in kinds.DTYPES.items()}
_SAFE_INTS = 2**63


def encode(
    value: Any,
    allowed: kinds.Allowed,
    path: str = "",
    accepts: kinds.Accepts = lambda found: True,
    known: Mapping[int, str] = MappingProxyType({}),
) -> PlainData:
    """
    Describe an object as plain data.

    Objects keep their identity: what is in two places, or within itself, is so again when it has been read.

    :param value: The object
    :param allowed: Whether classes and functions of a module may be named, as the reader will be told
    :param path: What the object is called in messages
    :param accepts: Whether a class, or a function, may be named, as the reader will be told
    :param known: Names by ``id()`` of objects that are not described, since the reader has them
    :return: Plain data for ``decode``
    :raises NotPlainError: If a part of it cannot be described
    """
    writer = _Encoder(allowed, accepts, known)
    try:
        tree = writer.child(value, "")
    except Misfit as error:
        raise NotPlainError(
            f"{error.where(path)} cannot be written as plain data: {error.reason}. Leave it out, or put there what is:"
            " numbers, texts, containers, arrays, random generators, and objects of classes of known or allowed packages."
        ) from None
    return PlainData(tree, b"".join(writer.buffers))


class _Encoder:
    def __init__(self, allowed: kinds.Allowed, accepts: kinds.Accepts, known: Mapping[int, str]):
        self._allowed, self._accepts, self._known = allowed, accepts, known
        # The object is kept so that its id is not given to another one
        self._memo: dict[int, tuple[_Node, Any]] = {}
        self._n_shared = 0
        self._depth = 0
        self.buffers: list[Any] = []

    def child(self, value: Any, key: Any, text: str = "[{!r}]") -> Any:
        kind = type(value)
        if kind in ATOMS and (kind is not float or isfinite(value)) and (kind is not int or -_SAFE_INTS < value < _SAFE_INTS):
            return value
        try:
            return self._node(value, kind)
        except Misfit as error:
            error.keys.append(text.format(key) if key != "" else "")
            raise

    def _node(self, value: Any, kind: type) -> Any:
        if kind is float:
            return {"is": "float", "bits": struct.pack(">d", value).hex()}
        if kind is int:
            return value if value.bit_length() < kinds.MAX_BITS else {"is": "int", "hex": hex(value)}
        if id(value) in self._known:
            return {"is": "known", "name": self._known[id(value)]}
        if id(value) in self._memo:
            return self._reference(value)
        if self._depth >= kinds.DEEPEST:
            raise Misfit(f"it is nested more than {kinds.DEEPEST} levels deep")
        self._depth += 1
        try:
            # Kinds with parts put themselves into the memo before they look at these; see _after() for those that cannot
            node = _WRITERS.get(kind, _Encoder._other)(self, value)
        finally:
            self._depth -= 1
        if "to" not in node:
            self._memo[id(value)] = node, value
        return node

    def _reference(self, value: Any) -> _Node:
        node, _ = self._memo[id(value)]
        if "id" not in node:
            node["id"] = self._n_shared
            self._n_shared += 1
        return {"is": "ref", "to": node["id"]}

    def _begin(self, value: Any, **node: Any) -> _Node:
        self._memo[id(value)] = node, value
        return node

    def _after(self, value: Any, node: _Node) -> _Node:
        """Return the node of an object that is built after its parts, or where it is if it has been met among them."""
        if id(value) in self._memo:
            node["to"] = self._reference(value)["to"]
        return node

    def _items(self, values: Any) -> list[Any]:
        found = set(map(type, values))
        if found <= {str, bool, type(None)}:
            return list(values)
        if found == {int} and -_SAFE_INTS < min(values) and max(values) < _SAFE_INTS:
            return list(values)
        # The sum of numbers that are not all finite is not
        if found == {float} and isfinite(sum(values)):
            return list(values)
        return [self.child(each, index) for index, each in enumerate(values)]

    def _pairs(self, pairs: Iterable[tuple[Any, Any]]) -> list[Any]:
        return [[self.child(key, repr(key)[:50], ", key {}"), self.child(each, key)] for key, each in pairs]

    # -- containers ----------------------------------------------------------------------------------------------------

    def _list(self, value: list) -> _Node:
        node = self._begin(value, **{"is": "list"})
        node["of"] = self._items(value)
        return node

    def _tuple(self, value: tuple) -> _Node:
        return self._after(value, {"is": "tuple", "of": self._items(value)})

    def _size(self, value: th.Size) -> _Node:
        return {"is": "size", "of": list(value)}

    def _namedtuple(self, value: Any) -> _Node:
        return self._after(
            value, {"is": "namedtuple", "class": self._class_name(type(value)), "of": self._items(tuple(value))}
        )

    def _dict(self, value: dict) -> _Node:
        if set(map(type, value)) <= {str}:
            node = self._begin(value, **{"is": "dict"})
            node["of"] = {key: self.child(each, key) for key, each in value.items()}
            return node
        node = self._begin(value, **{"is": "map"})
        node["of"] = self._pairs(value.items())
        return node

    def _ordered(self, value: collections.OrderedDict) -> _Node:
        node = self._begin(value, **{"is": "ordered"})
        node["of"] = self._pairs(value.items())
        return node

    def _defaults(self, value: collections.defaultdict) -> _Node:
        node = self._begin(value, **{"is": "defaults"})
        factory = value.default_factory
        if factory is not None and not isinstance(factory, type):
            raise Misfit(f"its default_factory {factory!r} is not a class")
        node["factory"] = None if factory is None else self._class_name(factory)
        node["of"] = self._pairs(value.items())
        return node

    def _set(self, value: set) -> _Node:
        node = self._begin(value, **{"is": "set"})
        node["of"] = self._items(list(value))
        return node

    def _frozenset(self, value: frozenset) -> _Node:
        return self._after(value, {"is": "frozenset", "of": self._items(list(value))})

    def _deque(self, value: collections.deque) -> _Node:
        node = self._begin(value, **{"is": "deque", "longest": value.maxlen})
        node["of"] = self._items(list(value))
        return node

    def _range(self, value: range) -> _Node:
        return {"is": "range", "of": self._items([value.start, value.stop, value.step])}

    def _slice(self, value: slice) -> _Node:
        return {"is": "slice", "of": self._items([value.start, value.stop, value.step])}

    # -- values --------------------------------------------------------------------------------------------------------

    def _complex(self, value: complex) -> _Node:
        return {"is": "complex", "bits": struct.pack(">dd", value.real, value.imag).hex()}

    def _bytes(self, value: bytes | bytearray) -> _Node:
        self.buffers.append(bytes(value))
        return {"is": type(value).__name__, "size": len(value)}

    def _ellipsis(self, value: Any) -> _Node:
        return {"is": "ellipsis"}

    def _path(self, value: pathlib.PurePath) -> _Node:
        return {"is": next(name for name, kind in kinds.PATHS.items() if isinstance(value, kind)), "value": str(value)}

    def _enum(self, value: enum.Enum) -> _Node:
        if type(value).__members__.get(value.name) is not value:
            raise Misfit(f"{value!r} is a combination, not a member")
        return {"is": "enum", "class": self._class_name(type(value)), "name": value.name}

    # -- arrays --------------------------------------------------------------------------------------------------------

    def _dtype_of(self, dtype: np.dtype) -> Any:
        if dtype.hasobject:
            raise Misfit(f"the dtype {dtype} holds objects")
        return _lists(np.lib.format.dtype_to_descr(dtype))

    def _dtype(self, value: np.dtype) -> _Node:
        if value == np.dtype(object):
            return {"is": "dtype", "of": "O"}
        return {"is": "dtype", "of": self._dtype_of(value)}

    def _array(self, value: np.ndarray) -> _Node:
        if value.dtype == np.dtype(object):
            node = self._begin(value, **{"is": "objects", "shape": list(value.shape)})
            node["of"] = [self.child(each, index) for index, each in enumerate(value.flat)]
            return node
        if value.dtype.itemsize == 0:
            raise Misfit(f"the entries of its dtype {value.dtype} have no size")
        order = "F" if value.flags.f_contiguous and not value.flags.c_contiguous else "C"
        node = {"is": "array", "dtype": self._dtype_of(value.dtype), "shape": list(value.shape), "order": order}
        flat = np.ascontiguousarray(value.T if order == "F" else value).reshape(-1)
        if flat.size:
            self.buffers.append(flat.view(np.uint8).data)
        return node

    def _scalar(self, value: np.generic) -> _Node:
        # An empty text has no bytes
        self.buffers.append(value.tobytes()[: value.dtype.itemsize])
        return {"is": "scalar", "dtype": self._dtype_of(value.dtype)}

    def _tensor(self, value: th.Tensor) -> _Node:
        if value.layout is not th.strided or value.dtype not in _TH_DTYPES:
            raise Misfit(f"tensors that are {value.layout} and {value.dtype} are not supported")
        flat = value.detach().cpu().resolve_conj().resolve_neg().contiguous().reshape(-1)
        if flat.numel():
            self.buffers.append(flat.view(th.uint8).numpy().data)
        return {
            "is": "tensor",
            "dtype": _TH_DTYPES[value.dtype],
            "shape": list(value.shape),
            "grad": bool(value.requires_grad and value.is_leaf),
            "parameter": type(value) is th.nn.Parameter,
        }

    def _torch_dtype(self, value: th.dtype) -> _Node:
        if value not in _TH_DTYPES:
            raise Misfit(f"{value} is not supported")
        return {"is": "torch_dtype", "name": _TH_DTYPES[value]}

    def _device(self, value: th.device) -> _Node:
        return {"is": "device", "name": str(value)}

    # -- random numbers ------------------------------------------------------------------------------------------------

    def _generator(self, value: np.random.Generator) -> _Node:
        return {"is": "generator", "bits": self.child(value.bit_generator, "bit_generator", ".{}")}

    def _bit_generator(self, value: np.random.BitGenerator) -> _Node:
        seed = value.seed_seq
        node: _Node = {"is": "bit_generator", "name": type(value).__name__}
        node["seed"] = self.child(seed, "seed_seq", ".{}") if type(seed) is np.random.SeedSequence else None
        node["state"] = self.child(value.state, "state", ".{}")
        return node

    def _seed_sequence(self, value: np.random.SeedSequence) -> _Node:
        return {"is": "seed_sequence", "state": self.child(dict(value.state), "state", ".{}")}

    def _random_state(self, value: np.random.RandomState) -> _Node:
        return {"is": "random_state", "state": self.child(value.get_state(legacy=False), "state", ".{}")}

    def _random(self, value: random.Random) -> _Node:
        return {"is": "random", "state": self.child(value.getstate(), "state", ".{}")}

    def _torch_generator(self, value: th.Generator) -> _Node:
        if value.device.type != "cpu":
            raise Misfit(f"a generator on {value.device} cannot be read elsewhere, its get_state() can")
        return {"is": "torch_generator", "state": self.child(value.get_state(), "state", ".{}")}

    # -- what has a name -----------------------------------------------------------------------------------------------

    def _named(self, value: Any, kind: type) -> str:
        name = name_of(value)
        if kinds.find(name, self._allowed, self._accepts, kind) is not value:
            raise Misfit(f"{name!r} names something else")
        return name

    def _class_name(self, value: type) -> str:
        return self._named(value, type)

    def _class(self, value: type) -> _Node:
        return {"is": "class", "name": self._class_name(value)}

    def _function(self, value: types.FunctionType) -> _Node:
        return {"is": "function", "name": self._named(value, types.FunctionType)}

    def _method(self, value: types.MethodType) -> _Node:
        function = value.__func__
        kinds.find_method(type(value.__self__), function.__name__, self._allowed, self._accepts, function)
        return self._after(
            value, {"is": "method", "name": function.__name__, "self": self.child(value.__self__, "self", ".{}")}
        )

    def _other(self, value: Any) -> _Node:
        kind = type(value)
        for base, write in _BASES:
            if isinstance(value, base):
                return write(self, value)
        if isinstance(value, tuple) and hasattr(kind, "_fields") and kind.__bases__ == (tuple,):
            return self._namedtuple(value)
        name = self._class_name(kind)
        if name in DATA_TYPES:
            raise Misfit(f"a {name} is not supported")
        kinds.check_object(kind)
        node = self._begin(value, **{"is": "object", "class": name})
        state = dict(getattr(value, "__dict__", {}))
        for slot, descriptor in kinds.slots_of(kind).items():
            if hasattr(value, slot):
                state[slot] = descriptor.__get__(value, kind)
        for attribute in kinds.left_out(kind):
            state.pop(attribute, None)
        for attribute in state:
            kinds.check_attribute(kind, attribute)
        node["state"] = {attribute: self.child(each, attribute, ".{}") for attribute, each in state.items()}
        return node


def _lists(descr: Any) -> Any:
    return [_lists(each) for each in descr] if isinstance(descr, (list, tuple)) else descr


_Writer = Callable[[_Encoder, Any], _Node]
_WRITERS: dict[type, _Writer] = {
    list: _Encoder._list,
    tuple: _Encoder._tuple,
    th.Size: _Encoder._size,
    dict: _Encoder._dict,
    collections.OrderedDict: _Encoder._ordered,
    collections.defaultdict: _Encoder._defaults,
    set: _Encoder._set,
    frozenset: _Encoder._frozenset,
    collections.deque: _Encoder._deque,
    range: _Encoder._range,
    slice: _Encoder._slice,
    complex: _Encoder._complex,
    bytes: _Encoder._bytes,
    bytearray: _Encoder._bytes,
    type(...): _Encoder._ellipsis,
    np.ndarray: _Encoder._array,
    th.Tensor: _Encoder._tensor,
    th.nn.Parameter: _Encoder._tensor,
    th.dtype: _Encoder._torch_dtype,
    th.device: _Encoder._device,
    np.random.Generator: _Encoder._generator,
    np.random.SeedSequence: _Encoder._seed_sequence,
    np.random.RandomState: _Encoder._random_state,
    random.Random: _Encoder._random,
    th.Generator: _Encoder._torch_generator,
    types.FunctionType: _Encoder._function,
    types.MethodType: _Encoder._method,
    **{kind: _Encoder._bit_generator for kind in BIT_GENERATORS.values()},
}
# Kinds that have many classes
_BASES: tuple[tuple[type, _Writer], ...] = (
    (type, _Encoder._class),
    (enum.Enum, _Encoder._enum),
    (np.generic, _Encoder._scalar),
    (np.dtype, _Encoder._dtype),
    (pathlib.PurePath, _Encoder._path),
)
