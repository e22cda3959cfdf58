"""
The state of one copy of a user's environment: all that decides how it goes on, as plain data.

An environment that has ``get_state()`` and ``set_state()`` says itself what that is. Of any other one it is taken to be the
attributes of the environment and of all objects within it. What cannot change there, such as functions, is not saved: the
environment into which the state is put has been made by the same arguments, so it has the same.
"""

import functools
import logging
import types
from collections.abc import Iterator
from typing import Any

from gymnasium import spaces

from sb3_belief.common.plain_data import PlainData, decode, encode
from sb3_belief.common.plain_data.kinds import ATOMS

# What is the same in every environment that is made by the same arguments
_CONSTANTS = (types.FunctionType, types.BuiltinFunctionType, functools.partial, types.ModuleType, type, logging.Logger)
# Packages that draw: an environment shows itself, and goes on the same without it
_DRAWING = ("pygame", "pyglet", "matplotlib")
# Objects beyond this depth below the environment are not looked for
_DEEPEST = 100


def _parts(value: Any) -> Iterator[tuple[str, Any]]:
    """Iterate over what an object holds, by the text that leads to it."""
    # Not numbers and texts, which hold nothing, and of which there may be a million in a list
    if isinstance(value, dict):
        yield from ((f"[{key!r}]", part) for key, part in value.items() if type(part) not in ATOMS)
    elif isinstance(value, (list, tuple)):
        yield from ((f"[{i}]", part) for i, part in enumerate(value) if type(part) not in ATOMS)
    elif isinstance(value, types.MethodType):
        yield ".__self__", value.__self__
    elif hasattr(value, "__dict__") and not isinstance(value, (*_CONSTANTS, spaces.Space)):
        yield from ((f".{name}", part) for name, part in vars(value).items() if type(part) not in ATOMS)


def _objects_of(root: Any) -> dict[str, Any]:
    """Return all objects with attributes and all constants that an environment holds, by path, itself included."""
    found: dict[str, Any] = {}
    seen: set[int] = set()
    waiting = [("env", root, 0)]
    while waiting:
        path, value, depth = waiting.pop()
        if id(value) in seen or depth > _DEEPEST:
            continue
        seen.add(id(value))
        if _is_constant(value):
            found[path] = value
            continue
        if hasattr(value, "__dict__") and not isinstance(value, types.MethodType):
            found[path] = value
        waiting.extend((path + key, part, depth + 1) for key, part in _parts(value))
    return found


def _is_constant(value: Any) -> bool:
    if isinstance(value, spaces.Space):
        return True
    package = type(value).__module__.partition(".")[0]
    return isinstance(value, _CONSTANTS) or package in _DRAWING or package == "_thread"


class CopyState:
    """
    Saves and restores one environment. It has to be made when the environment has been reset.

    :param env: A PettingZoo ``ParallelEnv``, with or without wrappers
    """

    def __init__(self, env: Any):
        self._own = getattr(env, "unwrapped", env)
        self._says = all(callable(getattr(self._own, name, None)) for name in ("get_state", "set_state"))
        self._objects = _objects_of(env)
        modules = {type(each).__module__ for each in self._objects.values()}
        self._packages = {"numpy", "gymnasium"} | {module.partition(".")[0] for module in modules}
        if self._says:
            # The environment answers for all that is in it, and wrappers around it for themselves
            inside = {id(each) for path, each in _objects_of(self._own).items() if path != "env"}
            self._objects = {path: each for path, each in self._objects.items() if id(each) not in inside}
        self._names = {id(each): path for path, each in self._objects.items()}

    def get(self) -> PlainData:
        """
        Return the present state.

        :return: The state
        :raises NotPlainError: If the environment holds what is not plain data
        """
        return encode(
            {
                "objects": {path: self._state_of(each) for path, each in self._objects.items()},
                "own": self._own.get_state() if self._says else None,
            },
            lambda module: True,
            "environment",
            known=self._names,
        )

    def _state_of(self, each: Any) -> dict[str, Any] | None:
        if isinstance(each, spaces.Space):
            # An environment may sample from its spaces
            return {"_np_random": each._np_random}
        if _is_constant(each) or (self._says and each is self._own):
            return None
        return dict(vars(each))

    def set(self, state: PlainData) -> None:
        """
        Restore a state.

        :param state: As :meth:`get` returned it for an environment that was made by the same arguments
        :raises ValueError: If it does not fit this environment
        """
        allowed = self._packages.__contains__
        saved = decode(state, lambda module: allowed(module.partition(".")[0]), "environment", known=self._objects)
        if not (isinstance(saved, dict) and isinstance(saved.get("objects"), dict)):
            raise ValueError("The saved state is not that of an environment.")
        if saved["objects"].keys() != self._objects.keys():
            other = sorted(saved["objects"].keys() ^ self._objects.keys())
            raise ValueError(
                f"The saved state is of an environment with other parts, {other[:3]}: make it with the same arguments, and of"
                " the same version."
            )
        for path, attributes in saved["objects"].items():
            if isinstance(attributes, dict):
                if not isinstance(self._objects[path], spaces.Space):
                    vars(self._objects[path]).clear()
                vars(self._objects[path]).update(attributes)
        if self._says:
            self._own.set_state(saved["own"])
