"""What callbacks, and wrappers around a team's environment, have counted and found."""

import inspect
import warnings
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_belief.team.model_parts import wrappers_of
from sb3_belief.team.own_code import callbacks_within

# What ties a callback to a training, and what it was told by it
_OF_LEARN = {"model", "parent", "locals", "globals", "callback", "callbacks", "callback_on_new_best", "eval_env", "pbar"}


def callback_states(callback: BaseCallback | None) -> list[dict[str, Any]]:
    """
    Return what callbacks have counted and found.

    A callback that has the methods ``state_dict()`` and ``load_state_dict()`` says itself what that is. Of any other one it is
    the numbers, arrays and lists of them among its attributes that its constructor was not given.

    :param callback: Of a team or an agent
    :return: Class and state of each callback, in order
    """
    return [{"class": _name(each), "state": _state_of(each)} for each in callbacks_within(callback)]


def have_classes(callback: BaseCallback | None, states: list[dict[str, Any]]) -> bool:
    """
    Tell whether callbacks are of the same classes as others were, in the same order.

    :param callback: Of a team or an agent
    :param states: As :func:`callback_states` returned them
    """
    return [_name(each) for each in callbacks_within(callback)] == [state["class"] for state in states]


def restore_callbacks(callback: BaseCallback | None, states: list[dict[str, Any]], whose: str) -> None:
    """
    Let callbacks go on where others were.

    :param callback: Of a team or an agent
    :param states: As :func:`callback_states` returned them; if they are of other classes, there is a warning and nothing else
    :param whose: Whose callbacks they are, for the warning
    """
    if not have_classes(callback, states):
        names, saved = [_name(each) for each in callbacks_within(callback)], [state["class"] for state in states]
        warnings.warn(
            f"The saved training of {whose} had the callbacks {saved}, now there are {names}: none of them takes over what"
            " was counted and found before. Give the same ones in the same order."
        )
        return
    for each, state in zip(callbacks_within(callback), states, strict=True):
        if hasattr(each, "load_state_dict"):
            each.load_state_dict(state["state"])
            continue
        own = vars(each)
        for name, value in state["state"].items():
            # Only what is there: a file does not add attributes
            if name in own and _is_state(each, name, own[name]):
                own[name] = value


def _name(callback: BaseCallback) -> str:
    return type(callback).__name__


def _state_of(callback: Any) -> dict[str, Any]:
    if hasattr(callback, "state_dict"):
        return callback.state_dict()
    return {name: value for name, value in vars(callback).items() if _is_state(callback, name, value)}


def _is_state(callback: BaseCallback, name: str, value: Any) -> bool:
    return name not in _OF_LEARN | _settings(type(callback)) and _is_numbers(value)


def _settings(callback_class: type) -> set[str]:
    return {name for base in callback_class.__mro__ for name in inspect.signature(base.__init__).parameters}  # type: ignore[misc]


def _is_numbers(value: Any, depth: int = 4) -> bool:
    """Tell whether something is a number or holds nothing but numbers."""
    if isinstance(value, (list, tuple)):
        return depth > 0 and all(_is_numbers(each, depth - 1) for each in value)
    if isinstance(value, dict):
        return depth > 0 and all(isinstance(key, str) and _is_numbers(each, depth - 1) for key, each in value.items())
    return value is None or isinstance(value, (bool, int, float)) or type(value).__module__ == "numpy"


def wrapper_states(env: VecEnv) -> list[dict[str, Any]]:
    """
    Return the numbers that SB3 wrappers around a team's environment hold, such as the sums of a ``VecMonitor``.

    :param env: The team's environment
    :return: Of each wrapper, the outermost first
    """
    return [
        {name: value for name, value in vars(wrapper).items() if _is_counted(wrapper, name, value)}
        for wrapper in wrappers_of(env)
    ]


def restore_wrappers(env: VecEnv, states: list[dict[str, Any]]) -> None:
    """
    Let wrappers go on where others were.

    :param env: The team's environment
    :param states: As :func:`wrapper_states` returned them
    :raises ValueError: If there are other wrappers
    """
    wrappers = list(wrappers_of(env))
    if len(wrappers) != len(states):
        raise ValueError(f"The saved team had {len(states)} SB3 wrappers around its environment, not {len(wrappers)}.")
    for wrapper, state in zip(wrappers, states, strict=True):
        own = vars(wrapper)
        own.update({name: value for name, value in state.items() if name in own and _is_counted(wrapper, name, own[name])})


def _is_counted(wrapper: VecEnv, name: str, value: Any) -> bool:
    return name not in {"num_envs", "render_mode"} | _settings(type(wrapper)) and _is_numbers(value)
