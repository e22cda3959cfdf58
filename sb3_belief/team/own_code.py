"""Code of the user's own that runs while a team learns, and may look at its models or change them at any step."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback

# Callbacks of these libraries, and our own, use a model only to predict and to save it
_LIBRARIES = {"stable_baselines3", "sb3_contrib", __name__.partition(".")[0]}


def callbacks_within(callback: BaseCallback | None) -> Iterator[BaseCallback]:
    """
    Iterate over a callback and the callbacks that SB3's and sb3-contrib's own ones call.

    :param callback: Of a team or an agent
    :return: The callbacks, each before those that it calls
    """
    if callback is None:
        return
    yield callback
    if is_of_a_library(callback) and not isinstance(callback, ConvertCallback):
        called = [
            *getattr(callback, "callbacks", []),
            *(getattr(callback, name, None) for name in ("callback", "callback_on_new_best")),
        ]
        for each in called:
            yield from callbacks_within(each)


def is_of_a_library(callback: BaseCallback) -> bool:
    """
    Tell whether a callback is one of SB3, sb3-contrib or this package.

    :param callback: The callback
    """
    return type(callback).__module__.partition(".")[0] in _LIBRARIES


def find_own_callback(callback: BaseCallback | None) -> Any:
    """
    Find what a team's callback calls besides the callbacks of SB3, sb3-contrib and this package. Those use the models through
    the team's own methods only, and change nothing in them.

    :param callback: Of a team
    :return: The first callback or function of the user's own; None without one
    """
    for each in callbacks_within(callback):
        own = each.callback if isinstance(each, ConvertCallback) else None if is_of_a_library(each) else each
        if own is not None:
            return own
    return None


def runs_own_code(callbacks: Iterable[BaseCallback | None], models: Mapping[str, BaseAlgorithm]) -> bool:
    """
    Tell whether code of the user's own runs within rollouts.

    :param callbacks: Of the team and of its agents
    :param models: The models that act, by agent
    :return: True for a callback or an algorithm that is not from SB3, sb3-contrib or this package
    """
    own = [m for m in models.values() if type(m).__module__.partition(".")[0] not in _LIBRARIES]
    return any(find_own_callback(callback) is not None for callback in callbacks) or bool(own)
