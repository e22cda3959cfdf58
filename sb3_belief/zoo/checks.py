"""
Checks of YAML values against the arguments that they are for.

The allowed keys and types are read from the signatures of algorithms, policies and environments, so no list of settings has to
be kept up to date.
"""

import inspect
import re
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import LinearSchedule

from sb3_belief.common.safe_files.trust import is_allowed
from sb3_belief.zoo.errors import ConfigError, short, unknown_setting
from sb3_belief.zoo.names import resolve

# Arguments by which callbacks and wrappers are told where to write
_PATH = re.compile(r"(path|dir|directory|folder|file|file_?name)$")


@dataclass(frozen=True)
class Location:
    """
    Source of a setting, which error messages begin with.

    :param text: File and section, or flag, followed by the keys that lead to the setting
    :param extra_packages: See ``names.resolve``
    :param run_folder: Folder of the run whose file it is; None if the user gave it, or trusts the file
    """

    text: str
    extra_packages: tuple[str, ...] = ()
    run_folder: Path | None = None

    def key(self, name: str) -> "Location":
        """
        Return the location of a nested setting.

        :param name: Its key
        :return: The location
        """
        return replace(self, text=f"{self.text}: {name}")

    @property
    def parent(self) -> str:
        """Text of the location that this setting lies in."""
        return self.text.rpartition(": ")[0]


def check_run_file(function: Callable[..., Any], arguments: Mapping[str, Any], location: Location) -> None:
    """
    Check what the configuration of another's run lets a callback or a wrapper do.

    :param function: The callback or wrapper
    :param arguments: Its arguments
    :param location: Where they are given
    :raises ConfigError: If it could write outside of the run's folder, or is nothing that wraps a team's environment
    """
    if location.run_folder is None or is_allowed(function.__module__, location.extra_packages):
        return
    is_callback = inspect.isclass(function) and issubclass(function, BaseCallback)
    if not is_callback and not is_allowed(function.__module__, ("sb3_belief", "supersuit", "pettingzoo")):
        raise ConfigError(
            f"{location.text}: {function.__module__}.{function.__name__} is no wrapper of a team's environment, and the file"
            " of a run may name no other function. If you trust it: --trust."
        )
    check_paths(arguments, location)


def check_paths(arguments: Mapping[str, Any], location: Location) -> None:
    """
    Check that arguments in the configuration of another's run name no place outside of the run's folder to write to.

    :param arguments: The arguments
    :param location: Where they are given
    :raises ConfigError: If one does
    """
    if location.run_folder is None:
        return
    for name, value in arguments.items():
        if not isinstance(value, str) or not _PATH.search(name):
            continue
        # Joined to a folder an absolute path remains what it is
        if not (Path.cwd() / value).resolve().is_relative_to(location.run_folder.resolve()):
            raise ConfigError(
                f"{location.text}: {name}: {short(value)} lies outside of the run's folder {str(location.run_folder)!r}, where"
                " the file of a run may not write. If you trust it: --trust, or give your own file with --conf-file."
            )


class _Mismatch(Exception):
    """Raised if a value does not have a type. If the type is part of a union, the value may still have another one."""


def accepted_arguments(function: Callable[..., Any]) -> tuple[dict[str, Any], bool]:
    """
    Return the arguments of a function or of a class's constructor.

    A constructor with ``**kwargs`` is assumed to pass them to its base class, so the arguments of the base class count too.
    Where no base class takes them, the constructor reads them itself, and no signature names them.

    :param function: Class or function
    :return: {argument: annotation} in order, and whether there may be further arguments that no signature names
    """
    constructors = [function]
    if inspect.isclass(function):
        constructors = [vars(cls)["__init__"] for cls in function.__mro__ if "__init__" in vars(cls)]
    found: dict[str, Any] = {}
    for constructor in constructors:
        if constructor is object.__init__:
            return found, constructor is not constructors[0]
        hints = _hints(constructor)
        signature = inspect.signature(constructor)
        for name, parameter in signature.parameters.items():
            if parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY) and name != "self":
                found.setdefault(name, hints.get(name, Any))
        if all(parameter.kind != parameter.VAR_KEYWORD for parameter in signature.parameters.values()):
            return found, False
    return found, True


def _hints(function: Callable[..., Any]) -> dict[str, Any]:
    try:
        return typing.get_type_hints(function)
    except NameError:
        # Some annotations name what is imported under TYPE_CHECKING only (in SB3: "VecEnv") and cannot be resolved. Those of
        # settings are objects and not strings
        return {name: hint for name, hint in function.__annotations__.items() if not isinstance(hint, str)}


def check_call(
    function: Callable[..., Any],
    given: Any,
    location: Location,
    skip: int = 0,
    reserved: Mapping[str, str] | None = None,
    complete: bool = False,
    of_env: bool = False,
) -> dict[str, Any]:
    """
    Check keyword arguments against the signature of the function that takes them.

    :param function: Class or function to be called
    :param given: Keyword arguments as the YAML gives them, or None for none
    :param location: Where they are given
    :param skip: Number of leading arguments that the caller passes itself
    :param reserved: {argument: what to do instead} for arguments that must not be given here
    :param of_env: Whether the function makes an environment. Then ``**kwargs`` of its own may take any argument, since
        environments often read a configuration that no signature names; the environment itself refuses what it does not know
    :param complete: Whether these are all of the arguments, so that none without a default may be missing
    :return: The arguments as the function takes them: classes in place of dotted paths, and schedules in place of strings
        such as ``"lin_3e-4"``
    :raises ConfigError: For an unknown argument, a wrong type or a missing argument
    """
    if given is None:
        given = {}
    if not isinstance(given, dict):
        raise ConfigError(f"{location.text}: must be a mapping of arguments, not {short(given)}.")
    known, open_ended = accepted_arguments(function)
    open_ended = open_ended or (of_env and _has_var_keyword(function))
    reserved = reserved or {}
    allowed = {name: hint for name, hint in list(known.items())[skip:] if name not in reserved}
    result = {}
    for name, value in given.items():
        if name in reserved:
            raise ConfigError(
                f"{location.text}: {name!r} cannot be set here: {reserved[name]}. Allowed: {', '.join(allowed)}."
            )
        if name not in allowed and not open_ended:
            raise unknown_setting(location.text, "key", name, allowed)
        result[name] = check_value(value, allowed.get(name, Any), location.key(name))
    missing = [name for name in _required(function, skip) if name not in given] if complete else []
    if missing:
        raise ConfigError(
            f"{location.text}: needs {' and '.join(f'{name!r} ({describe(allowed.get(name, Any))})' for name in missing)},"
            f" as in {{{location.text.rpartition(': ')[2]}: {{{missing[0]}: ...}}}}."
        )
    return result


def _has_var_keyword(function: Callable[..., Any]) -> bool:
    constructor = function.__init__ if inspect.isclass(function) else function
    return any(each.kind == each.VAR_KEYWORD for each in inspect.signature(constructor).parameters.values())


def _required(function: Callable[..., Any], skip: int) -> list[str]:
    """Return the arguments without a default, after those that the caller passes itself."""
    constructor = function.__init__ if inspect.isclass(function) else function
    parameters = list(inspect.signature(constructor).parameters.values())[skip + inspect.isclass(function) :]
    named = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    return [each.name for each in parameters if each.default is each.empty and each.kind in named]


def check_value(value: Any, hint: Any, location: Location) -> Any:
    """
    Check a value against a type annotation.

    :param value: Value as the YAML gives it
    :param hint: Type annotation
    :param location: Where it is given
    :return: The value converted to the annotated type, e.g. a schedule for ``"lin_3e-4"``
    :raises ConfigError: If it does not have the type
    """
    try:
        return _convert(value, hint, location)
    except _Mismatch:
        raise ConfigError(f"{location.text}: must be {describe(hint)}, not {short(value)} ({type(value).__name__}).") from None


def _convert(value: Any, hint: Any, location: Location) -> Any:
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if hint is Any or hint is inspect.Parameter.empty or isinstance(hint, typing.TypeVar):
        return value
    if origin in (typing.Union, types.UnionType):
        return _convert_union(value, args, location)
    if origin is typing.Literal:
        return _require(value, value in args)
    if hint in _SCALARS:
        return _SCALARS[hint](value)
    if origin is type or hint is type:
        return _resolve_class(value, args[0] if args else object, location)
    container = origin or hint
    if container is Callable:
        return _schedule(value)
    if inspect.isclass(container) and issubclass(container, Mapping):
        return _convert_mapping(value, args, location)
    if inspect.isclass(container) and issubclass(container, Sequence):
        return _convert_sequence(value, container, args, location)
    # Any other type is that of an object (an action noise, an environment, a space), which plain data cannot be
    raise _Mismatch


def _convert_union(value: Any, members: tuple[Any, ...], location: Location) -> Any:
    # The first member that fits decides: for "float | Schedule" a number stays a number
    for member in members:
        try:
            return _convert(value, member, location)
        except _Mismatch:
            continue
    raise _Mismatch


def _convert_mapping(value: Any, args: tuple[Any, ...], location: Location) -> dict[Any, Any]:
    _require(value, isinstance(value, dict))
    inner = args[1] if len(args) == 2 else Any
    return {key: check_value(item, inner, location.key(str(key))) for key, item in value.items()}


def _convert_sequence(value: Any, container: type, args: tuple[Any, ...], location: Location) -> Sequence[Any]:
    _require(value, isinstance(value, list))
    if container is tuple and args and args[-1] is not Ellipsis:
        _require(value, len(value) == len(args))
        return tuple(_convert(item, inner, location) for item, inner in zip(value, args, strict=True))
    items = [_convert(item, args[0] if args else Any, location) for item in value]
    return tuple(items) if container is tuple else items


def _require(value: Any, condition: bool) -> Any:
    if not condition:
        raise _Mismatch
    return value


def _int(value: Any) -> int:
    # In Python a bool is an int, but in a configuration true is not a number. 1e6 is a float in YAML
    _require(value, isinstance(value, int | float) and not isinstance(value, bool) and value % 1 == 0)
    return int(value)


def _float(value: Any) -> float:
    _require(value, isinstance(value, int | float) and not isinstance(value, bool))
    try:
        return float(value)
    except OverflowError:
        raise _Mismatch from None


_SCALARS: dict[Any, Callable[[Any], Any]] = {
    int: _int,
    float: _float,
    bool: lambda value: _require(value, isinstance(value, bool)),
    str: lambda value: _require(value, isinstance(value, str)),
    type(None): lambda value: _require(value, value is None),
    None: lambda value: _require(value, value is None),
    object: lambda value: value,
}


def _schedule(value: Any) -> LinearSchedule:
    kind, _, number = value.partition("_") if isinstance(value, str) else ("", "", "")
    try:
        start = float(number)
    except ValueError:
        raise _Mismatch from None
    _require(value, kind == "lin")
    return LinearSchedule(start, 0.0, 1.0)


def _resolve_class(value: Any, base: Any, location: Location) -> type:
    _require(value, isinstance(value, str))
    found = resolve(value, location.text, location.extra_packages)
    if not inspect.isclass(found) or (inspect.isclass(base) and not issubclass(found, base)):
        raise ConfigError(f"{location.text}: {value!r} is not a subclass of {base.__module__}.{base.__name__}.")
    return found


def describe(hint: Any) -> str:
    """
    Return what a type annotation allows, in words for the author of a YAML file.

    :param hint: Type annotation
    :return: Description that completes the sentence "must be ..."
    """
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(dict.fromkeys(describe(member) for member in args))
    if origin is typing.Literal:
        return " or ".join(map(repr, args))
    if hint in _WORDS:
        return _WORDS[hint]
    if origin is type or hint is type:
        base = args[0] if args else object
        return f"the dotted path of a {getattr(base, '__name__', 'class')} class"
    container = origin or hint
    if container is Callable:
        return "a schedule such as lin_3e-4 (linear, from that value to 0)"
    if inspect.isclass(container) and issubclass(container, Mapping):
        return "a mapping"
    if inspect.isclass(container) and issubclass(container, Sequence):
        return "a list" + (f" ({', '.join(describe(arg) for arg in args if arg is not Ellipsis)})" if args else "")
    if hint is Any or isinstance(hint, typing.TypeVar):
        return "a value"
    return f"left out (a {getattr(hint, '__name__', hint)} object cannot be written in YAML)"


_WORDS: dict[Any, str] = {
    int: "an integer",
    float: "a number",
    bool: "true or false",
    str: "a string",
    type(None): "null",
    None: "null",
}
