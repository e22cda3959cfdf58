"""Is a YAML value what an argument wants? Read from the signatures, so that no list of settings has to be kept."""

import inspect
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from stable_baselines3.common.utils import LinearSchedule

from sb3_belief.zoo.errors import ConfigError, unknown
from sb3_belief.zoo.names import resolve


@dataclass(frozen=True)
class Place:
    """
    Where a value stands.

    :param text: file and section, or flag
    :param extra_packages: see ``names.resolve``
    """

    text: str
    extra_packages: tuple[str, ...] = ()

    def key(self, name: str) -> "Place":
        return Place(f"{self.text}: {name}", self.extra_packages)


class _Mismatch(Exception):
    """The value is not of this type (another member of a union may take it)."""


def parameters(function: Callable[..., Any]) -> tuple[dict[str, Any], bool]:
    """
    The arguments of a function or of a class's constructor. Where a constructor passes ``**kwargs`` on to its base class, the
    base's arguments count too.

    :param function: class or function
    :return: {argument: annotation} in order, and whether arguments beyond these may exist that the signature does not tell
    """
    constructors = [function]
    if inspect.isclass(function):
        constructors = [vars(cls)["__init__"] for cls in function.__mro__ if "__init__" in vars(cls)]
    found: dict[str, Any] = {}
    for constructor in constructors:
        if constructor is object.__init__:
            return found, False
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
        # Names imported under TYPE_CHECKING only (SB3: "VecEnv"); the annotations of interest here are objects already
        return {name: hint for name, hint in function.__annotations__.items() if not isinstance(hint, str)}


def check_call(
    function: Callable[..., Any], given: Any, place: Place, skip: int = 0, reserved: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """
    Check keyword arguments against a signature.

    :param function: class or function to be called
    :param given: what the YAML has for its keyword arguments
    :param place: where that stands
    :param skip: number of leading arguments that the caller passes itself
    :param reserved: {argument: what to do instead} for arguments that are not to be given here
    :return: the arguments as the function wants them: dotted paths resolved, schedules made
    :raises ConfigError: for an unknown argument or a wrong type
    """
    if given is None:
        given = {}
    if not isinstance(given, dict):
        raise ConfigError(f"{place.text}: must be a mapping of arguments, not {given!r}.")
    known, open_ended = parameters(function)
    reserved = reserved or {}
    allowed = {name: hint for name, hint in list(known.items())[skip:] if name not in reserved}
    result = {}
    for name, value in given.items():
        if name in reserved:
            raise ConfigError(f"{place.text}: {name!r} cannot be set here: {reserved[name]}. Allowed: {', '.join(allowed)}.")
        if name not in allowed and not open_ended:
            raise unknown(place.text, "key", name, allowed)
        result[name] = check_value(value, allowed.get(name, Any), place.key(name))
    return result


def check_value(value: Any, hint: Any, place: Place) -> Any:
    """
    :param value: what the YAML has
    :param hint: type annotation
    :param place: where it stands
    :return: the value as the annotation wants it
    :raises ConfigError: if it does not fit
    """
    try:
        return _convert(value, hint, place)
    except _Mismatch:
        raise ConfigError(f"{place.text}: must be {describe(hint)}, not {value!r} ({type(value).__name__}).") from None


def _convert(value: Any, hint: Any, place: Place) -> Any:
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if hint is Any or hint is inspect.Parameter.empty or isinstance(hint, typing.TypeVar):
        return value
    if origin in (typing.Union, types.UnionType):
        return _convert_union(value, args, place)
    if origin is typing.Literal:
        return _require(value, value in args)
    if hint in _SCALARS:
        return _SCALARS[hint](value)
    if origin is type or hint is type:
        return _resolve_class(value, args[0] if args else object, place)
    container = origin or hint
    if container is Callable:
        return _schedule(value)
    if inspect.isclass(container) and issubclass(container, Mapping):
        return _convert_mapping(value, args, place)
    if inspect.isclass(container) and issubclass(container, Sequence):
        return _convert_sequence(value, container, args, place)
    # an object (a noise, an environment, a space): not something that plain data can be
    raise _Mismatch


def _convert_union(value: Any, members: tuple[Any, ...], place: Place) -> Any:
    for member in members:
        try:
            return _convert(value, member, place)
        except _Mismatch:
            continue
    raise _Mismatch


def _convert_mapping(value: Any, args: tuple[Any, ...], place: Place) -> dict[Any, Any]:
    _require(value, isinstance(value, dict))
    inner = args[1] if len(args) == 2 else Any
    return {key: check_value(item, inner, place.key(str(key))) for key, item in value.items()}


def _convert_sequence(value: Any, container: type, args: tuple[Any, ...], place: Place) -> Sequence[Any]:
    _require(value, isinstance(value, list))
    if container is tuple and args and args[-1] is not Ellipsis:
        _require(value, len(value) == len(args))
        return tuple(_convert(item, inner, place) for item, inner in zip(value, args, strict=True))
    items = [_convert(item, args[0] if args else Any, place) for item in value]
    return tuple(items) if container is tuple else items


def _require(value: Any, condition: bool) -> Any:
    if not condition:
        raise _Mismatch
    return value


def _int(value: Any) -> int:
    # a bool is an int in Python, never in a configuration; 1e6 is a float in YAML
    _require(value, isinstance(value, int | float) and not isinstance(value, bool) and float(value).is_integer())
    return int(value)


def _float(value: Any) -> float:
    return float(_require(value, isinstance(value, int | float) and not isinstance(value, bool)))


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


def _resolve_class(value: Any, base: Any, place: Place) -> type:
    _require(value, isinstance(value, str))
    found = resolve(value, place.text, place.extra_packages)
    if not inspect.isclass(found) or (inspect.isclass(base) and not issubclass(found, base)):
        raise ConfigError(f"{place.text}: {value!r} is not a subclass of {base.__module__}.{base.__name__}.")
    return found


def describe(hint: Any) -> str:
    """
    :param hint: type annotation
    :return: what it allows, in the words of someone who writes YAML
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
    return f"left out (a {getattr(hint, '__name__', hint)} object cannot be written in YAML)"


_WORDS: dict[Any, str] = {
    int: "an integer",
    float: "a number",
    bool: "true or false",
    str: "a text",
    type(None): "null",
    None: "null",
}
