"""The global state that an environment says itself, by PettingZoo's ``state()``."""

from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium import spaces

# PettingZoo's base classes, wrappers and conversions have a method state() that raises or passes on
_WITHOUT_STATE = ("pettingzoo.utils.", "supersuit.")


def own_state(env: Any) -> Callable[[], Any] | None:
    """
    Return the method by which an environment itself says its global state.

    :param env: A ``ParallelEnv``, with or without wrappers and conversions
    :return: The method ``state`` of the outermost layer that defines one; None if the environment has no state of its own
    """
    while env is not None:
        for kind in type(env).__mro__:
            if callable(vars(kind).get("state")) and not kind.__module__.startswith(_WITHOUT_STATE):
                return env.state
        members = getattr(env, "__dict__", {})
        env = members.get("env") or members.get("aec_env") or members.get("par_env")
    return None


def state_row(given: Any, where: str) -> np.ndarray:
    """
    Return a state as one row.

    :param given: What ``state()`` returned
    :param where: Copy and step, in words
    :return: float32 ``[d_s]``
    :raises ValueError: If it is no array of finite numbers
    """
    try:
        row = np.array(given, dtype=np.float32).ravel()
    except (TypeError, ValueError):
        raise ValueError(
            f"state() of the environment returned a {type(given).__name__} {where}: it must return an array of numbers, of the"
            " same shape at every step."
        ) from None
    if not np.isfinite(row).all():
        raise ValueError(f"state() of the environment holds {row[~np.isfinite(row)][0]} {where}: it must be finite.")
    return row


def state_width(env: Any, state: Callable[[], Any] | None, begin: Callable[[], Any], where: str) -> int | None:
    """
    Return the number of entries of an environment's own state.

    :param env: The environment
    :param state: Its method, as :func:`own_state` returned it
    :param begin: Resets the environment if no episode is under way, for one that does not say it by ``state_space``
    :param where: Copy and step, in words
    :return: The number; None if the environment has no state of its own
    """
    space = getattr(env, "state_space", None)
    if state is None:
        return None
    if isinstance(space, spaces.Box):
        return int(np.prod(space.shape))
    begin()
    try:
        return len(state_row(state(), where))
    except NotImplementedError:
        return None
