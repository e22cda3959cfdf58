"""
SMAX (Rutherford et al. 2023, https://arxiv.org/abs/2311.10090), StarCraft-like battles in JAX from the package ``jaxmarl``,
with the ids ``smax/<map>``.
"""

from typing import Any

from sb3_belief.envs.adapters.smax.parallel_env import Smax
from sb3_belief.envs.adapters.smax.program import map_names
from sb3_belief.envs.adapters.smax.vec_env import SmaxVecEnv


def make(name: str, **env_kwargs: Any) -> Smax:
    """
    Make one copy of a battle.

    :param name: Name of a map, for instance ``"3m"``
    :param env_kwargs: The other arguments of :class:`~sb3_belief.envs.adapters.smax.parallel_env.Smax`
    :return: The environment
    :raises ValueError: For an unknown map or argument
    """
    return Smax(name, **env_kwargs)


def make_batched(name: str, n_envs: int, **env_kwargs: Any) -> SmaxVecEnv:
    """
    Make copies of a battle that are all stepped at once.

    :param name: Name of a map, for instance ``"3m"``
    :param n_envs: Number of environment copies
    :param env_kwargs: The other arguments of :class:`~sb3_belief.envs.adapters.smax.parallel_env.Smax`
    :return: The vectorised environment
    :raises ValueError: For an unknown map or argument
    """
    return SmaxVecEnv(n_envs, name, **env_kwargs)


def names() -> list[str]:
    """
    Return the maps of the installed SMAX.

    :return: Names of maps
    """
    return map_names()
