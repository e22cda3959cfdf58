"""
The form in which models take observations: an array, or a dict of arrays by name, without action masks.

Environments also give tuples, nested dicts, and PettingZoo's ``{"observation": ..., "action_mask": ...}``;
:class:`ObservationForms` brings these into that form.
"""

from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv
from torch import nn

from sb3_belief.vec_env.action_masks import flat_mask
from sb3_belief.vec_env.scripted_others import optional_member

MASK = "action_mask"


class _Form(NamedTuple):
    """
    How an agent's observations are converted.

    :param agent: Name of the agent
    :param has_mask: Whether they hold an action mask
    :param paths: Where each array lies in them, by the name that it gets; the name is empty if there is a single array
    """

    agent: str
    has_mask: bool
    paths: dict[str, tuple[Any, ...]]

    def convert(self, observation: Any) -> Any:
        """
        Convert an observation.

        :param observation: As the environment returned it
        :return: The observation in the form that models take
        :raises ValueError: If a part is missing
        """
        parts = {}
        for name, path in self.paths.items():
            part = observation
            for key in path:
                try:
                    part = part[key]
                except (KeyError, IndexError, TypeError):
                    raise ValueError(
                        f"The observation of {self.agent!r} has no entry {'/'.join(map(str, path))!r}: return what"
                        f" observation_space({self.agent!r}) declares, or correct the space."
                    ) from None
            parts[name] = part
        return parts.get("", parts)


class ObservationForms:
    """
    Brings the observations of an environment into the form that models take.

    - A ``Dict`` with an entry ``action_mask`` loses it to the info, for an agent whose actions can be masked. Of the rest, a
      single entry is the observation itself, several remain a ``Dict``.
    - A ``Tuple`` becomes a ``Dict`` with the keys ``"0"``, ``"1"``, ...
    - A nested ``Dict`` becomes one of a single level, whose keys are the joined ones: ``"sensors/camera"``.
    - The masks that an environment's own ``action_masks()`` returns, {agent: mask}, go into the infos.
    - Keys that PyTorch does not take as names of modules (``"items"``, ``"a.b"``) are changed: ``"items_"``, ``"a_b"``.

    :param env: The environment
    :raises ValueError: If two entries would have the same name
    """

    def __init__(self, env: ParallelEnv):
        self._action_masks = optional_member(env, "action_masks")
        #: Observation space of each agent in that form
        self.spaces: dict[str, spaces.Space] = {}
        self._forms: list[_Form] = []
        for agent in env.possible_agents:
            space: Any = env.observation_space(agent)
            self.spaces[agent] = space
            has_mask = isinstance(space, spaces.Dict) and MASK in space.spaces and len(space.spaces) > 1
            has_mask = has_mask and not isinstance(env.action_space(agent), spaces.Box)
            leaves = [(path, leaf) for path, leaf in _leaves(space) if not (has_mask and path[0] == MASK)]
            # Without the key of the observation proper, if it is the only one
            start = 1 if has_mask and len(space.spaces) == 2 else 0
            found = [(_name(path[start:]), path, leaf) for path, leaf in leaves]
            names = [name for name, _, _ in found]
            twice = [name for name in names if names.count(name) > 1]
            if twice:
                raise ValueError(
                    f"The observation space of {agent!r} has several entries that would be called {twice[0]!r} when its levels"
                    " are joined: rename one of them."
                )
            # An ordinary space stays the very object that it is
            if has_mask or any(path != (name,) for name, path, _ in found if path):
                self._forms.append(_Form(agent, has_mask, {name: path for name, path, _ in found}))
                parts = {name: leaf for name, _, leaf in found}
                self.spaces[agent] = parts[""] if "" in parts else spaces.Dict(parts)

    @property
    def is_identity(self) -> bool:
        """Whether all observations have that form already, and all masks are in the infos."""
        return not self._forms and self._action_masks is None

    def convert(self, obs: Mapping[str, Any], infos: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
        """
        Convert observations, and move their masks to the infos.

        :param obs: Observations by agent
        :param infos: Infos by agent
        :return: New observations and infos, by agent
        :raises ValueError: If a part of an observation is missing, or ``action_masks()`` returns something else
        """
        obs, infos = dict(obs), dict(infos or {})
        for form in self._forms:
            agent = form.agent
            if agent in obs:
                if form.has_mask:
                    if not isinstance(obs[agent], Mapping) or MASK not in obs[agent]:
                        raise ValueError(
                            f"The observation of {agent!r} has no entry {MASK!r}: return what observation_space({agent!r})"
                            " declares, or correct the space."
                        )
                    infos[agent] = {**(infos.get(agent) or {}), MASK: flat_mask(obs[agent][MASK]).astype(bool)}
                obs[agent] = form.convert(obs[agent])
        if self._action_masks is not None:
            masks = self._action_masks()
            if not isinstance(masks, Mapping):
                raise ValueError(
                    f"The environment's action_masks() returned a {type(masks).__name__}: it must return a mask for each agent"
                    " that has one, {agent: mask}. Masks may also stand in infos[agent]['action_mask']."
                )
            for name, mask in masks.items():
                agent = str(name)
                infos[agent] = {MASK: flat_mask(mask).astype(bool), **(infos.get(agent) or {})}
        return obs, infos


def _leaves(space: spaces.Space, path: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], spaces.Space]]:
    """Yield where each part of a space lies that has no parts of its own, and the part."""
    if isinstance(space, spaces.Dict):
        for key, part in space.spaces.items():
            yield from _leaves(part, (*path, key))
    elif isinstance(space, spaces.Tuple):
        for i, part in enumerate(space.spaces):
            yield from _leaves(part, (*path, i))
    else:
        yield path, space


def _name(path: tuple[Any, ...]) -> str:
    """Return the name of a part, which a module of its features extractor can have."""
    name = "/".join(map(str, path)).replace(".", "_")
    return f"{name}_" if name and hasattr(nn.ModuleDict, name) else name


def map_parts(function: Callable[..., Any], observation: Any, *others: Any) -> Any:
    """
    Apply a function to an observation, or to each entry of one that is a dict.

    :param function: Takes an array of each observation
    :param observation: An array or a dict of arrays
    :param others: Further ones, with at least the same entries
    :return: The result, or a dict of results
    """
    if isinstance(observation, Mapping):
        return {key: function(part, *(other[key] for other in others)) for key, part in observation.items()}
    return function(observation, *others)


def copied(observation: Any) -> Any:
    """
    Copy an observation.

    :param observation: An array or a dict of arrays
    :return: The copy
    """
    return map_parts(np.array, observation)


def as_bytes(observation: Any) -> Any:
    """
    Return what can be compared with that of another observation.

    :param observation: An array or a dict of arrays
    :return: Its bytes, or a dict of bytes
    """
    return map_parts(lambda part: np.asarray(part).tobytes(), observation)


def row_of(observations: Any, env_idx: int) -> Any:
    """
    Return the observation of one copy.

    :param observations: ``[num_envs, ...]``, an array or a dict of arrays
    :param env_idx: Number of the copy
    :return: The observation ``[...]``
    """
    return map_parts(lambda rows: rows[env_idx], observations)


def zeros_in(space: spaces.Space) -> Any:
    """
    Return the observation of an agent that has left.

    :param space: Its observation space
    :return: Zeros, an array or a dict of arrays
    """
    if isinstance(space, spaces.Dict):
        return {key: zeros_in(part) for key, part in space.spaces.items()}
    return np.zeros(space.shape or (), dtype=space.dtype)


def parts_of(space: spaces.Space) -> Mapping[Any, spaces.Space]:
    """
    Return the parts of an observation space, each of which holds arrays.

    :param space: The space, in the form that models take
    :return: The entries of a ``Dict`` by name; of any other space itself, under None
    """
    return space.spaces if isinstance(space, spaces.Dict) else {None: space}
