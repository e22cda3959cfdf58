"""Scripted others: partners that belong to an environment, act in it and do not learn."""

from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv


class ScriptedOthers:
    """
    What a ``ParallelEnv`` tells of its scripted others: ``scripted_action_spaces`` (name -> space), and after each step
    ``scripted_actions()`` (name -> what it did in that step). Environments without the two have none.

    :param env: the environment
    :raises TypeError: if it has one of the two members without the other, or if they are not what they must be
    """

    def __init__(self, env: ParallelEnv):
        given = optional_member(env, "scripted_action_spaces")
        tell = optional_member(env, "scripted_actions")
        if (given is None) != (tell is None):
            has, lacks = ("scripted_action_spaces", "scripted_actions()")[:: 1 if tell is None else -1]
            raise TypeError(
                f"{type(env.unwrapped).__name__} has {has} but not {lacks}: an environment with scripted others has the"
                " attribute scripted_action_spaces {name: space} and the method scripted_actions() -> {name: action of the"
                " last step}; one without them has neither."
            )
        if given is not None and not (hasattr(given, "items") and callable(tell)):
            raise TypeError(
                "scripted_action_spaces must be a dict {name: space} and scripted_actions a method that returns"
                f" {{name: action}}, got {type(given).__name__} and {type(tell).__name__}."
            )
        self.action_spaces: dict[str, spaces.Space] = {} if given is None else dict(given.items())
        self._tell: Any = tell

    def actions(self) -> np.ndarray:
        """
        :return: what all of them did in the last step, one after the other as ``gymnasium.spaces.flatten`` codes it, float32
            [W_scripted]
        :raises ValueError: if actions are missing, are of nobody or do not fit their spaces
        """
        told = self._tell()
        if told.keys() != self.action_spaces.keys():
            missing = [name for name in self.action_spaces if name not in told]
            unknown = [name for name in told if name not in self.action_spaces]
            raise ValueError(
                f"scripted_actions() must return one action for each of {list(self.action_spaces)}: missing {missing},"
                f" unknown {unknown}."
            )
        return np.concatenate([_flat(name, space, told[name]) for name, space in self.action_spaces.items()])


def optional_member(env: ParallelEnv, name: str) -> Any:
    """
    :param env: the environment, with or without wrappers
    :param name: of something that it may offer beyond PettingZoo's interface
    :return: that, or None if it has no such thing
    """
    # Wrappers pass it on, but not the conversions to AEC and back that some of SuperSuit's consist of (e.g. dtype_v0);
    # silently to lose visibility() there would show agents what they could not see
    return getattr(env, name, getattr(env.unwrapped, name, None))


def _flat(name: str, space: spaces.Space, action: Any) -> np.ndarray:
    """
    :param name: of a scripted other
    :param space: its action space
    :param action: what it did
    :return: float32 [flatdim(space)]
    """
    values = np.asarray(action)
    if isinstance(space, spaces.Box):
        # As for the agents' own actions, the bounds are the environment's affair
        fits = values.dtype.kind in "biuf" and values.shape == space.shape
    else:
        fits = values.dtype.kind in "biu" and space.contains(values.astype(np.int64))
    if not fits:
        raise ValueError(
            f"scripted_actions() returned {action!r} for {name!r}, which is no action of {space}: return what it did in the"
            " last step, or correct its entry in scripted_action_spaces."
        )
    return np.asarray(spaces.flatten(space, values), dtype=np.float32)
