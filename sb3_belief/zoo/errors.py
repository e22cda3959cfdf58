"""The error for settings that do not fit."""

from collections.abc import Iterable

from sb3_belief.envs.suites import nearest


class ConfigError(ValueError):
    """
    Error for a setting that is refused before anything has started.

    The message names the file and section or the flag, what is allowed, and the nearest match.
    """


def suggestion(given: object, allowed: Iterable[str]) -> str:
    """
    Return a suggestion for a misspelt setting, to be appended to an error message.

    :param given: What the user typed
    :param allowed: The names that are allowed
    :return: `` Did you mean 'x'?`` with the leading space, or an empty string if no name is similar enough
    """
    return nearest(given, allowed, most=2, cutoff=0.5)


def unknown_setting(where: str, kind: str, given: object, allowed: Iterable[str]) -> ConfigError:
    """
    Return the error for a name that does not exist.

    :param where: File and section, or flag
    :param kind: What the name should be a name of, e.g. ``"key"``
    :param given: The name that does not exist
    :param allowed: The names that exist
    :return: The error to raise
    """
    names = list(allowed)
    return ConfigError(f"{where}: unknown {kind} {given!r}.{suggestion(given, names)} Allowed: {', '.join(names) or 'none'}.")
