"""Make the vectorised environment of a team from an id or from a PettingZoo environment of the user's own."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from pettingzoo import ParallelEnv

from sb3_belief.common.exceptions import add_note
from sb3_belief.envs.registry import make_batched_env, spec
from sb3_belief.vec_env.joint_env import JointEnv, Visibility
from sb3_belief.vec_env.observe_last import with_last_step
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
    step_timeout: float | None = None,
    restart_workers: int = 0,
    observe_last: bool | Sequence[str] = False,
    partner_starts: bool | Sequence[str] = False,
    observe_window: int | Mapping[str, int] = 0,
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
    :param step_timeout: Seconds within which a worker process must answer each reset, step or other command, beside its start.
        One that does not is ended, and an error names copy, step and command. Longer than the slowest reset; None for no limit
    :param restart_workers: How often each copy is made anew after its worker has died or hung, or its environment has raised
        an error, in a step or reset. The episode is cut off there (``TimeLimit.truncated``, ``worker_restarted`` in the info),
        with a warning. The new copy is seeded from the copy's seed and the number of its restarts; attributes that were set on
        the old one are lost. Copies are then stepped one by one even if the environment has a batched class
    :param observe_last: Whether agents also observe their last step: the visible others' actions, their visibility, their own
        action and reward, see ``ObserveLastVecEnv``. True for all agents, or the names of those that do
    :param partner_starts: Whether agents are told where another partner has come, and observe their last step also over the
        ends of episodes, for ``PartnerRecurrentPPO``. True for all agents, or the names of those that are
    :param observe_window: How many of its last observations an agent observes, ``[L, d]``, see ``ObserveWindowVecEnv``: a
        number for all agents, or by agent for those that do. 0 for the observations as they are
    :return: The vectorised environment
    :raises TypeError: If ``env`` is an environment instead of a callable that makes one
    :raises ValueError: For an unknown id, an unknown ``vec_env``, ``n_envs < 1``, a ``step_timeout`` that is not positive or
        without worker processes, a negative ``restart_workers``, ``visibility`` for an environment that has a method
        ``visibility()``, unknown agents, or ``partner_starts`` for an environment that does not say which partner is there
    :raises ModuleNotFoundError: If the package of an id is not installed. The message has the line that installs it
    """
    if vec_env not in ("dummy", "subproc"):
        raise ValueError(f"vec_env must be 'dummy' or 'subproc', got {vec_env!r}.")
    if n_envs < 1:
        raise ValueError(f"n_envs must be at least 1, got {n_envs}.")
    check_fault_options(vec_env, step_timeout, restart_workers)
    kwargs = dict(env_kwargs or {})

    team_env: TeamVecEnv | None = None
    if isinstance(env, str):
        # A batched class has no ParallelEnv per copy to which a wrapper or a visibility function could be applied
        if vec_env == "dummy" and wrapper is None and visibility is None and not restart_workers:
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
        team_env = ParallelTeamVecEnv(make_copies, vec_env == "subproc", step_timeout, restart_workers)
    team_env = with_last_step(team_env, observe_last, partner_starts, observe_window)
    if seed is not None:
        team_env.seed(seed)
    return team_env


def check_fault_options(vec_env: str, step_timeout: float | None, restart_workers: int) -> None:
    """
    Check what is to be done about copies that fail.

    :param vec_env: As for :func:`make_team_env`
    :param step_timeout: As for :func:`make_team_env`
    :param restart_workers: As for :func:`make_team_env`
    :raises ValueError: If one is out of its range, or a time limit is given where nothing could be ended
    """
    if step_timeout is not None:
        is_number = isinstance(step_timeout, (int, float)) and not isinstance(step_timeout, bool)
        if not (is_number and 0 < step_timeout < float("inf")):
            raise ValueError(f"step_timeout must be a positive number of seconds, or None for no limit, got {step_timeout!r}.")
        if vec_env != "subproc":
            raise ValueError(
                f"step_timeout={step_timeout!r} needs vec_env='subproc': an environment in this process cannot be ended"
                " while it hangs."
            )
    if not isinstance(restart_workers, int) or isinstance(restart_workers, bool) or restart_workers < 0:
        raise ValueError(f"restart_workers must be a number of restarts, 0 for none, got {restart_workers!r}.")


def _make_joint(
    make_one: Callable[[], ParallelEnv],
    wrapper: Callable[[ParallelEnv], ParallelEnv] | None,
    visibility: Visibility | None,
    copy: int,
) -> JointEnv:
    try:
        env = make_one()
        return JointEnv(env if wrapper is None else wrapper(env), visibility, copy)
    except Exception as error:
        add_note(error, f"Raised when environment copy {copy} was made.")
        raise
