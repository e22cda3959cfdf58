"""
The environments that have an id.

Classes are named by ``"module:attribute"`` strings and imported when they are asked for, so that looking at the registry
needs none of the optional packages that an environment may need.
"""

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # imports point one way: the team room may import this module, never the other way round at run time
    from pettingzoo import ParallelEnv

    from sb3_belief.team.vec_env import TeamVecEnv


@dataclass(frozen=True)
class EnvSpec:
    """
    How to make an environment.

    :param id: the name users type
    :param parallel: ``"module:attribute"`` of a callable that takes the keyword arguments and returns a PettingZoo
        ``ParallelEnv``
    :param kwargs: keyword arguments that the id stands for; the user's own override them
    :param batched: ``"module:attribute"`` of a callable ``(n_envs, **kwargs)`` that returns a ``TeamVecEnv`` stepping all its
        copies at once, or None if the environment has no such class
    """

    id: str
    parallel: str
    kwargs: Mapping[str, Any] = field(default_factory=dict)
    batched: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "kwargs", MappingProxyType(dict(self.kwargs)))


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


def registered_ids() -> list[str]:
    """
    :return: all ids, in the order in which they are listed to users
    """
    return list(_SPECS)


def spec(id: str) -> EnvSpec:
    """
    :param id: one of ``registered_ids()``
    :return: its specification
    :raises ValueError: for an unknown id, naming the nearest ones and all there are
    """
    if id not in _SPECS:
        ids = registered_ids()
        near = difflib.get_close_matches(str(id), ids, n=3, cutoff=0.4)
        hint = f" Did you mean {' or '.join(map(repr, near))}?" if near else ""
        raise ValueError(
            f"Unknown environment id {id!r}.{hint} Registered ids: {', '.join(ids)}."
            " An environment of your own needs no id: pass a callable that returns a PettingZoo ParallelEnv."
        )
    return _SPECS[id]


def make_parallel_env(id: str, **env_kwargs: Any) -> "ParallelEnv":
    """
    :param id: one of ``registered_ids()``
    :param env_kwargs: keyword arguments of the environment; they override those of the id
    :return: one copy of the environment
    :raises ValueError: for an unknown id
    """
    found = spec(id)
    return _load(found.parallel)(**{**found.kwargs, **env_kwargs})


def make_batched_env(id: str, n_envs: int, **env_kwargs: Any) -> "TeamVecEnv | None":
    """
    :param id: one of ``registered_ids()``
    :param n_envs: number of copies
    :param env_kwargs: keyword arguments of the environment; they override those of the id
    :return: the copies stepped at once, or None if the environment has no batched class
    :raises ValueError: for an unknown id
    """
    found = spec(id)
    if found.batched is None:
        return None
    return _load(found.batched)(n_envs, **{**found.kwargs, **env_kwargs})


def _load(target: str) -> Any:
    module, _, attribute = target.partition(":")
    return getattr(import_module(module), attribute)
