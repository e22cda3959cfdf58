"""What writer and reader of plain data have in common: names of classes, and how objects are taken apart."""

import collections
import pathlib
import re
import sys
import types
from collections.abc import Callable
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
import torch as th

# Whether classes and functions of a module may be named
Allowed = Callable[[str], bool]
# Whether a class or function that has been found may be used
Accepts = Callable[[Any], bool]

#: Nested deeper than this nothing is written or read, far from Python's own limit
DEEPEST = 120
#: More than this many objects, besides numbers and texts, are not read
MOST_NODES = 20_000_000
#: Kinds of values that are the same in JSON
ATOMS = frozenset({type(None), bool, int, str, float})
#: Python's integers beyond this have digits that take long to read, and are written in hexadecimal
MAX_BITS = 8000


class NotPlainError(TypeError):
    """What is to be written as plain data cannot be; the message says where it is, and what to do."""


class PlainData(NamedTuple):
    """
    An object as plain data.

    :param tree: Its structure, which JSON can hold
    :param blob: All its arrays, one after the other
    """

    tree: Any
    blob: bytes


class Misfit(Exception):
    """
    What is wrong with a part, and in which place: the keys that lead to it are added on its way up.

    :param reason: What is wrong
    """

    def __init__(self, reason: str):
        super().__init__(reason)
        self.reason = reason
        self.keys: list[str] = []

    def where(self, path: str) -> str:
        """
        Return the path of the part.

        :param path: Of the whole
        :return: For example ``policy_kwargs['net_arch'][0].size``
        """
        return (path + "".join(reversed(self.keys))).lstrip(".") or "the value itself"


# Types of data that may be named although their modules may not
_BUILTIN = (bool, int, float, complex, str, bytes, bytearray, list, tuple, dict, set, frozenset, object, type(None))
_COLLECTIONS = (collections.OrderedDict, collections.defaultdict, collections.deque)
_SCALARS = {kind for kind in np.sctypeDict.values() if kind is not np.object_}
DATA_TYPES: dict[str, type] = {
    f"{kind.__module__}:{kind.__qualname__}": kind for kind in (*_BUILTIN, *_COLLECTIONS, *_SCALARS, np.ndarray, th.Tensor)
}
PATHS: dict[str, type[pathlib.PurePath]] = {
    "path": pathlib.Path,
    "posix": pathlib.PurePosixPath,
    "windows": pathlib.PureWindowsPath,
}
BIT_GENERATORS: dict[str, type[np.random.BitGenerator]] = {
    kind.__name__: kind
    for kind in (np.random.PCG64, np.random.PCG64DXSM, np.random.MT19937, np.random.Philox, np.random.SFC64)
}
DTYPES: dict[str, th.dtype] = {
    name: getattr(th, name)
    for name in "float16 bfloat16 float32 float64 uint8 int8 int16 int32 int64 bool complex64 complex128".split()
}

# Classes whose own ways of being pickled leave nothing out but what is listed: their attributes say all
_VEC_NORMALIZE = "stable_baselines3.common.vec_env.vec_normalize:VecNormalize"
_HER = "stable_baselines3.her.her_replay_buffer:HerReplayBuffer"
_HARMLESS = re.compile(
    rf"gymnasium\.spaces\.\w+:\w+|gymnasium\.utils\.ezpickle:EzPickle|{_VEC_NORMALIZE}|{_HER}"
    r"|stable_baselines3\.common\.vec_env\.base_vec_env:VecEnvWrapper|sb3_belief\.team\.normalization:AgentNormalize"
)
# Attributes that are not written, and what they become
_LEFT_OUT: dict[str, Callable[[], dict[str, Any]]] = {
    _VEC_NORMALIZE: lambda: {"venv": None, "class_attributes": {}},
    _HER: lambda: {"env": None},
}
_HOOKS = ("__reduce_ex__", "__reduce__", "__getstate__", "__setstate__", "__getnewargs__", "__getnewargs_ex__")
_METHODS = (types.FunctionType, classmethod, staticmethod)
_HEAP_TYPE = 1 << 9


def name_of(found: Any) -> str:
    """
    Return the name of a class or function.

    :param found: The class or function
    :return: ``"module:qualname"``
    """
    return f"{found.__module__}:{found.__qualname__}"


def find(name: Any, allowed: Allowed, accepts: Accepts, kind: type = type) -> Any:
    """
    Return the class or function of a name, importing its module only if that is allowed.

    :param name: ``"module:qualname"``
    :param allowed: Whether classes and functions of a module may be named
    :param accepts: Whether a class or function that has been found may be used
    :param kind: ``type`` or ``types.FunctionType``
    :return: The class or function
    :raises Misfit: If it is not allowed, or is not there
    """
    if not isinstance(name, str):
        raise Misfit(f"{name!r} is no name of a class")
    if kind is type and name in DATA_TYPES:
        return DATA_TYPES[name]
    module, _, qualname = name.partition(":")
    if not re.fullmatch(r"\w+(\.\w+)*:\w+(\.\w+)*", name, re.ASCII) or "__" in qualname:
        raise Misfit(f"{name[:200]!r} is no name of a class or function that can be looked up")
    # A module of this name is a program, which is run by being imported, unless it is what runs already
    runs = module.rpartition(".")[2] == "__main__" and module not in sys.modules
    if runs or not (allowed(module) or module.startswith("gymnasium.spaces.")):
        raise Misfit(f"{name[:200]!r} is of a package that is not allowed")
    try:
        found: Any = sys.modules.get(module) or import_module(module)
        # Not getattr(), since modules and classes may answer it by running something
        for part in qualname.split("."):
            found = vars(found)[part]
    # Importing raises whatever a module raises
    except Exception as error:
        raise Misfit(f"{name!r} cannot be imported here ({type(error).__name__}: {error})") from None
    # What a module has imported from elsewhere is not its own
    if not isinstance(found, kind) or name_of(found) != name:
        raise Misfit(f"{name!r} is no {'class' if kind is type else 'function'} defined there")
    if not accepts(found):
        raise Misfit(f"{name!r} is not a class or function that a file may name here")
    return found


def find_method(kind: type, name: str, allowed: Allowed, accepts: Accepts, wanted: Any = None) -> types.FunctionType:
    """
    Return a method of a class.

    :param kind: The class
    :param name: Name of the method
    :param allowed: See ``find``
    :param accepts: See ``find``
    :param wanted: The function that it must be, or None
    :return: The function
    :raises Misfit: If the class has no such method, or it is not allowed
    """
    found = next((vars(owner)[name] for owner in kind.__mro__ if name in vars(owner)), None)
    if not isinstance(found, types.FunctionType) or name.startswith("__") or (wanted is not None and found is not wanted):
        raise Misfit(f"{name_of(kind)} has no method {name!r} that could be found by its name")
    if not (allowed(found.__module__) and accepts(found)):
        raise Misfit(f"the method {name_of(found)!r} is not one that a file may name here")
    return found


def check_object(kind: type) -> None:
    """
    Check that an object is described by its attributes.

    :param kind: Class of the object
    :raises Misfit: If it is not
    """
    if issubclass(kind, th.nn.Module):
        raise Misfit("a torch module is not plain data, its state_dict() is")
    for owner in kind.__mro__:
        if owner is object:
            continue
        if not owner.__flags__ & _HEAP_TYPE:
            raise Misfit(f"a {name_of(kind)} is built in, or derived from {name_of(owner)}, which is")
        own = [hook for hook in _HOOKS if hook in vars(owner)]
        if own and not _HARMLESS.fullmatch(name_of(owner)):
            raise Misfit(f"{name_of(owner)} has its own {own[0]}(), which plain data does without")


def check_attribute(kind: type, name: str) -> None:
    """
    Check that an attribute does not take the place of a method, which would then be called instead of it.

    :param kind: Class of the object
    :param name: Of the attribute
    :raises Misfit: If it does
    """
    if any(isinstance(vars(owner).get(name), _METHODS) for owner in kind.__mro__):
        raise Misfit(f"the attribute {name!r} replaces a method of {name_of(kind)}")


def left_out(kind: type) -> dict[str, Any]:
    """
    Return the attributes of an object that are not written.

    :param kind: Class of the object
    :return: What they become
    """
    found: dict[str, Any] = {}
    for owner in kind.__mro__:
        if owner.__module__.startswith("stable_baselines3."):
            found.update(_LEFT_OUT.get(name_of(owner), dict)())
    return found


def slots_of(kind: type) -> dict[str, types.MemberDescriptorType]:
    """
    Return the slots of a class.

    :param kind: The class
    :return: The slots' descriptors by name, of base classes too
    """
    found: dict[str, types.MemberDescriptorType] = {}
    for owner in reversed(kind.__mro__):
        found.update((name, each) for name, each in vars(owner).items() if isinstance(each, types.MemberDescriptorType))
    return found


def plain_dtype(descr: Any) -> np.dtype:
    """
    Return the dtype of a description.

    :param descr: As numpy's own files have it, with lists for the tuples
    :return: The dtype
    :raises Misfit: If it holds objects
    """
    dtype = np.lib.format.descr_to_dtype(_tuples(descr))
    if dtype.hasobject:
        raise Misfit("its dtype holds objects")
    return dtype


def _tuples(descr: Any) -> Any:
    """Return a dtype's description with the tuples that JSON has made lists: its fields, and their shapes."""
    return [tuple(map(_field, each)) for each in descr] if isinstance(descr, list) else descr


def _field(part: Any) -> Any:
    if not isinstance(part, list):
        return part
    # The shape of a field, its name and title, or fields of its own
    return tuple(part) if all(isinstance(each, (int, str)) for each in part) else _tuples(part)
