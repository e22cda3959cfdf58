"""Checks of what a user gives, with messages that name the argument and what is allowed."""

import math


def check_integer(name: str, value: object, least: int, meaning: str, most: int | None = None) -> None:
    """
    Check an argument that counts something.

    :param name: Name of the argument
    :param value: What the user gave
    :param least: Smallest value that is allowed
    :param meaning: What the argument is, for the message
    :param most: Largest value that is allowed, None if there is none
    :raises ValueError: If it is not an integer of that range
    """
    if not isinstance(value, int) or isinstance(value, bool) or value < least or (most is not None and value > most):
        allowed = f">= {least}" if most is None else f"from {least} to {most}"
        raise ValueError(f"{name}={value!r} must be an integer {allowed}: {meaning}.")


def check_flag(name: str, value: object) -> None:
    """
    Check an argument that is True or False.

    :param name: Name of the argument
    :param value: What the user gave
    :raises ValueError: If it is neither
    """
    if not isinstance(value, bool):
        raise ValueError(f"{name}={value!r} must be True or False.")


def check_positive(name: str, value: object, meaning: str) -> None:
    """
    Check an argument that is a number above 0.

    :param name: Name of the argument
    :param value: What the user gave
    :param meaning: What the argument is, for the message
    :raises ValueError: If it is no finite number above 0
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < math.inf:
        raise ValueError(f"{name}={value!r} must be a number above 0: {meaning}.")


def check_share(name: str, value: object, meaning: str) -> None:
    """
    Check an argument that is a share, or a probability.

    :param name: Name of the argument
    :param value: What the user gave
    :param meaning: What the argument is, for the message
    :raises ValueError: If it is no number in [0, 1]
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value <= 1:
        raise ValueError(f"{name}={value!r} must be a number in [0, 1]: {meaning}.")
