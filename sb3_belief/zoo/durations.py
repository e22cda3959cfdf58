"""Lengths of time as people write them."""

import re

_UNITS = {"": 1, "s": 1, "m": 60, "h": 3600}
# Beyond it, the system's clocks fail in ways of their own
_MOST = 10**15
#: What ``seconds_of`` reads, for messages
DURATION = "a time such as 90s, 10m or 2h, or -1 for never"


def seconds_of(text: str) -> float:
    """
    Read a length of time: a number of seconds, or with a unit: ``90s``, ``10m``, ``2h``.

    :param text: The text
    :return: Seconds, or -1 for never
    :raises ValueError: For another text
    """
    if text.strip() == "-1":
        return -1.0
    number, unit = re.fullmatch(r"(.*?)([smh]?)", text.strip(), re.DOTALL).groups()  # type: ignore[union-attr]
    seconds = float(number) * _UNITS[unit]
    if not 0 < seconds <= _MOST:
        raise ValueError(f"{text!r} is not from 0 to {_MOST:,} seconds")
    return seconds
