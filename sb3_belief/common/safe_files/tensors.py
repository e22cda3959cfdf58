"""
Files of torch, looked at before torch reads them.

``torch.load(weights_only=True)`` runs nothing that a file brings along. It does believe what the file says of the sizes of
arrays, though, and can be made to call a few functions of its own that such files as ours do not need.
"""

import collections
import io
import math
import pickletools
import re
import zipfile
from collections.abc import Callable
from typing import Any, NamedTuple

import torch as th

# A tensor may be larger than what is stored of it (a number that was expanded), but not by much
_EXPANDED = 100_000
_STORAGES = {
    "Double": 8, "Float": 4, "Half": 2, "BFloat16": 2, "Long": 8, "Int": 4, "Short": 2, "Char": 1, "Byte": 1, "Bool": 1,
    "ComplexFloat": 8, "ComplexDouble": 16,
}  # fmt: skip
_DTYPES = {str(value).removeprefix("torch.") for value in vars(th).values() if isinstance(value, th.dtype)}
_FUNCTIONS = {
    "torch._utils _rebuild_tensor_v2",
    "torch._utils _rebuild_parameter",
    "collections OrderedDict",
    "torch Size",
    "torch device",
}
_MARK = object()


class _Wrong(Exception):
    """Raised for what is wrong with a file."""


class _Global(NamedTuple):
    name: str


class _Storage(NamedTuple):
    key: str
    n_entries: int


class _Tensor(NamedTuple):
    storage: _Storage


def check_tensors(content: bytes, where: str) -> None:
    """
    Check that a file holds tensors and plain containers, each tensor no larger than the bytes that are there for it.

    :param content: What ``torch.save`` has written
    :param where: What the file is called in messages
    :raises ValueError: If it holds anything else
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            _Reader(*_members(archive, len(content))).run()
    except _Wrong as error:
        raise ValueError(f"{where}: {error}. The file is damaged, or no tensors alone.") from None
    # Wrong numbers and wrong orders of instructions raise whatever they lead to
    except Exception as error:
        raise ValueError(f"{where}: it holds no tensors ({type(error).__name__}: {str(error)[:200]}).") from None


def _members(archive: zipfile.ZipFile, size: int) -> tuple[bytes, dict[str, int]]:
    """Return the instructions that build the contents, and the sizes of the storages by key."""
    infos = archive.infolist()
    names = [each.filename for each in infos]
    folder = names[0].partition("/")[0]
    known = r"data\.pkl|byteorder|version|\.data/serialization_id|\.format_version|\.storage_alignment|data/\d+"
    if any(not re.fullmatch(rf"{re.escape(folder)}/({known})", name, re.ASCII) for name in names) or len({*names}) != len(
        names
    ):
        raise _Wrong(f"it has other members than torch writes: {names[:5]}")
    if any(each.compress_type or each.compress_size != each.file_size or each.flag_bits & 1 for each in infos):
        raise _Wrong("it has members that are compressed or encrypted")
    if sum(each.file_size for each in infos) > size:
        raise _Wrong("its members are larger than itself")
    sizes = {name.rpartition("/")[2]: each.file_size for name, each in zip(names, infos, strict=True) if "/data/" in name}
    return archive.read(f"{folder}/data.pkl"), sizes


class _Reader:
    """
    Follows the instructions of a pickle as far as files of tensors have them, and builds nothing but stand-ins.

    :param program: The pickle
    :param sizes: Sizes of the storages in bytes, by key
    """

    def __init__(self, program: bytes, sizes: dict[str, int]) -> None:
        self._program, self._sizes = program, sizes
        self._stack: list[Any] = []
        self._memo: dict[int, Any] = {}

    def run(self) -> None:
        for op, arg, _ in pickletools.genops(self._program):
            if op.name not in _OPS:
                raise _Wrong(f"it has the instruction {op.name}, which tensors do not need")
            _OPS[op.name](self, arg)
        if len(self._stack) != 1:
            raise _Wrong("its instructions do not end with one value")

    def push(self, value: Any) -> None:
        self._stack.append(value)

    def above_mark(self) -> list[Any]:
        place = next(index for index in range(len(self._stack) - 1, -1, -1) if self._stack[index] is _MARK)
        items = self._stack[place + 1 :]
        del self._stack[place:]
        return items

    def tuple_of(self, count: int) -> None:
        items = tuple(self._stack[len(self._stack) - count :])
        del self._stack[len(self._stack) - count :]
        self.push(items)

    def put(self, place: int) -> None:
        self._memo[place] = self._stack[-1]

    def named(self, name: str) -> None:
        module, _, kind = name.partition(" ")
        of_torch = module == "torch" and (kind in _DTYPES or kind.removesuffix("Storage") in _STORAGES)
        if name not in _FUNCTIONS and not of_torch:
            raise _Wrong(f"it names {name.replace(' ', '.')[:100]!r}, which tensors do not need")
        self.push(_Global(name))

    def storage(self) -> None:
        kind, storage_type, key, location, n_entries = self._stack.pop()
        size = _STORAGES[storage_type.name.removeprefix("torch ").removesuffix("Storage")]
        if kind != "storage" or not isinstance(location, str) or type(n_entries) is not int:
            raise _Wrong("it refers to what is no storage")
        if n_entries < 0 or self._sizes[key] != n_entries * size:
            raise _Wrong(f"its storage {key!r} has {self._sizes[key]} bytes, not the {n_entries * size} of its entries")
        self.push(_Storage(key, n_entries))

    def call(self) -> None:
        function, arguments = self._stack[-2:]
        del self._stack[-2:]
        name = function.name.rpartition(" ")[2]
        if name == "_rebuild_tensor_v2":
            self.push(_tensor(*arguments))
        elif name == "_rebuild_parameter":
            self.push(arguments[0])
        elif name == "OrderedDict" and arguments in ((), ([],)):
            self.push(collections.OrderedDict())
        elif name == "Size" and all(type(each) is int for each in arguments[0]):
            self.push(arguments[0])
        elif name == "device" and all(isinstance(each, (str, int)) for each in arguments):
            self.push(arguments)
        else:
            raise _Wrong(f"it calls {function.name!r}")

    def build(self) -> None:
        # state_dict() notes the versions of modules in an attribute of its dict
        state, target = self._stack.pop(), self._stack[-1]
        if not isinstance(target, collections.OrderedDict) or not isinstance(state, dict) or state.keys() != {"_metadata"}:
            raise _Wrong("it gives a value attributes")

    def append(self, items: list[Any]) -> None:
        target = self._stack[-1]
        if not isinstance(target, list):
            raise _Wrong("it appends to what is no list")
        target.extend(items)

    def update(self, items: list[Any]) -> None:
        target = self._stack[-1]
        if not isinstance(target, dict):
            raise _Wrong("it sets items of what is no dict")
        target.update(zip(items[::2], items[1::2], strict=True))

    def top(self, count: int) -> list[Any]:
        items = self._stack[len(self._stack) - count :]
        del self._stack[len(self._stack) - count :]
        return items


def _tensor(storage: _Storage, offset: int, shape: tuple[int, ...], strides: tuple[int, ...], *_: Any) -> _Tensor:
    if not isinstance(storage, _Storage) or len(shape) != len(strides) or len(shape) > 64:
        raise _Wrong("it has a tensor without a storage or shape")
    if any(type(each) is not int or each < 0 for each in (offset, *shape, *strides)):
        raise _Wrong("it has a tensor of a negative shape")
    n_entries = math.prod(shape)
    last = offset + sum((size - 1) * stride for size, stride in zip(shape, strides, strict=True))
    if n_entries and (last >= storage.n_entries or n_entries > max(storage.n_entries, _EXPANDED)):
        raise _Wrong(f"it has a tensor of shape {shape} in a storage of {storage.n_entries} entries")
    return _Tensor(storage)


_OPS: dict[str, Callable[[_Reader, Any], None]] = {
    **dict.fromkeys(("PROTO", "STOP", "FRAME"), lambda reader, arg: None),
    **dict.fromkeys(
        ("BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT", "BINUNICODE", "SHORT_BINUNICODE"),
        lambda reader, arg: reader.push(arg),
    ),
    "NONE": lambda reader, arg: reader.push(None),
    "NEWTRUE": lambda reader, arg: reader.push(True),
    "NEWFALSE": lambda reader, arg: reader.push(False),
    "EMPTY_DICT": lambda reader, arg: reader.push({}),
    "EMPTY_LIST": lambda reader, arg: reader.push([]),
    "EMPTY_TUPLE": lambda reader, arg: reader.push(()),
    "MARK": lambda reader, arg: reader.push(_MARK),
    "TUPLE": lambda reader, arg: reader.push(tuple(reader.above_mark())),
    "TUPLE1": lambda reader, arg: reader.tuple_of(1),
    "TUPLE2": lambda reader, arg: reader.tuple_of(2),
    "TUPLE3": lambda reader, arg: reader.tuple_of(3),
    "APPEND": lambda reader, arg: reader.append(reader.top(1)),
    "APPENDS": lambda reader, arg: reader.append(reader.above_mark()),
    "SETITEM": lambda reader, arg: reader.update(reader.top(2)),
    "SETITEMS": lambda reader, arg: reader.update(reader.above_mark()),
    **dict.fromkeys(("BINPUT", "LONG_BINPUT"), lambda reader, arg: reader.put(arg)),
    **dict.fromkeys(("BINGET", "LONG_BINGET"), lambda reader, arg: reader.push(reader._memo[arg])),
    "GLOBAL": lambda reader, arg: reader.named(arg),
    "BINPERSID": lambda reader, arg: reader.storage(),
    "REDUCE": lambda reader, arg: reader.call(),
    "BUILD": lambda reader, arg: reader.build(),
}
