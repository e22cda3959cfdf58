"""Scripted others: partners that belong to an environment, act in it and do not learn."""

from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from sb3_belief.vec_env.validation import difference


class ScriptedOthers:
    """
    The scripted others of a ``ParallelEnv``.

    An environment declares them by ``scripted_action_spaces`` {name: space}, and its method ``scripted_actions()`` returns
    {name: action} for the last step. An environment with neither member has no scripted others.

    :param env: The environment
    :raises TypeError: If it has only one of the two members, or if one of them is of the wrong type
    :raises ValueError: If two names are the same as text
    """

    def __init__(self, env: ParallelEnv):
        given = optional_member(env, "scripted_action_spaces")
        last_actions = optional_member(env, "scripted_actions")
        if (given is None) != (last_actions is None):
            has, lacks = ("scripted_action_spaces", "scripted_actions()")[:: 1 if last_actions is None else -1]
            raise TypeError(
                f"{type(getattr(env, 'unwrapped', env)).__name__} has {has} but not {lacks}: an environment with scripted"
                " others has the attribute scripted_action_spaces {name: space} and the method scripted_actions() -> {name:"
                " action of the last step}; one without them has neither."
            )
        if given is not None and not (hasattr(given, "items") and callable(last_actions)):
            raise TypeError(
                "scripted_action_spaces must be a dict {name: space} and scripted_actions a method that returns"
                f" {{name: action}}, got {type(given).__name__} and {type(last_actions).__name__}."
            )
        own = {} if given is None else dict(given.items())
        # Like agents, they are known by str(name)
        self.action_spaces: dict[str, spaces.Space] = {str(name): space for name, space in own.items()}
        if len(self.action_spaces) < len(own):
            raise ValueError(f"Two scripted others of {list(own)} have the same name as text: give them different ones.")
        self._own_names = dict(zip(own, self.action_spaces, strict=True))
        self._last_actions: Any = last_actions

    def actions(self) -> np.ndarray:
        """
        Return the actions of the last step, each encoded as by ``gymnasium.spaces.flatten``, side by side.

        :return: float32 ``[W_scripted]``
        :raises ValueError: If an action is missing, has an unknown name or is not in its space
        """
        actions = self._last_actions()
        if actions.keys() != self._own_names.keys():
            missing, unknown = difference(list(self._own_names), actions)
            raise ValueError(
                f"scripted_actions() must return one action for each of {list(self.action_spaces)}: missing {missing},"
                f" unknown {unknown}."
            )
        return np.concatenate([_flat(name, self.action_spaces[name], actions[own]) for own, name in self._own_names.items()])


def optional_member(env: ParallelEnv, name: str) -> Any:
    """
    Return an attribute or method that an environment may offer beyond PettingZoo's interface.

    :param env: The environment, with or without wrappers
    :param name: Name of the member
    :return: The member, or None if the environment has none of that name
    """
    # Wrappers pass members on, but conversions to AEC and back do not, and some of SuperSuit's wrappers consist of such
    # conversions (e.g. dtype_v0). If visibility() got lost there, agents would observe more than they should
    return getattr(env, name, getattr(getattr(env, "unwrapped", env), name, None))


def _flat(name: str, space: spaces.Space, action: Any) -> np.ndarray:
    """
    Flatten one action.

    :param name: Name of the scripted other
    :param space: Its action space
    :param action: Its action
    :return: float32 ``[flatdim(space)]``
    :raises ValueError: If the action is not in the space
    """
    values = np.asarray(action)
    if isinstance(space, spaces.Box):
        # Bounds are not checked: the environment is responsible for the actions that it chooses itself
        fits = values.dtype.kind in "biuf" and values.shape == space.shape
    else:
        fits = values.dtype.kind in "biu" and space.contains(values.astype(np.int64))
    if not fits:
        raise ValueError(
            f"scripted_actions() returned {action!r} for {name!r}, which is no action of {space}: return what it did in the"
            " last step, or correct its entry in scripted_action_spaces."
        )
    return np.asarray(spaces.flatten(space, values), dtype=np.float32)
