"""
The environments that have an id, and how users give theirs one.

Four kinds of ids: this package's own games (``traffic-junction-medium``), what users register (``register``, or the entry
point group ``sb3_belief.envs`` of an installed package), ``family/name`` for environments of other packages
(``mpe/simple_spread_v3``, see ``suites``), and ``module:callable`` for anything that can be imported.

Classes are named by ``"module:attribute"`` strings and imported when they are asked for, so that looking at the registry
needs none of the optional packages that an environment may need.
"""

import re
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache, partial
from importlib import metadata
from types import MappingProxyType
from typing import Any, TypeVar

from pettingzoo import ParallelEnv

from sb3_belief.envs.suites import SUITES, Suite, listed, load, nearest
from sb3_belief.vec_env.team_vec_env import TeamVecEnv

ENTRY_POINT_GROUP = "sb3_belief.envs"

Maker = TypeVar("Maker", bound=Callable[..., Any])

_ID = re.compile(r"[A-Za-z0-9][\w.-]*(/[\w.-]+)*")
_CALLABLE = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*")


@dataclass(frozen=True)
class EnvSpec:
    """
    How to make an environment.

    :param id: the name users type
    :param parallel: a callable that takes the keyword arguments and returns a PettingZoo ``ParallelEnv``, or the
        ``"module:attribute"`` of one
    :param kwargs: keyword arguments that the id stands for; the user's own override them
    :param batched: ``"module:attribute"`` of a callable ``(n_envs, **kwargs)`` that returns a ``TeamVecEnv`` stepping all its
        copies at once, or None if the environment has no such class
    :param family: where it comes from, None for what needs no further package; its callables get the name first
    """

    id: str
    parallel: str | Callable[..., ParallelEnv]
    kwargs: Mapping[str, Any] = field(default_factory=dict)
    batched: str | None = None
    family: Suite | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "kwargs", MappingProxyType(dict(self.kwargs)))

    @property
    def leading(self) -> tuple[str, ...]:
        """
        :return: the positional arguments that come before all others
        """
        return () if self.family is None else (self.id.partition("/")[2],)

    def load(self) -> Callable[..., ParallelEnv]:
        """
        :return: the callable that makes one copy; it takes ``leading`` and the keyword arguments
        :raises ModuleNotFoundError: if its package is not installed, with the line that installs it
        :raises ValueError: if a ``module:callable`` names nothing that can be called
        """
        if self.family is not None:
            self.family.require(self.id)
        if not isinstance(self.parallel, str):
            return self.parallel
        if self.parallel != self.id:
            return load(self.parallel)
        try:
            found = load(self.parallel)
        except (ModuleNotFoundError, AttributeError) as error:
            module, _, attribute = self.id.partition(":")
            raise ValueError(
                f"{self.id!r} stands for {attribute!r} of the module {module!r}, which cannot be imported: {error}."
            ) from error
        if not callable(found):
            raise ValueError(f"{self.id!r} is a {type(found).__name__}, not a callable that returns a PettingZoo ParallelEnv.")
        return found

    def maker(self, **env_kwargs: Any) -> Callable[[], ParallelEnv]:
        """
        :param env_kwargs: keyword arguments of the environment; they override those of the id
        :return: a callable that returns one copy each time; worker processes can be given it
        """
        return partial(_call, self.load(), self.leading, {**self.kwargs, **env_kwargs})


def _call(make: Callable[..., Any], leading: tuple[str, ...], kwargs: dict[str, Any]) -> Any:
    return make(*leading, **kwargs)


_TRAFFIC_JUNCTION = "sb3_belief.envs.traffic_junction"

_SPECS: dict[str, EnvSpec] = {
    f"traffic-junction-{level}": EnvSpec(
        id=f"traffic-junction-{level}",
        parallel=f"{_TRAFFIC_JUNCTION}.parallel_env:TrafficJunction",
        kwargs={"level": level},
        batched=f"{_TRAFFIC_JUNCTION}.vec_env:TrafficJunctionVecEnv",
    )
    for level in ("easy", "medium", "hard")
}

_SWITCHING_CONVENTION = "sb3_belief.envs.switching_convention"

_SPECS |= {
    f"convention-{game}": EnvSpec(
        id=f"convention-{game}",
        parallel=f"{_SWITCHING_CONVENTION}.parallel_env:SwitchingConvention",
        kwargs=kwargs,
        batched=f"{_SWITCHING_CONVENTION}.vec_env:SwitchingConventionVecEnv",
    )
    for game, kwargs in {
        "swap": {"K": 2, "rewarded": "always"},
        "watch-act": {"K": 2, "rewarded": "last"},
        "redraw": {"K": 5, "rewarded": "always"},
    }.items()
}


def register(id: str, kwargs: Mapping[str, Any] | None = None, batched: str | None = None) -> Callable[[Maker], Maker]:
    """
    Give an environment of one's own an id, for as long as the process lives::

        @register("my-game")
        class MyGame(ParallelEnv):
            ...

        env = make_team_env("my-game", n_envs=8)

    A package that is to bring its environments wherever it is installed names them in its ``setup.cfg`` instead, and then
    the command line knows them too::

        [options.entry_points]
        sb3_belief.envs =
            my-game = my_package.games:MyGame

    :param id: letters, digits, ``_``, ``.`` and ``-``, with slashes between; not of one of the families
    :param kwargs: keyword arguments that the id stands for; the user's own override them
    :param batched: see :class:`EnvSpec`
    :return: a decorator for a class or function that returns a PettingZoo ``ParallelEnv``; it returns what it was given
    :raises ValueError: for an id that cannot be, or that is another environment's
    :raises TypeError: if what it decorates cannot be called
    """
    _check_id(id)

    def decorate(make: Maker) -> Maker:
        if not callable(make):
            raise TypeError(f"register({id!r}) needs a class or function that makes a ParallelEnv, got {type(make).__name__}.")
        old = _SPECS.get(id)
        # The cell of a notebook that is run again defines the same environment anew
        if old is not None and (isinstance(old.parallel, str) or _origin(old.parallel) != _origin(make)):
            raise ValueError(f"The id {id!r} is another environment's already: choose a different one.")
        _SPECS[id] = EnvSpec(id, make, kwargs or {}, batched)
        return make

    return decorate


def _origin(make: Any) -> tuple[Any, Any]:
    return getattr(make, "__module__", None), getattr(make, "__qualname__", id(make))


def _check_id(id: str) -> None:
    if not isinstance(id, str) or not _ID.fullmatch(id):
        raise ValueError(f"{id!r} cannot be an id: allowed are letters, digits, '_', '.' and '-', with slashes between.")
    family = id.partition("/")[0]
    if family in SUITES:
        raise ValueError(f"The id {id!r} is of the family {family!r}: choose one that does not begin with {family + '/'!r}.")


@cache
def _installed_specs() -> dict[str, EnvSpec]:
    """
    :return: what installed packages register by entry points; nothing of them is imported
    """
    found: dict[str, EnvSpec] = {}
    for point in metadata.entry_points(group=ENTRY_POINT_GROUP):
        try:
            _check_id(point.name)
            if point.name in _SPECS or point.name in found:
                raise ValueError(f"The id {point.name!r} is another environment's already.")
            if not _CALLABLE.fullmatch(point.value):
                raise ValueError(f"{point.value!r} is not of the form module:callable.")
        except ValueError as error:
            warnings.warn(f"The entry point {point.name!r} of the group {ENTRY_POINT_GROUP!r} is left out: {error}")
            continue
        found[point.name] = EnvSpec(point.name, point.value)
    return found


def registered_ids() -> list[str]:
    """
    :return: this package's own ids and those that users registered, in the order in which they are listed to users
    """
    return list({**_SPECS, **_installed_specs()})


def spec(id: str) -> EnvSpec:
    """
    :param id: one of ``registered_ids()``, ``"family/name"`` or ``"module:callable"``
    :return: its specification; nothing is imported for it
    :raises ValueError: for an unknown id, naming the nearest ones and all there are
    """
    id = str(id)
    if id in _SPECS:
        return _SPECS[id]
    if id in _installed_specs():
        return _installed_specs()[id]
    if _CALLABLE.fullmatch(id):
        return EnvSpec(id, id)
    prefix, slash, name = id.partition("/")
    family = SUITES.get(prefix)
    if family is not None and name:
        return EnvSpec(id, family.make, batched=family.batched, family=family)
    if family is not None:
        names = family.known_names()
        known = f": {listed(names)}" if names else ""
        raise ValueError(f"{id!r} lacks the environment's name; its ids are {prefix + '/<name>'!r}{known}.")
    ids = registered_ids()
    patterns = [f"{name}/<name>" for name in SUITES]
    hint = nearest(prefix + slash, [f"{name}/" for name in SUITES]) if slash else nearest(id, ids)
    raise ValueError(
        f"Unknown environment id {id!r}.{hint} Registered ids: {', '.join(ids)}. Families: {', '.join(patterns)}."
        " An environment of your own needs no id: pass a callable that returns a PettingZoo ParallelEnv, or 'module:callable'."
    )


def make_parallel_env(id: str, **env_kwargs: Any) -> ParallelEnv:
    """
    :param id: see ``spec``
    :param env_kwargs: keyword arguments of the environment; they override those of the id
    :return: one copy of the environment
    :raises ValueError: for an unknown id
    :raises ModuleNotFoundError: if its package is not installed, with the line that installs it
    """
    return spec(id).maker(**env_kwargs)()


def make_batched_env(id: str, n_envs: int, **env_kwargs: Any) -> TeamVecEnv | None:
    """
    :param id: see ``spec``
    :param n_envs: number of copies
    :param env_kwargs: keyword arguments of the environment; they override those of the id
    :return: the copies stepped at once, or None if the environment has no batched class
    :raises ValueError: for an unknown id
    :raises ModuleNotFoundError: if its package is not installed, with the line that installs it
    """
    found = spec(id)
    if found.batched is None:
        return None
    if found.family is not None:
        found.family.require(id)
    return load(found.batched)(*found.leading, n_envs, **{**found.kwargs, **env_kwargs})
