"""
The registry of environments: which ids exist, and how users register environments of their own.

There are four kinds of ids:

- those of this package's own environments (``traffic-junction-medium``)
- those that users register, with ``register`` or by the entry point group ``sb3_belief.envs`` of an installed package
- ``suite/name`` for environments of other packages (``mpe/simple_spread_v3``, see ``suites``)
- ``module:callable`` for anything that can be imported

The registry holds ``"module:attribute"`` strings and imports a class only when an environment is made. Looking up an id
therefore needs none of the optional packages that an environment may need.
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

from sb3_belief.envs.suites import SUITES, Suite, comma_separated, load_attribute, nearest
from sb3_belief.vec_env.team_vec_env import TeamVecEnv

ENTRY_POINT_GROUP = "sb3_belief.envs"

Maker = TypeVar("Maker", bound=Callable[..., Any])

_ID = re.compile(r"[A-Za-z0-9][\w.-]*(/[\w.-]+)*")
_CALLABLE = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*")


@dataclass(frozen=True)
class EnvSpec:
    """
    Description of how to make an environment.

    :param id: Name that users type
    :param parallel: Callable that takes the keyword arguments and returns a PettingZoo ``ParallelEnv``, or the
        ``"module:attribute"`` of such a callable
    :param kwargs: Keyword arguments that the id stands for. Those of the user override them
    :param batched: ``"module:attribute"`` of a callable ``(n_envs, **kwargs)`` that returns a ``TeamVecEnv`` stepping all its
        copies at once. None if the environment has no such class
    :param suite: Suite that the environment belongs to, or None if it needs no further package. The callables of a suite take
        the environment's name as their first argument
    :param requires: Name of a suite whose package the environment needs, although it is none of the suite's. None if it needs
        none
    """

    id: str
    parallel: str | Callable[..., ParallelEnv]
    kwargs: Mapping[str, Any] = field(default_factory=dict)
    batched: str | None = None
    suite: Suite | None = None
    requires: str | None = None

    def __post_init__(self) -> None:
        # The usual assignment is not possible in a frozen dataclass
        object.__setattr__(self, "kwargs", MappingProxyType(dict(self.kwargs)))

    @property
    def family(self) -> Suite | None:
        """The suite, under its earlier name."""
        return self.suite

    @property
    def leading(self) -> tuple[str, ...]:
        """The positional arguments of the callables: the environment's name for one of a suite, otherwise none."""
        return () if self.suite is None else (self.id.partition("/")[2],)

    def load(self) -> Callable[..., ParallelEnv]:
        """
        Import and return the callable that makes one copy of the environment.

        :return: Callable that takes ``leading`` and the keyword arguments
        :raises ModuleNotFoundError: If its package is not installed. The message has the line that installs it
        :raises ValueError: If a ``module:callable`` names nothing that can be called
        """
        if self.suite is not None:
            self.suite.require(self.id)
        if self.requires is not None:
            SUITES[self.requires].require(self.id)
        if not isinstance(self.parallel, str):
            return self.parallel
        if self.parallel != self.id:
            return load_attribute(self.parallel)
        # The user typed this "module:callable", so a mistake in it is reported as a wrong id
        try:
            make = load_attribute(self.parallel)
        except (ModuleNotFoundError, AttributeError) as error:
            module, _, attribute = self.id.partition(":")
            raise ValueError(
                f"{self.id!r} stands for {attribute!r} of the module {module!r}, which cannot be imported: {error}."
            ) from error
        if not callable(make):
            raise ValueError(f"{self.id!r} is a {type(make).__name__}, not a callable that returns a PettingZoo ParallelEnv.")
        return make

    def maker(self, **env_kwargs: Any) -> Callable[[], ParallelEnv]:
        """
        Return a callable without arguments that makes one copy of the environment.

        :param env_kwargs: Keyword arguments of the environment. They override those of the id
        :return: Callable that returns a new copy at each call. It can be sent to a worker process
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

_AISLE_SIDES = "sb3_belief.envs.aisle_sides"

_SPECS |= {
    env_id: EnvSpec(
        id=env_id,
        parallel=f"{_AISLE_SIDES}.parallel_env:AisleSides",
        kwargs={"kinds": kinds},
        batched=f"{_AISLE_SIDES}.vec_env:AisleSidesVecEnv",
    )
    for env_id, kinds in (("aisle-sides", 1), ("aisle-sides-kinds", 4))
}

_JUNCTION_CULTURES = "sb3_belief.envs.junction_cultures"

_SPECS |= {
    f"junction-cultures-{name}": EnvSpec(
        id=f"junction-cultures-{name}",
        parallel=f"{_JUNCTION_CULTURES}.parallel_env:JunctionCultures",
        kwargs=kwargs,
        batched=f"{_JUNCTION_CULTURES}.vec_env:JunctionCulturesVecEnv",
    )
    for name, kwargs in {
        "easy": {"level": "easy"},
        "medium": {"level": "medium"},
        "orders": {"level": "medium", "cultures": "orders"},
    }.items()
}

_SPECS["convention-episode"] = EnvSpec(
    id="convention-episode",
    parallel=f"{_SWITCHING_CONVENTION}.episode_env:ConventionEpisode",
    batched=f"{_SWITCHING_CONVENTION}.episode_env:ConventionEpisodeVecEnv",
)
_SPECS["foreign-speaker"] = EnvSpec(
    id="foreign-speaker", parallel="sb3_belief.envs.foreign_speaker.parallel_env:ForeignSpeaker", requires="mpe"
)

_FORAGING: dict[str, dict[str, Any]] = {
    "picker": {"partners": "orders", "partner_sight": 2, "max_episode_steps": 20},
    "lbf-heuristics": {
        "game": "Foraging-8x8-2p-3f-v3",
        "partners": "heuristics",
        "partner_sight": None,
        "max_episode_steps": 50,
    },
}
_SPECS |= {
    id: EnvSpec(id, "sb3_belief.envs.foraging_partners.parallel_env:PartneredForaging", kwargs, requires="lbf")
    for id, kwargs in _FORAGING.items()
}

_MATRIX_GAMES = "sb3_belief.envs.matrix_games"
_SPECS |= {
    id: EnvSpec(id, f"{_MATRIX_GAMES}:MatrixGame", {"payoffs": payoffs})
    for id, payoffs in {
        "climbing": ((11, -30, 0), (-30, 7, 0), (0, 6, 5)),
        "qtran-matrix": ((8, -12, -12), (-12, 0, 0), (-12, 0, 0)),
        "qplex-matrix": ((8, -12, -12), (-12, 6, 0), (-12, 0, 6)),
        "coordination": ((1, 0), (0, 1)),
    }.items()
}
_SPECS |= {
    id: EnvSpec(id, f"{_MATRIX_GAMES}:{game}")
    for id, game in {
        "penalty": "Penalty",
        "permutation": "Permutation",
        "two-step": "TwoStep",
        "cues": "Cues",
        "hidden-offset": "HiddenOffset",
        "levers": "Levers",
    }.items()
}


def register(id: str, kwargs: Mapping[str, Any] | None = None, batched: str | None = None) -> Callable[[Maker], Maker]:
    """
    Register an environment of the user's own under an id, in this process::

        @register("my-game")
        class MyGame(ParallelEnv):
            ...

        env = make_team_env("my-game", n_envs=8)

    A package can instead name its environments in its ``setup.cfg``. They are then registered wherever the package is
    installed, and the command line knows them too::

        [options.entry_points]
        sb3_belief.envs =
            my-game = my_package.games:MyGame

    :param id: Letters, digits, ``_``, ``.`` and ``-``, with slashes between them. It must not begin with the name of a suite
    :param kwargs: Keyword arguments that the id stands for. Those of the user override them
    :param batched: See :class:`EnvSpec`
    :return: A decorator for a class or function that returns a PettingZoo ``ParallelEnv``. It returns its argument unchanged
    :raises ValueError: If the id has another form, or another environment has it already
    :raises TypeError: If the decorated object cannot be called
    """
    _check_id(id)

    def decorate(make: Maker) -> Maker:
        if not callable(make):
            raise TypeError(f"register({id!r}) needs a class or function that makes a ParallelEnv, got {type(make).__name__}.")
        old = _SPECS.get(id)
        # A notebook cell that is run again defines the same environment once more, which is allowed
        if old is not None and (isinstance(old.parallel, str) or _origin(old.parallel) != _origin(make)):
            raise ValueError(f"The id {id!r} is another environment's already: choose a different one.")
        _SPECS[id] = EnvSpec(id, make, kwargs or {}, batched)
        return make

    return decorate


def _origin(make: Any) -> tuple[Any, Any]:
    # A callable without a name, such as a partial, is the same only as the same object
    return getattr(make, "__module__", None), getattr(make, "__qualname__", id(make))


def _check_id(id: str) -> None:
    if not isinstance(id, str) or not _ID.fullmatch(id):
        raise ValueError(f"{id!r} cannot be an id: allowed are letters, digits, '_', '.' and '-', with slashes between.")
    prefix = id.partition("/")[0]
    if prefix in SUITES:
        raise ValueError(
            f"The id {id!r} belongs to the suite {prefix!r}: choose one that does not begin with {prefix + '/'!r}."
        )


@cache
def _installed_specs() -> dict[str, EnvSpec]:
    """
    Return the specifications that installed packages register by entry points, without importing the packages.

    :return: {id: specification}. A faulty entry point is left out with a warning
    """
    specs: dict[str, EnvSpec] = {}
    for point in metadata.entry_points(group=ENTRY_POINT_GROUP):
        try:
            _check_id(point.name)
            if point.name in _SPECS or point.name in specs:
                raise ValueError(f"The id {point.name!r} is another environment's already.")
            if not _CALLABLE.fullmatch(point.value):
                raise ValueError(f"{point.value!r} is not of the form module:callable.")
        except ValueError as error:
            warnings.warn(f"The entry point {point.name!r} of the group {ENTRY_POINT_GROUP!r} is left out: {error}")
            continue
        specs[point.name] = EnvSpec(point.name, point.value)
    return specs


def registered_ids() -> list[str]:
    """
    Return the registered ids.

    :return: The ids of this package's own environments and those that users registered, in the order in which they are listed
    """
    return list({**_SPECS, **_installed_specs()})


def spec(id: str) -> EnvSpec:
    """
    Return the specification of an environment, without importing its package.

    :param id: One of ``registered_ids()``, ``"suite/name"`` or ``"module:callable"``
    :return: The specification
    :raises ValueError: For an unknown id. The message names the nearest ids and all that exist
    """
    id = str(id)
    if id in _SPECS:
        return _SPECS[id]
    if id in _installed_specs():
        return _installed_specs()[id]
    if _CALLABLE.fullmatch(id):
        return EnvSpec(id, id)
    prefix, slash, name = id.partition("/")
    suite = SUITES.get(prefix)
    if suite is not None and name:
        return EnvSpec(id, suite.make, batched=suite.batched, suite=suite)
    if suite is not None:
        names = suite.known_names()
        known = f": {comma_separated(names)}" if names else ""
        raise ValueError(f"{id!r} lacks the environment's name; its ids are {prefix + '/<name>'!r}{known}.")
    ids = registered_ids()
    patterns = [f"{name}/<name>" for name in SUITES]
    # With a slash the misspelt part is probably the suite's name, without one the id as a whole
    hint = nearest(prefix + slash, [f"{name}/" for name in SUITES]) if slash else nearest(id, ids)
    raise ValueError(
        f"Unknown environment id {id!r}.{hint} Registered ids: {', '.join(ids)}. Suites: {', '.join(patterns)}."
        " An environment of your own needs no id: pass a callable that returns a PettingZoo ParallelEnv, or 'module:callable'."
    )


def make_parallel_env(id: str, **env_kwargs: Any) -> ParallelEnv:
    """
    Make one copy of an environment.

    :param id: See :func:`spec`
    :param env_kwargs: Keyword arguments of the environment. They override those of the id
    :return: The PettingZoo environment
    :raises ValueError: For an unknown id
    :raises ModuleNotFoundError: If its package is not installed. The message has the line that installs it
    """
    return spec(id).maker(**env_kwargs)()


def make_batched_env(id: str, n_envs: int, **env_kwargs: Any) -> TeamVecEnv | None:
    """
    Make copies of an environment that are all stepped at once.

    :param id: See :func:`spec`
    :param n_envs: Number of environment copies
    :param env_kwargs: Keyword arguments of the environment. They override those of the id
    :return: The vectorised environment, or None if the environment has no batched class
    :raises ValueError: For an unknown id
    :raises ModuleNotFoundError: If its package is not installed. The message has the line that installs it
    """
    env_spec = spec(id)
    if env_spec.batched is None:
        return None
    if env_spec.suite is not None:
        env_spec.suite.require(id)
    return load_attribute(env_spec.batched)(*env_spec.leading, n_envs, **{**env_spec.kwargs, **env_kwargs})
