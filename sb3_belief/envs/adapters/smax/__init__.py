"""
SMAX (Rutherford et al. 2023, https://arxiv.org/abs/2311.10090), battles like StarCraft's written in JAX, from the package
``jaxmarl``.
"""

from typing import Any

from sb3_belief.envs.adapters.smax.parallel_env import Smax
from sb3_belief.envs.adapters.smax.program import map_names
from sb3_belief.envs.adapters.smax.vec_env import SmaxVecEnv


def make(name: str, **env_kwargs: Any) -> Smax:
    """
    :param name: a map, e.g. ``"3m"``
    :param env_kwargs: the other arguments of :class:`~sb3_belief.envs.adapters.smax.parallel_env.Smax`
    :return: one battle
    :raises ValueError: for an unknown map or argument
    """
    return Smax(name, **env_kwargs)


def make_batched(name: str, n_envs: int, **env_kwargs: Any) -> SmaxVecEnv:
    """
    :param name: a map, e.g. ``"3m"``
    :param n_envs: number of copies
    :param env_kwargs: the other arguments of :class:`~sb3_belief.envs.adapters.smax.parallel_env.Smax`
    :return: the copies, stepped at once
    :raises ValueError: for an unknown map or argument
    """
    return SmaxVecEnv(n_envs, name, **env_kwargs)


def names() -> list[str]:
    """
    :return: the maps of the installed SMAX
    """
    return map_names()
