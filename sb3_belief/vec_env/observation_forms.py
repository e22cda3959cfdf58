"""
The form in which models take observations: an array, or a dict of arrays by name, without action masks.

Environments also give tuples, nested dicts, and PettingZoo's ``{"observation": ..., "action_mask": ...}``;
:class:`ObservationForms` brings these into that form.
"""

import inspect
from collections.abc import Callable, Iterator, KeysView, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv
from torch import nn

from sb3_belief.common.action_masks import mask_row, mask_width
from sb3_belief.vec_env.scripted_others import optional_member

MASK = "action_mask"


class _Form(NamedTuple):
    """
    How an agent's observations are converted.

    :param agent: Name of the agent
    :param mask: Where its action mask lies in them; empty if they hold none
    :param paths: Where each array lies in them, by the name that it gets; the name is empty if there is a single array
    """

    agent: str
    mask: tuple[Any, ...]
    paths: dict[str, tuple[Any, ...]]

    def convert(self, observation: Any) -> Any:
        """
        Convert an observation.

        :param observation: As the environment returned it
        :return: The observation in the form that models take
        :raises ValueError: If a part is missing
        """
        parts = {name: self.part(observation, path) for name, path in self.paths.items()}
        return parts.get("", parts)

    def part(self, observation: Any, path: tuple[Any, ...]) -> Any:
        """
        Return a part of an observation.

        :param observation: As the environment returned it
        :param path: Where the part lies in it
        :raises ValueError: If the part is missing
        """
        for key in path:
            try:
                observation = observation[key]
            except (KeyError, IndexError, TypeError):
                # Of an array that stands in the place of a dict, the key is no index
                raise ValueError(
                    f"The observation of {self.agent!r} has no entry {'/'.join(map(str, path))!r}: return what"
                    f" observation_space({self.agent!r}) declares, or correct the space."
                ) from None
        return observation


class ObservationForms:
    """
    Brings the observations of an environment into the form that models take.

    - A ``Dict`` with an entry ``action_mask``, on whatever level, loses it to the info, for an agent whose actions can be
      masked. Of the rest, a single entry takes the place of that ``Dict``, several remain one.
    - A ``Tuple`` becomes a ``Dict`` with the keys ``"0"``, ``"1"``, ...
    - A nested ``Dict`` becomes one of a single level, whose keys are the joined ones: ``"sensors/camera"``.
    - The masks that an environment's own ``action_masks`` holds or returns, {agent: mask}, or returns for an agent, go into
      the infos.
    - Keys that PyTorch does not take as names of modules (``"items"``, ``"a.b"``, ``""``) are changed: ``"items_"``,
      ``"a_b"``, ``"_"``.

    :param env: The environment
    :raises ValueError: If two entries would have the same name, or if it is not clear which is the mask
    """

    def __init__(self, env: ParallelEnv):
        self._env = env
        self._asks = optional_member(env, "action_masks") is not None
        #: Observation space of each agent in that form
        self.spaces: dict[str, spaces.Space] = {}
        self._action_spaces = {agent: env.action_space(agent) for agent in env.possible_agents}
        self._forms: list[_Form] = []
        #: For each agent, names of its entries that look like masks of its actions although they are not taken as such
        self.like_masks: dict[str, list[str]] = {}
        for agent in env.possible_agents:
            space: Any = env.observation_space(agent)
            self.spaces[agent] = space
            width = mask_width(self._action_spaces[agent])
            mask = _mask_path(agent, space, width)
            # Without the key of what stands beside the mask, if it is the only one
            above = mask[:-1]
            alone = mask and len(_at(space, above).spaces) == 2
            found = []
            for path, leaf in _leaves(space):
                if not mask or path[: len(mask)] != mask:
                    short = (*above, *path[len(mask) :]) if alone and path[: len(above)] == above else path
                    found.append((_name(short), path, leaf))
            names = [name for name, _, _ in found]
            twice = [name for name in names if names.count(name) > 1]
            if twice:
                raise ValueError(
                    f"The observation space of {agent!r} has several entries that would be called {twice[0]!r} when its levels"
                    " are joined: rename one of them."
                )
            self.like_masks[agent] = [name for name, path, leaf in found if not mask and _like_mask(path, leaf, width)]
            # An ordinary space stays the very object that it is
            if mask or any(path != (name,) for name, path, _ in found if path):
                self._forms.append(_Form(agent, mask, {name: path for name, path, _ in found}))
                parts = {name: leaf for name, _, leaf in found}
                self.spaces[agent] = parts[""] if "" in parts else spaces.Dict(parts)

    @property
    def is_identity(self) -> bool:
        """Whether all observations have that form already, and all masks are in the infos."""
        return not self._forms and not self._asks

    def convert(
        self, obs: Mapping[str, Any], infos: Mapping[str, Any], where: str | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """
        Convert observations, and move their masks to the infos.

        :param obs: Observations by agent
        :param infos: Infos by agent
        :param where: Copy and step, in words; None to take the flags of masks as they are
        :return: New observations and infos, by agent
        :raises ValueError: If a part of an observation is missing, or for ``action_masks`` or masks that are something else
        """
        obs, infos = dict(obs), dict(infos or {})
        for form in self._forms:
            agent = form.agent
            if agent in obs:
                if form.mask:
                    mask = mask_row(form.part(obs[agent], form.mask), self._action_spaces[agent], agent, where)
                    infos[agent] = {**(infos.get(agent) or {}), MASK: mask}
                obs[agent] = form.convert(obs[agent])
        for agent, mask in self._asked_masks().items() if self._asks else ():
            if agent not in self._action_spaces:
                raise ValueError(
                    f"The environment's action_masks have one for {agent!r}, which is not among its possible_agents"
                    f" {list(self._action_spaces)}."
                )
            infos[agent] = {MASK: mask_row(mask, self._action_spaces[agent], agent, where), **(infos.get(agent) or {})}
        return obs, infos

    def _asked_masks(self) -> dict[str, Any]:
        """Return the masks that the environment has in its ``action_masks``, by agent."""
        member = optional_member(self._env, "action_masks")
        if _takes_agent(member):
            # The names that the environment itself has for its agents
            own = {str(name): name for name in getattr(self._env, "own_names", self._action_spaces)}
            return {agent: member(own[agent]) for agent in self._env.agents if agent in own}
        masks = member() if callable(member) else member
        if not isinstance(masks, Mapping):
            raise ValueError(
                f"The environment's action_masks() returned a {type(masks).__name__}: it must return a mask for each agent"
                " that has one, {agent: mask}. Masks may also stand in infos[agent]['action_mask']."
            )
        return {str(name): mask for name, mask in masks.items()}


def _takes_agent(member: Any) -> bool:
    """Return whether a function cannot be called without an argument."""
    try:
        parameters = inspect.signature(member).parameters.values()
    except (TypeError, ValueError):
        return False
    positional = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return any(parameter.default is parameter.empty and parameter.kind in positional for parameter in parameters)


def _mask_path(agent: str, space: Any, width: int) -> tuple[Any, ...]:
    """Return where an agent's action mask lies in its observations, or an empty path."""
    if not width:
        return ()
    if isinstance(space, spaces.Dict) and MASK in space.spaces and len(space.spaces) > 1:
        return (MASK,)
    leaves = list(_leaves(space))
    # Its own may be a Tuple of parts. That of someone else, of another width, is an ordinary entry
    sizes: dict[tuple[Any, ...], int] = {}
    for path, leaf in leaves:
        if MASK in path:
            whole = path[: path.index(MASK) + 1]
            sizes[whole] = sizes.get(whole, 0) + int(np.prod(leaf.shape or ()))
    fitting = [path for path, size in sizes.items() if size == width]
    if len(fitting) > 1:
        raise ValueError(
            f"The observation space of {agent!r} has several action masks,"
            f" {' and '.join(repr('/'.join(map(str, path))) for path in fitting)}: leave that of its own actions there, and"
            " give the others another name."
        )
    # One that is all there is would leave no observation
    return fitting[0] if fitting and any(path[: len(fitting[0])] != fitting[0] for path, _ in leaves) else ()


def _like_mask(path: tuple[Any, ...], leaf: spaces.Space, width: int) -> bool:
    """Return whether an entry looks like a mask of this width."""
    if not width or not path:
        return False
    if any(word in str(key).lower() for key in path for word in ("mask", "avail")):
        return True
    flags = isinstance(leaf, spaces.MultiBinary) or (
        isinstance(leaf, spaces.Box)
        and np.issubdtype(leaf.dtype, np.integer)
        and not leaf.low.any()
        and bool((leaf.high == 1).all())
    )
    return flags and isinstance(path[-1], int) and int(np.prod(leaf.shape or ())) == width


def _at(space: Any, path: tuple[Any, ...]) -> Any:
    """Return a part of a space."""
    for key in path:
        space = space.spaces[key]
    return space


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
    if not path:
        return ""
    name = "/".join(map(str, path)).replace(".", "_") or "_"
    # Of an object, since modules also have attributes of their own: "training"
    return f"{name}_" if hasattr(nn.ModuleDict(), name) else name


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


def has_parts(value: Any, keys: KeysView[str], shapes: list[tuple[str, tuple[int, ...]]]) -> bool:
    """
    Return whether a dict has all its entries, as arrays of these shapes.

    :param value: What may be such a dict
    :param keys: Names of the entries
    :param shapes: Name and shape of those that have a shape
    """
    if not (isinstance(value, Mapping) and value.keys() >= keys):
        return False
    return all(getattr(value[key], "shape", None) == shape for key, shape in shapes)


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


class ObservationStack:
    """
    Stacks the observations of all copies.

    :param num_envs: Number of copies
    :param observation_spaces: Observation space of each agent
    """

    def __init__(self, num_envs: int, observation_spaces: Mapping[str, spaces.Space]):
        self._layout = [
            (agent, [(key, (num_envs, *(part.shape or ())), part.dtype) for key, part in parts_of(space).items()])
            for agent, space in observation_spaces.items()
        ]

    def __call__(self, observations: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """
        Stack observations.

        :param observations: For each copy, observations by agent
        :return: ``[num_envs, ...]`` by agent
        """
        stacked: dict[str, Any] = {}
        for agent, parts in self._layout:
            for key, shape, dtype in parts:
                rows = [obs[agent] if key is None else obs[agent][key] for obs in observations]
                # concatenate() takes a third of the time of array()
                array = np.concatenate(rows, axis=None, dtype=dtype, casting="unsafe").reshape(shape)
                if key is None:
                    stacked[agent] = array
                else:
                    stacked.setdefault(agent, {})[key] = array
        return stacked
