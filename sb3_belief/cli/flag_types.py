"""What the flags of the command line take: the types of argparse, which refuse what cannot be meant."""

import argparse

from sb3_belief.zoo.durations import DURATION, seconds_of

# The largest numbers that make sense; beyond them numpy, torch or the system fail in ways of their own
_MOST, _MOST_SEED, _MOST_THREADS, _MOST_FPS = 10**15, 2**31 - 1, 1024, 1000


def _number(text: str, least: int, most: int) -> int:
    try:
        # 1e6 is a whole number too
        value = int(text) if text.lstrip("+-").isdecimal() else float(text)
        if value % 1 == 0 and least <= value <= most:
            return int(value)
    # float("nan") % 1 is no number, and Python reads no integer of thousands of digits
    except ValueError:
        pass
    raise argparse.ArgumentTypeError(f"must be a whole number from {least} to {most:,}, not {text[:40]!r}")


def positive_number(text: str) -> int:
    """
    Read a number of steps, episodes or copies.

    :param text: The word on the command line
    :return: The number, at least 1
    :raises ArgumentTypeError: For another word, as in all functions here
    """
    return _number(text, 1, _MOST)


def whole_number(text: str) -> int:
    """
    Read a number that may be 0.

    :param text: The word on the command line
    :return: The number
    """
    return _number(text, 0, _MOST)


def positive_or_off(text: str) -> int:
    """
    Read a number of steps between two events.

    :param text: The word on the command line
    :return: The number, at least 1, or -1 for never
    """
    return -1 if text == "-1" else positive_number(text)


def duration_or_off(text: str) -> float:
    """
    Read how much time lies between two events.

    :param text: The word on the command line: a number of seconds, or with a unit: ``90s``, ``10m``, ``2h``
    :return: Seconds, or -1 for never
    """
    try:
        return seconds_of(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be {DURATION}, not {text[:40]!r}") from None


def seed_number(text: str) -> int:
    """
    Read a seed.

    :param text: The word on the command line
    :return: The seed, from 0 to 2**31 - 1
    """
    return _number(text, 0, _MOST_SEED)


def thread_number(text: str) -> int:
    """
    Read a number of threads.

    :param text: The word on the command line
    :return: The number, at least 1, or -1 for torch's default
    """
    return -1 if text == "-1" else process_number(text)


def process_number(text: str) -> int:
    """
    Read a number of processes.

    :param text: The word on the command line
    :return: The number, at least 1
    """
    return _number(text, 1, _MOST_THREADS)


def frame_rate(text: str) -> int:
    """
    Read a number of frames per second.

    :param text: The word on the command line
    :return: The number, at least 1
    """
    return _number(text, 1, _MOST_FPS)


def filled_text(text: str) -> str:
    """
    Read a name or a path.

    :param text: The word on the command line
    :return: The same, if it is not blank. Taken for a flag that is left out, the empty value of an unset variable would train
        another game
    """
    if not text.strip():
        raise argparse.ArgumentTypeError("must not be empty: is a variable of the shell unset?")
    return text


def new_path(text: str) -> str:
    """
    Read the path of what is to be written.

    :param text: The word on the command line
    :return: The same, if it is not blank and no home folder that the shell has not replaced
    """
    if filled_text(text).startswith("~"):
        raise argparse.ArgumentTypeError(
            f"{text[:40]!r} begins with '~', which the shell has not replaced: write the folder out (or ./~ for that name)"
        )
    return text
