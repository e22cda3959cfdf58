"""Make the vectorised environment of a team from an id or from a PettingZoo environment of the user's own."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from pettingzoo import ParallelEnv

from sb3_belief.envs.registry import make_batched_env, spec
from sb3_belief.vec_env.joint_env import JointEnv, Visibility
from sb3_belief.vec_env.parallel_team_vec_env import ParallelTeamVecEnv
from sb3_belief.vec_env.team_vec_env import TeamVecEnv


def make_team_env(
    env: str | Callable[..., ParallelEnv],
    n_envs: int = 1,
    seed: int | None = None,
    vec_env: str = "dummy",
    env_kwargs: Mapping[str, Any] | None = None,
    wrapper: Callable[[ParallelEnv], ParallelEnv] | None = None,
    visibility: Visibility | None = None,
) -> TeamVecEnv:
    """
    Make ``n_envs`` copies of a team environment as one SB3 ``VecEnv``.

    :param env: An id (``"traffic-junction-medium"``, ``"mpe/simple_spread_v3"``, ``"module:callable"``; the command
        ``sb3-belief envs`` lists them), or a callable (class or function) that returns a new PettingZoo ``ParallelEnv``
    :param n_envs: Number of environment copies, at least 1
    :param seed: Copy i is seeded with ``seed + i`` at its first reset. With None the copies are unseeded. A ``Team`` with a
        seed seeds them anew
    :param vec_env: ``"dummy"`` steps the copies in this process, all at once where the environment has a batched class.
        ``"subproc"`` runs each copy in a worker process of its own. Workers import the calling script, which therefore needs
        ``if __name__ == "__main__":``
    :param env_kwargs: Keyword arguments of the environment
    :param wrapper: Wrapper that is applied to the ``ParallelEnv`` of each copy
    :param visibility: Which actions each agent could observe, for an environment that has no method ``visibility()``. The
        callable is given the ``ParallelEnv`` of each copy after each step and returns {agent: bool [n_others]}, the others in
        the order of ``possible_agents``. With None every agent sees the actions of all agents in play
    :return: The vectorised environment
    :raises TypeError: If ``env`` is an environment instead of a callable that makes one
    :raises ValueError: For an unknown id, an unknown ``vec_env``, ``n_envs < 1``, or ``visibility`` for an environment that
        has a method ``visibility()``
    :raises ModuleNotFoundError: If the package of an id is not installed. The message has the line that installs it
    """
    if vec_env not in ("dummy", "subproc"):
        raise ValueError(f"vec_env must be 'dummy' or 'subproc', got {vec_env!r}.")
    if n_envs < 1:
        raise ValueError(f"n_envs must be at least 1, got {n_envs}.")
    kwargs = dict(env_kwargs or {})

    team_env: TeamVecEnv | None = None
    if isinstance(env, str):
        # A batched class has no ParallelEnv per copy to which a wrapper or a visibility function could be applied
        if vec_env == "dummy" and wrapper is None and visibility is None:
            team_env = make_batched_env(env, n_envs, **kwargs)
        # The id is looked up in this process, because ids registered here are unknown in a worker process
        make_one = spec(env).maker(**kwargs)
    elif callable(env) and not isinstance(env, ParallelEnv):
        make_one = partial(env, **kwargs)
    else:
        raise TypeError(
            f"make_team_env() needs a registered id or a callable that makes a ParallelEnv, got {type(env).__name__}:"
            " it makes n_envs separate copies, so pass the class, or a function that returns a new environment."
        )

    if team_env is None:
        make_copies = [partial(_make_joint, make_one, wrapper, visibility, copy) for copy in range(n_envs)]
        team_env = ParallelTeamVecEnv(make_copies, subproc=vec_env == "subproc")
    if seed is not None:
        team_env.seed(seed)
    return team_env


def _make_joint(
    make_one: Callable[[], ParallelEnv],
    wrapper: Callable[[ParallelEnv], ParallelEnv] | None,
    visibility: Visibility | None,
    copy: int,
) -> JointEnv:
    env = make_one()
    return JointEnv(env if wrapper is None else wrapper(env), visibility, copy)
