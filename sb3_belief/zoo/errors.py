"""The error for settings that do not fit."""

import re
import traceback
from collections.abc import Iterable
from pathlib import Path

# A list in a message that is longer than this is shortened: the bounds of a large space would hide the rest of the message
_LONG = 60


class ConfigError(ValueError):
    """
    Error for a setting that is refused before anything has started.

    The message names the file and section or the flag, what is allowed, and the nearest match.
    """


class RunFailed(RuntimeError):
    """
    Error for a training that has failed after it had started.

    The message says why, and where the last good state is. The cause (``__cause__``) is what was raised.
    """


def shorten(text: str) -> str:
    """
    Shorten the long lists of numbers in a message, such as the bounds of a space.

    :param text: The message
    :return: The message with the middle of each long bracketed list left out
    """
    # Arrays of numpy, which have no commas and may be nested, and lists of Python
    for separators in (r"\[\]", ","):
        text = re.sub(rf"\[[-+\d.\saefin{separators}]{{{_LONG},}}\]", lambda match: _ends(match[0]), text)
    return text


def _ends(numbers: str) -> str:
    words = numbers.replace("\n", " ").split()
    return f"{' '.join(words[:2])} ... {' '.join(words[-2:])}"


def short(value: object) -> str:
    """
    Return a value as text for a message.

    :param value: What the user gave
    :return: Its representation, cut off if it is long
    """
    try:
        text = repr(value)
    except ValueError:
        # Python refuses to write out an integer of thousands of digits
        return "a number of thousands of digits"
    return text if len(text) <= 2 * _LONG else f"{text[: 2 * _LONG]}..."


def cause(error: BaseException) -> str:
    """
    Return the cause of a failure in words: the message of an error and, for errors that are not meant for users, its type and
    the place where it was raised.

    :param error: The error
    :return: One line
    """
    # Notes say which agent or environment copy it was
    sentences = [str(error), *getattr(error, "__notes__", [])] if str(error) else []
    text = shorten(" ".join(" ".join(f"{sentence.rstrip('. ')}." for sentence in sentences).split()))
    # SB3 explains itself in assertions too
    if isinstance(error, ValueError | AssertionError) and text:
        return text
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
    return f"{type(error).__name__}: {text}{place}" if text else f"{type(error).__name__}{place}"


def reason_of(error: OSError | ValueError) -> str:
    """
    Return why a file or folder cannot be written or read.

    :param error: The error
    :return: What the system says, without the path, which the message has already
    """
    if isinstance(error, FileExistsError):
        return "a file of this name exists"
    return getattr(error, "strerror", None) or str(error)


def suggestion(given: object, allowed: Iterable[str]) -> str:
    """
    Return a suggestion for a misspelt setting, to be appended to an error message.

    :param given: What the user typed
    :param allowed: The names that are allowed
    :return: `` Did you mean 'x'?`` with the leading space, or an empty string if no name is similar enough
    """
    # Imported here, so that --help need not import the environments
    from sb3_belief.envs.suites import nearest

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
    name, colon, value = str(given).partition(":")
    hint = f" A space belongs after the colon: {name}: {value}." if colon and name in names else suggestion(given, names)
    return ConfigError(f"{where}: unknown {kind} {short(given)}.{hint} Allowed: {', '.join(names) or 'none'}.")
