"""Functions as partners: what they are given besides an observation, and whether they act for all copies at once."""

import inspect
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from sb3_belief.vec_env.observation_forms import map_parts, row_of

Function = TypeVar("Function", bound=Callable[..., Any])

_MARK = "takes_batches_of_observations"


def batched(function: Function) -> Function:
    """
    Mark a partner's function as one that acts for all copies in one call.

    It is given observations ``[n, ...]`` of n copies and returns actions ``[n, ...]``; n may differ from call to call. Without
    the mark a function is called for one copy after the other, with one observation. Like any function that is a partner, it
    is also given ``action_masks`` (bool ``[n, k]``, None without masks) and ``rng`` (``numpy.random.Generator``) if it has
    arguments of these names.

    :param function: The function
    :return: The same function
    :raises TypeError: If it cannot be marked, as a function that is written in C
    """
    try:
        setattr(function, _MARK, True)
    except AttributeError:
        raise TypeError(f"{function!r} cannot be marked by batched(): wrap it in a function of your own.") from None
    return function


class PartnerFunction:
    """
    Calls a partner's function, for one copy or for several.

    :param name: Name of the agent for which it acts, for messages
    :param function: The function
    """

    def __init__(self, name: str, function: Callable[..., Any]):
        self._name, self._function = name, function
        self._is_batched = bool(getattr(function, _MARK, False))
        arguments = _arguments(function)
        self._takes_masks, self._takes_rng = "action_masks" in arguments, "rng" in arguments

    def one(self, obs: Any, mask: np.ndarray | None, rng: np.random.Generator) -> np.ndarray:
        """
        Choose the action of one copy.

        :param obs: Its observation
        :param mask: The agent's possible actions, bool ``[k]``, or None
        :param rng: The partner's random numbers
        :return: The action
        """
        if not self._is_batched:
            return self._call(obs, mask, rng)
        batch = map_parts(lambda part: np.asarray(part)[None], obs)
        return self.several(batch, None if mask is None else mask[None], rng, 1)[0]

    def several(self, obs: Any, masks: np.ndarray | None, rng: np.random.Generator, n: int) -> np.ndarray:
        """
        Choose the actions of several copies.

        :param obs: Their observations, ``[n, ...]``
        :param masks: The agent's possible actions, bool ``[n, k]``, or None
        :param rng: The partner's random numbers
        :param n: Number of the copies
        :return: The actions, ``[n, ...]``
        :raises ValueError: If a function of batches does not return one action for each copy
        """
        if self._is_batched:
            actions = self._call(obs, masks, rng)
            if actions.shape[:1] != (n,):
                raise ValueError(
                    f"The partner {self._name!r} is a function of batches: given {n} observations it must return {n} actions,"
                    f" not an array of shape {actions.shape}."
                )
            return actions
        return np.stack([self._call(row_of(obs, i), None if masks is None else masks[i], rng) for i in range(n)])

    def _call(self, obs: Any, masks: np.ndarray | None, rng: np.random.Generator) -> np.ndarray:
        kwargs: dict[str, Any] = {"action_masks": masks} if self._takes_masks else {}
        if self._takes_rng:
            kwargs["rng"] = rng
        return np.asarray(self._function(obs, **kwargs))


def _arguments(function: Callable[..., Any]) -> frozenset[str]:
    try:
        return frozenset(inspect.signature(function).parameters)
    except (TypeError, ValueError):
        # Callables written in C need not have a signature
        return frozenset()
