"""Make the vectorised environment of a team from an id or from one's own PettingZoo environment."""

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

    :param env: an id (``"traffic-junction-medium"``, ``"mpe/simple_spread_v3"``, ``"module:callable"``; ``sb3-belief envs``
        lists them), or a callable (class or function) that returns a new PettingZoo ``ParallelEnv``
    :param n_envs: number of copies, at least 1
    :param seed: copy i gets ``seed + i`` at its first reset; None: unseeded (a ``Team`` with a seed seeds them)
    :param vec_env: "dummy" steps the copies in this process (all at once where the environment has a batched class),
        "subproc" has one worker process per copy; these start afresh, so a script needs ``if __name__ == "__main__":``
    :param env_kwargs: keyword arguments of the environment
    :param wrapper: applied to each copy's ``ParallelEnv`` before its agents are split
    :param visibility: for an environment that does not say itself, by a method ``visibility()``, whose actions an agent
        could observe: called with each copy's ``ParallelEnv`` after each step, it returns {agent: bool [n_others]}, the others
        in the order of ``possible_agents``. None: everyone sees everyone in play.
    :return: the vectorised environment
    :raises TypeError: if ``env`` is an environment instead of what makes one
    :raises ValueError: for an unknown id, an unknown ``vec_env``, ``n_envs < 1``, or ``visibility`` for an environment that
        says it itself
    :raises ModuleNotFoundError: if the package of an id is not installed, with the line that installs it
    """
    if vec_env not in ("dummy", "subproc"):
        raise ValueError(f"vec_env must be 'dummy' or 'subproc', got {vec_env!r}.")
    if n_envs < 1:
        raise ValueError(f"n_envs must be at least 1, got {n_envs}.")
    kwargs = dict(env_kwargs or {})

    team_env: TeamVecEnv | None = None
    if isinstance(env, str):
        if vec_env == "dummy" and wrapper is None and visibility is None:
            team_env = make_batched_env(env, n_envs, **kwargs)
        # Looked up here: a worker process need not know what was registered in this one
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
