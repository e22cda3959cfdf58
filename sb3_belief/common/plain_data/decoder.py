"""The reader of plain data, which trusts none of it."""

import collections
import enum
import math
import random
import struct
import types
from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
import torch as th

from sb3_belief.common.plain_data import kinds
from sb3_belief.common.plain_data.kinds import ATOMS, Misfit, PlainData

# What numpy's C code takes as it is and would read beyond the state with
_POSITIONS = {"MT19937": ("state", "pos", 624), "Philox": (None, "buffer_pos", 4)}


def decode(
    data: PlainData,
    allowed: kinds.Allowed,
    path: str = "",
    accepts: kinds.Accepts = lambda found: True,
    known: Mapping[str, Any] = MappingProxyType({}),
) -> Any:
    """
    Rebuild an object from plain data.

    Objects are made without their constructor and given their attributes; no method of theirs is called, but for the hashes of
    what is in sets or is a key. Nothing is imported but modules that are allowed. An array takes no more memory than the bytes
    that are there for it.

    :param data: What ``encode`` has returned, or anything else
    :param allowed: Whether classes and functions of a module may be named. It is asked before the module is imported
    :param path: What the object is called in messages
    :param accepts: Whether a class, or a function, that has been found may be used
    :param known: The objects by name that were not described
    :return: The object
    :raises ValueError: If the data is not as ``encode`` writes it, or names what is not allowed
    """
    reader = _Decoder(data.blob, allowed, accepts, known)
    try:
        value = reader.child(data.tree, "")
        if reader.position != len(data.blob):
            raise Misfit(f"{len(data.blob) - reader.position} bytes of its arrays are left over")
    except Misfit as error:
        raise ValueError(f"{error.where(path)} is not readable plain data: {error.reason}.") from None
    return value


class _Decoder:
    def __init__(self, blob: bytes, allowed: kinds.Allowed, accepts: kinds.Accepts, known: Mapping[str, Any]):
        self._blob, self._allowed, self._accepts, self._objects_here = memoryview(blob), allowed, accepts, known
        self._shared: dict[int, Any] = {}
        self._n_nodes = self._depth = 0
        # Arrays are taken one after the other, so no byte is read twice
        self.position = 0

    def child(self, data: Any, key: Any, text: str = "[{!r}]") -> Any:
        if type(data) in ATOMS:
            return data
        try:
            return self._node(data)
        except Misfit as error:
            error.keys.append(text.format(key) if key != "" else "")
            raise

    def _node(self, data: Any) -> Any:
        kind = data.get("is") if type(data) is dict else None
        if type(kind) is not str or kind not in _READERS:
            raise Misfit(f"{str(data)[:80]!r} is of no known kind")
        fields, read = _READERS[kind]
        if data.keys() - {"is", "id", "to"} != fields or ("to" in data and kind not in _LATE):
            raise Misfit(f"a {kind} must have {sorted(fields)}, not {sorted(map(str, data))}"[:300])
        self._depth += 1
        self._n_nodes += 1
        if self._depth > kinds.DEEPEST or self._n_nodes > kinds.MOST_NODES:
            raise Misfit("it is nested too deeply, or has too many parts")
        try:
            value = read(self, data)
            if "to" in data and kind != "ref":
                # It has been met among its own parts, and is the one that was built there
                return self._known(data["to"], type(value))
            if "id" in data:
                self._begin(data, value)
        except Misfit:
            raise
        # Whatever numpy, torch, hashes and constructors of containers make of wrong arguments
        except Exception as error:
            raise Misfit(f"it is no {kind} ({type(error).__name__}: {str(error)[:200]})") from None
        finally:
            self._depth -= 1
        return value

    def _begin(self, data: dict[str, Any], value: Any) -> Any:
        """Make an object known before its parts are read, which may refer to it."""
        if "id" in data:
            number = self._int(data["id"])
            if self._shared.setdefault(number, value) is not value:
                raise Misfit(f"two objects have the number {number}")
        return value

    def _known(self, number: Any, kind: type | None = None) -> Any:
        if type(number) is not int or number not in self._shared:
            raise Misfit(f"it refers to {number!r}, which has not been read")
        if kind is not None and type(self._shared[number]) is not kind:
            raise Misfit(f"it refers to {number}, which is another kind")
        return self._shared[number]

    def _int(self, value: Any, least: int = 0) -> int:
        if type(value) is not int or value < least:
            raise Misfit(f"{str(value)[:50]!r} is no integer of at least {least}")
        return value

    def _a(self, kind: type, value: Any) -> Any:
        if type(value) is kind:
            return value
        raise Misfit(f"{str(value)[:50]!r} is no {kind.__name__}")

    def _shape(self, value: Any) -> tuple[int, ...]:
        if len(self._a(list, value)) > 32:
            raise Misfit("it has more than 32 dimensions")
        return tuple(self._int(each) for each in value)

    def _take(self, size: int) -> memoryview:
        end = self.position + self._int(size)
        if end > len(self._blob):
            raise Misfit(f"it needs {size} bytes, and {len(self._blob) - self.position} are left")
        found, self.position = self._blob[self.position : end], end
        return found

    def _class(self, name: Any) -> type:
        return kinds.find(name, self._allowed, self._accepts)

    # -- containers ----------------------------------------------------------------------------------------------------

    def _items(self, values: Any) -> Iterator[Any]:
        for index, each in enumerate(self._a(list, values)):
            yield each if type(each) in ATOMS else self.child(each, index)

    def _pairs(self, values: Any) -> Iterator[tuple[Any, Any]]:
        for index, pair in enumerate(self._a(list, values)):
            if type(pair) is not list or len(pair) != 2:
                raise Misfit(f"its entry {index} is no pair")
            key = self.child(pair[0], index, ", key {}")
            yield key, self.child(pair[1], key if type(key) in ATOMS else index)

    def _list(self, data: dict[str, Any]) -> list:
        value = self._begin(data, [])
        value.extend(self._items(data["of"]))
        return value

    def _tuple(self, data: dict[str, Any]) -> tuple:
        return tuple(self._items(data["of"]))

    def _size(self, data: dict[str, Any]) -> th.Size:
        return th.Size(self._shape(data["of"]))

    def _namedtuple(self, data: dict[str, Any]) -> Any:
        kind = self._class(data["class"])
        if kind.__bases__ != (tuple,) or not hasattr(kind, "_fields") or len(data["of"]) != len(kind._fields):
            raise Misfit(f"{data['class']} is no namedtuple of {len(data['of'])} parts")
        return tuple.__new__(kind, self._items(data["of"]))

    def _dict(self, data: dict[str, Any]) -> dict:
        value = self._begin(data, {})
        for key, each in self._a(dict, data["of"]).items():
            value[key] = each if type(each) in ATOMS else self.child(each, key)
        return value

    def _mapping(self, data: dict[str, Any]) -> Any:
        if data["is"] == "defaults":
            factory = None if data["factory"] is None else self._class(data["factory"])
            value: Any = collections.defaultdict(factory)
        else:
            value = {"map": dict, "ordered": collections.OrderedDict}[data["is"]]()
        self._begin(data, value)
        for key, each in self._pairs(data["of"]):
            value[key] = each
        return value

    def _set(self, data: dict[str, Any]) -> set:
        value = self._begin(data, set())
        value.update(self._items(data["of"]))
        return value

    def _frozenset(self, data: dict[str, Any]) -> frozenset:
        return frozenset(self._items(data["of"]))

    def _deque(self, data: dict[str, Any]) -> collections.deque:
        longest = None if data["longest"] is None else self._int(data["longest"])
        value = self._begin(data, collections.deque(maxlen=longest))
        value.extend(self._items(data["of"]))
        return value

    def _range(self, data: dict[str, Any]) -> Any:
        return {"range": range, "slice": slice}[data["is"]](*self._tuple(data))

    def _ref(self, data: dict[str, Any]) -> Any:
        return self._known(data.get("to"))

    def _known_here(self, data: dict[str, Any]) -> Any:
        if self._a(str, data["name"]) not in self._objects_here:
            raise Misfit(f"there is no {data['name'][:100]!r} here")
        return self._objects_here[data["name"]]

    def _float(self, data: dict[str, Any]) -> float:
        return struct.unpack(">d", bytes.fromhex(data["bits"]))[0]

    def _hex(self, data: dict[str, Any]) -> int:
        return int(self._a(str, data["hex"]), 16)

    def _complex(self, data: dict[str, Any]) -> complex:
        return complex(*struct.unpack(">dd", bytes.fromhex(data["bits"])))

    def _bytes(self, data: dict[str, Any]) -> Any:
        return {"bytes": bytes, "bytearray": bytearray}[data["is"]](self._take(data["size"]))

    def _ellipsis(self, data: dict[str, Any]) -> Any:
        return ...

    def _path(self, data: dict[str, Any]) -> Any:
        return kinds.PATHS[data["is"]](self._a(str, data["value"]))

    def _enum(self, data: dict[str, Any]) -> enum.Enum:
        kind = self._class(data["class"])
        if not issubclass(kind, enum.Enum) or data["name"] not in kind.__members__:
            raise Misfit(f"{data['class']} has no member {data['name']!r}")
        return kind.__members__[data["name"]]

    def _dtype(self, data: dict[str, Any]) -> np.dtype:
        return np.dtype(object) if data["of"] == "O" else kinds.plain_dtype(data["of"])

    def _array(self, data: dict[str, Any]) -> np.ndarray:
        dtype, shape, order = kinds.plain_dtype(data["dtype"]), self._shape(data["shape"]), data["order"]
        if dtype.itemsize == 0 or order not in ("C", "F"):
            raise Misfit(f"its dtype {dtype} or order {str(order)[:20]!r} cannot be")
        size = math.prod(shape)
        content = self._take(size * dtype.itemsize)
        flat = np.frombuffer(content, dtype) if size else np.empty(0, dtype)
        return flat.reshape(shape, order=order).copy(order)

    def _objects(self, data: dict[str, Any]) -> np.ndarray:
        shape = self._shape(data["shape"])
        if math.prod(shape) != len(self._a(list, data["of"])):
            raise Misfit(f"its shape {shape} does not fit its {len(data['of'])} entries")
        value = self._begin(data, np.empty(shape, dtype=object))
        flat = value.reshape(-1)
        for index, each in enumerate(self._items(data["of"])):
            flat[index] = each
        return value

    def _scalar(self, data: dict[str, Any]) -> Any:
        dtype = kinds.plain_dtype(data["dtype"])
        if dtype.itemsize == 0:
            # Of an empty text
            return dtype.type()
        return np.frombuffer(bytes(self._take(dtype.itemsize)), dtype)[0]

    def _tensor(self, data: dict[str, Any]) -> th.Tensor:
        dtype, shape = kinds.DTYPES[data["dtype"]], self._shape(data["shape"])
        size = math.prod(shape)
        content = bytearray(self._take(size * dtype.itemsize))
        value = (th.frombuffer(content, dtype=dtype) if size else th.empty(0, dtype=dtype)).reshape(shape)
        grad = self._a(bool, data["grad"])
        return th.nn.Parameter(value, grad) if self._a(bool, data["parameter"]) else value.requires_grad_(grad)

    def _torch_dtype(self, data: dict[str, Any]) -> th.dtype:
        return kinds.DTYPES[data["name"]]

    def _device(self, data: dict[str, Any]) -> th.device:
        return th.device(self._a(str, data["name"]))

    def _generator(self, data: dict[str, Any]) -> np.random.Generator:
        return np.random.Generator(self._of(np.random.BitGenerator, data["bits"], "bit_generator"))

    def _of(self, kind: type, data: Any, key: str) -> Any:
        value = self.child(data, key, ".{}")
        if not isinstance(value, kind):
            raise Misfit(f"its {key} is {str(value)[:50]!r}, not a {kind.__name__}")
        return value

    def _bit_generator(self, data: dict[str, Any]) -> np.random.BitGenerator:
        kind = kinds.BIT_GENERATORS[data["name"]]
        seed = 0 if data["seed"] is None else self._of(np.random.SeedSequence, data["seed"], "seed_seq")
        value = kind(seed)
        value.state = self._state(data["state"])
        return value

    def _state(self, data: Any) -> dict[str, Any]:
        state = self._of(dict, data, "state")
        if state.get("bit_generator") in _POSITIONS:
            part, name, last = _POSITIONS[state["bit_generator"]]
            if not self._int((state if part is None else state[part])[name]) <= last:
                raise Misfit(f"{name} is beyond the generator's state")
        return state

    def _seed_sequence(self, data: dict[str, Any]) -> np.random.SeedSequence:
        state = self._of(dict, data["state"], "state")
        if not 4 <= self._int(state["pool_size"]) <= 64:
            raise Misfit("its pool is of an unusual size")
        return np.random.SeedSequence(**state)

    def _random_state(self, data: dict[str, Any]) -> np.random.RandomState:
        value = np.random.RandomState(0)
        state = self._state(data["state"])
        if state["bit_generator"] != "MT19937":
            value = np.random.RandomState(kinds.BIT_GENERATORS[state["bit_generator"]](0))
        value.set_state(state)
        return value

    def _random(self, data: dict[str, Any]) -> random.Random:
        value = random.Random(0)
        value.setstate(self._of(tuple, data["state"], "state"))
        return value

    def _torch_generator(self, data: dict[str, Any]) -> th.Generator:
        value = th.Generator()
        value.set_state(self._of(th.Tensor, data["state"], "state"))
        return value

    # -- what has a name -----------------------------------------------------------------------------------------------

    def _named_class(self, data: dict[str, Any]) -> type:
        return self._class(data["name"])

    def _function(self, data: dict[str, Any]) -> Any:
        return kinds.find(data["name"], self._allowed, self._accepts, types.FunctionType)

    def _method(self, data: dict[str, Any]) -> types.MethodType:
        owner = self.child(data["self"], "self", ".{}")
        function = kinds.find_method(type(owner), self._a(str, data["name"]), self._allowed, self._accepts)
        return types.MethodType(function, owner)

    def _object(self, data: dict[str, Any]) -> Any:
        kind = self._class(data["class"])
        kinds.check_object(kind)
        value = self._begin(data, object.__new__(kind))
        slots = kinds.slots_of(kind)
        attributes = kinds.left_out(kind)
        if attributes:
            value.__dict__.update(attributes)
        for name, each in self._a(dict, data["state"]).items():
            kinds.check_attribute(kind, name)
            part = each if type(each) in ATOMS else self.child(each, name, ".{}")
            # Not setattr(), which a class may answer as it likes
            if name in slots:
                slots[name].__set__(value, part)
            else:
                value.__dict__[name] = part
        return value


_Reader = Callable[[_Decoder, dict[str, Any]], Any]
# The keys of each kind besides "is" and "id", and what reads it
_READERS: dict[str, tuple[set[str], _Reader]] = {
    "ref": (set(), _Decoder._ref),
    "known": ({"name"}, _Decoder._known_here),
    "list": ({"of"}, _Decoder._list),
    "tuple": ({"of"}, _Decoder._tuple),
    "size": ({"of"}, _Decoder._size),
    "namedtuple": ({"class", "of"}, _Decoder._namedtuple),
    "dict": ({"of"}, _Decoder._dict),
    **{kind: ({"of"}, _Decoder._mapping) for kind in ("map", "ordered")},
    "defaults": ({"factory", "of"}, _Decoder._mapping),
    "set": ({"of"}, _Decoder._set),
    "frozenset": ({"of"}, _Decoder._frozenset),
    "deque": ({"of", "longest"}, _Decoder._deque),
    **{kind: ({"of"}, _Decoder._range) for kind in ("range", "slice")},
    "float": ({"bits"}, _Decoder._float),
    "int": ({"hex"}, _Decoder._hex),
    "complex": ({"bits"}, _Decoder._complex),
    **{kind: ({"size"}, _Decoder._bytes) for kind in ("bytes", "bytearray")},
    "ellipsis": (set(), _Decoder._ellipsis),
    **{kind: ({"value"}, _Decoder._path) for kind in kinds.PATHS},
    "enum": ({"class", "name"}, _Decoder._enum),
    "dtype": ({"of"}, _Decoder._dtype),
    "array": ({"dtype", "shape", "order"}, _Decoder._array),
    "objects": ({"shape", "of"}, _Decoder._objects),
    "scalar": ({"dtype"}, _Decoder._scalar),
    "tensor": ({"dtype", "shape", "grad", "parameter"}, _Decoder._tensor),
    "torch_dtype": ({"name"}, _Decoder._torch_dtype),
    "device": ({"name"}, _Decoder._device),
    "generator": ({"bits"}, _Decoder._generator),
    "bit_generator": ({"name", "seed", "state"}, _Decoder._bit_generator),
    "seed_sequence": ({"state"}, _Decoder._seed_sequence),
    "random_state": ({"state"}, _Decoder._random_state),
    "random": ({"state"}, _Decoder._random),
    "torch_generator": ({"state"}, _Decoder._torch_generator),
    "class": ({"name"}, _Decoder._named_class),
    "function": ({"name"}, _Decoder._function),
    "method": ({"name", "self"}, _Decoder._method),
    "object": ({"class", "state"}, _Decoder._object),
}
# Kinds that may be met among their own parts
_LATE = {"ref", "tuple", "namedtuple", "frozenset", "method"}
