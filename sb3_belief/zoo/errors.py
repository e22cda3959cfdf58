"""What a user sees when a setting is refused."""

from collections.abc import Iterable

from sb3_belief.envs import suites


class ConfigError(ValueError):
    """A setting refused before anything started. The message names its place, what is allowed and the nearest match."""


def nearest(given: object, allowed: Iterable[str]) -> str:
    """
    :param given: what was typed
    :param allowed: what could have been typed
    :return: `` Did you mean 'x'?`` (with the leading space), or nothing if no name is near
    """
    return suites.nearest(given, allowed, most=2, cutoff=0.5)


def unknown(where: str, kind: str, given: object, allowed: Iterable[str]) -> ConfigError:
    """
    :param where: file and section, or flag
    :param kind: what was to be named, e.g. ``"key"``
    :param given: the name that does not exist
    :param allowed: the names that do
    :return: the error to raise
    """
    names = list(allowed)
    return ConfigError(f"{where}: unknown {kind} {given!r}.{nearest(given, names)} Allowed: {', '.join(names) or 'none'}.")
