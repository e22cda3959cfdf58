"""Training of a team by a configuration, in a run folder of its own."""

from contextlib import ExitStack, closing
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_belief.common.safe_files.trust import Trust
from sb3_belief.common.threads import use_threads
from sb3_belief.team import Team, TeamVecEnv, make_team_env
from sb3_belief.team.agent_models import env_seed
from sb3_belief.vec_env.observe_last import with_last_step
from sb3_belief.vec_env.states import ENVIRONMENT
from sb3_belief.zoo.config import RunConfig
from sb3_belief.zoo.endings import EndSignals
from sb3_belief.zoo.errors import ConfigError, cause
from sb3_belief.zoo.learning import RunCallbacks, learn_and_save
from sb3_belief.zoo.names import CENTRAL
from sb3_belief.zoo.preflight import (
    agent_without_masks,
    check_copies,
    check_device,
    check_eval_env,
    check_folder,
    check_memory,
    check_optimizers,
    check_step,
    warn_of_rollouts,
)
from sb3_belief.zoo.run_folder import (
    RunRecord,
    find_team,
    folder_name,
    make_run_folder,
    remove_run_folder,
    write_config,
)
from sb3_belief.zoo.run_lock import run_lock
from sb3_belief.zoo.tracking import ENTRY, Tracking, TrackingCallback, check_tracking
from sb3_belief.zoo.train_options import TrainOptions, TrainResult


def train(config: RunConfig, options: TrainOptions, after_eval: BaseCallback | None = None) -> TrainResult:
    """
    Train a team in a new folder ``<log_folder>/<algo>/<env>_<k>/``.

    Whatever ends the training, the last good state is saved there (see ``zoo.endings``).

    :param config: Configuration of the team and its environment
    :param options: Options of the run
    :param after_eval: Called after each evaluation, with SB3's ``EvalCallback`` as its parent; None for nothing
    :return: The folder and the team, also if Ctrl-C, SIGTERM or SIGHUP ended the training
    :raises ConfigError: If the environment or the algorithm refuses its settings. Nothing has been written in this case
    :raises RunFailed: If the training fails
    """
    trained = None if options.trained_agent is None else find_team(options.trained_agent, "--trained-agent")
    _check_options(config, options)
    seed = int(np.random.SeedSequence().generate_state(1)[0] % 2**31) if options.seed is None else options.seed
    options = replace(options, seed=seed)
    use_threads(options.num_threads)

    with ExitStack() as stack:
        signals = stack.enter_context(EndSignals())
        env, eval_env = make_envs(config, options, stack)
        # The team opens its logs in the folder, so the folder must exist first. It is removed again if the team is refused
        folder = make_run_folder(options.log_folder, config.algo, config.env_id)
        try:
            team = make_team(config, options, env, seed, trained, folder)
            callbacks = RunCallbacks.make(team, config, options, folder, eval_env, signals, after_eval=after_eval)
            tracking = Tracking.start(config, options, folder)
        except BaseException:
            remove_run_folder(folder)
            raise
        stack.enter_context(run_lock(folder))
        write_config(folder, config)
        record = RunRecord(
            folder,
            options.command,
            algo=config.algo,
            note=config.note,
            state=env.state_source if CENTRAL in config.note else "",
            env=config.env_id,
            seed=seed,
            source=config.source,
            trained_agent=None if trained is None else str(trained.absolute()),
            start_timesteps=team.num_timesteps,
            total_timesteps=team.num_timesteps + config.n_timesteps,
            vec_env=options.vec_env,
            device=str(options.device),
            num_threads=th.get_num_threads(),
            jobs=options.jobs,
            options=options.to_record(),
            **({} if tracking is None else {ENTRY: tracking.to_record()}),
        )
        track(tracking, callbacks, record, stack)
        with record.failures():
            env.start_monitor(str(folder))
            if options.verbose:
                print(f"Run folder: {folder}  (seed {seed})")
                if config.note:
                    print(f"{config.algo} {config.note}{_state(config, env)}.")
            # A team that continues its training continues counting its steps
            return learn_and_save(team, config, options, folder, record, callbacks, signals, trained is None)


def _state(config: RunConfig, env: TeamVecEnv) -> str:
    if CENTRAL not in config.note:
        return ""
    return f" (the {'environment has its own' if env.state_source == ENVIRONMENT else 'observations of all agents'})"


def track(tracking: Tracking | None, callbacks: RunCallbacks, record: RunRecord, stack: ExitStack) -> None:
    """
    Have a run be logged to a tracker until it ends.

    :param tracking: The run's log; None for none
    :param callbacks: Callbacks of the run
    :param record: Record of the run, which says at its end how it has ended
    :param stack: Closes the log at its end
    """
    if tracking is not None:
        callbacks.others.append(TrackingCallback(tracking))
        stack.callback(lambda: tracking.finish(record.content["status"]))


def make_envs(config: RunConfig, options: TrainOptions, stack: ExitStack) -> tuple[TeamVecEnv, TeamVecEnv | None]:
    """
    Make and check the environments of a run.

    :param config: The configuration
    :param options: Options of the run, with a seed
    :param stack: Closes the environments at its end
    :return: The environment in which the team learns, and that of evaluations, if there are any
    :raises ConfigError: If an environment refuses its settings, or does not fit
    """
    seed = options.seed
    assert seed is not None
    limit = options.step_timeout if options.step_timeout > 0 else None
    env = make_env(
        config,
        config.n_envs,
        seed,
        options.vec_env,
        trust_pickle=options.trust,
        step_timeout=limit,
        restart_workers=options.restart_workers,
    )
    stack.callback(env.close)
    config.check_agents(env.possible_agents)
    check_memory(config, env)
    warn_of_rollouts(config, env.possible_agents)
    _check_first_reset(config, env)
    if config.wrapper is not None:
        with closing(make_env(config, 1, seed, trust_pickle=options.trust)) as tried:
            check_step(config, tried)
    eval_env = None
    if options.eval_freq > 0:
        eval_config = replace(config, env_kwargs={**config.env_kwargs, **config.eval_env_kwargs})
        eval_env = make_env(
            eval_config, options.n_eval_envs, env_seed(seed, purpose=1), evaluation=True, trust_pickle=options.trust
        )
        stack.callback(eval_env.close)
        check_eval_env(config, env, eval_env)
    return env, eval_env


def _check_first_reset(config: RunConfig, env: TeamVecEnv) -> None:
    """Check that the environment can be reset, and that agents that need action masks get some."""
    try:
        # The team seeds the environment once it is made, so that this reset changes nothing of the training
        env.reset()
        agent = agent_without_masks(config, env)
    except Exception as error:
        raise ConfigError(f"{config.source}: {config.env_id} cannot be reset: {cause(error)}") from error
    if agent is not None:
        name = config.agent(agent).algo
        raise ConfigError(
            f"--algo: {name} needs action masks, and {config.env_id} gives {agent!r} none. Use"
            f" {name.replace('maskable_', '')}, or give the masks in infos[agent]['action_mask']."
        )


def _check_options(config: RunConfig, options: TrainOptions) -> None:
    check_device(options.device)
    check_folder(Path(options.log_folder, config.algo, folder_name(config.env_id)), "-f")
    if options.tensorboard_log is not None:
        if find_spec("tensorboard") is None:
            raise ConfigError("-tb: TensorBoard's logs need tensorboard: pip install 'sb3-belief[plots]'.")
        check_folder(Path(options.tensorboard_log, config.algo, folder_name(config.env_id)), "-tb")
    for _, kwargs in config.callbacks:
        if isinstance(kwargs.get("save_path"), str):
            check_folder(kwargs["save_path"], f"{config.origin('callback:')}: callback: save_path")
    check_tracking(options)
    check_optimizers(config, options.device)
    check_copies(config.n_envs, options.vec_env, config.origin("n_envs"))
    if options.step_timeout > 0 and options.vec_env != "subproc":
        raise ConfigError("--step-timeout: an environment in this process cannot be ended while it hangs: --vec-env subproc.")
    if options.eval_freq > 0:
        check_copies(options.n_eval_envs, "dummy", "--n-eval-envs")


def make_env(
    config: RunConfig,
    n_envs: int,
    seed: int,
    vec_env: str = "dummy",
    evaluation: bool = False,
    trust_pickle: bool = False,
    **faults: Any,
) -> TeamVecEnv:
    """
    Make the environment that a configuration describes, with the partners that act in it.

    :param config: The configuration
    :param n_envs: Number of environment copies
    :param seed: Copy i is seeded with ``seed + i``
    :param vec_env: ``"dummy"`` or ``"subproc"``
    :param evaluation: Whether it is an environment of evaluations, in which partners are met that are held out
    :param trust_pickle: Whether to unpickle what the files of partners hold
    :param faults: ``step_timeout`` and ``restart_workers``, as for ``make_team_env``
    :return: The environment of the team
    :raises ConfigError: If the environment refuses its settings, or partners do not fit
    """
    try:
        env = make_team_env(
            config.env_id,
            n_envs=n_envs,
            seed=seed,
            vec_env=vec_env,
            env_kwargs=config.env_kwargs,
            wrapper=config.wrapper,
            visibility=config.visibility,
            **faults,
        )
    # An environment of the user's own may raise anything, and any settings may be more than the memory holds
    except Exception as error:
        reason = cause(error)
        raise ConfigError(f"{config.origin(reason)}: {config.env_id} refuses its settings: {reason}") from error
    if config.partners is not None:
        env = with_config_partners(config, env, seed, evaluation, trust_pickle)
    try:
        # Around the partners, who observe what they have learned with
        env = with_last_step(env, **config.observation)
        return env if config.adapter is None else config.adapter(env)
    except ValueError as error:
        raise ConfigError(f"{config.source}: {config.env_id}: {error}") from error


def with_config_partners(config: RunConfig, env: TeamVecEnv, seed: int, evaluation: bool, trust_pickle: bool) -> TeamVecEnv:
    """
    Put the partners of a configuration into an environment, which is closed if they do not fit.

    :param config: The configuration, with partners
    :param env: The environment
    :param seed: As for ``make_env``
    :param evaluation: As for ``make_env``
    :param trust_pickle: As for ``make_env``
    :return: The environment of the learners
    :raises ConfigError: If the partners do not fit
    """
    assert config.partners is not None
    try:
        return config.partners.put_into(env, seed, evaluation, trust_pickle)
    except Exception as error:
        env.close()
        raise ConfigError(f"{config.origins['partners']}: partners: {cause(error)}") from error


def make_team(
    config: RunConfig,
    options: TrainOptions,
    env: TeamVecEnv,
    seed: int,
    trained: Path | None = None,
    folder: Path | None = None,
) -> Team:
    """
    Make the team that a configuration describes, or load a saved one.

    :param config: The configuration
    :param options: Options of the run, of which the team takes device, verbosity, TensorBoard folder and jobs
    :param env: Environment in which the team learns
    :param seed: Seed of the team
    :param trained: Zip of a saved team to load instead of making a new one
    :param folder: Folder of the CSV logs, or None for no logs
    :return: The team
    :raises ConfigError: If the algorithm refuses its settings or the environment
    """
    common = common_arguments(config, options, folder)
    if trained is not None:
        trust = Trust.of(options.trust, options.extra_packages)
        return _load_team(config, trained, env, seed, {**common, **trust._asdict()})
    try:
        algo_class, policy, kwargs = _models(config, env)
        return Team(algo_class, policy, env, seed=seed, normalize=config.normalize, **common, **kwargs)
    # SB3 checks action spaces and batch sizes by assertions, and torch raises a RuntimeError for what is too large
    except Exception as error:
        reason = cause(error)
        raise ConfigError(f"{config.origin(reason)}: {config.algo} cannot be set up on {config.env_id}: {reason}") from error


def common_arguments(config: RunConfig, options: TrainOptions, folder: Path | None) -> dict[str, Any]:
    """
    Return the arguments of a team that do not depend on where it comes from.

    :param config: The configuration
    :param options: Options of the run
    :param folder: Folder of the CSV logs, or None for no logs
    :return: Arguments of ``Team`` and of ``Team.load``
    """
    return dict(
        device=options.device,
        tensorboard_log=options.tensorboard_log
        and str(Path(options.tensorboard_log, config.algo, folder_name(config.env_id))),
        verbose=options.verbose,
        log_dir=None if folder is None else str(folder),
        jobs=options.jobs,
        on_nan=options.on_nan,
    )


def _models(config: RunConfig, env: TeamVecEnv) -> tuple[Any, Any, dict[str, Any]]:
    """Return class, policy and further arguments of a ``Team``: of all agents, or by agent if some have their own."""
    if not config.agents:
        return config.algo_class, config.policy, config.algo_kwargs
    agents = {name: config.agent(name) for name in env.possible_agents}
    return (
        {name: each.algo_class for name, each in agents.items()},
        {name: each.policy for name, each in agents.items()},
        {"agent_kwargs": {name: each.algo_kwargs for name, each in agents.items()}},
    )


def _load_team(config: RunConfig, trained: Path, env: TeamVecEnv, seed: int, common: dict[str, Any]) -> Team:
    try:
        team = Team.load(trained, env=env, **common)
    # A damaged file makes zipfile, pickle and torch raise whatever they raise
    except Exception as error:
        raise ConfigError(f"--trained-agent: {str(trained)!r} cannot be set up on {config.env_id}: {cause(error)}") from error
    for agent, model in team.agents.items():
        expected = config.agent(agent).algo_class
        if type(model) is not expected:
            raise ConfigError(
                f"--trained-agent: {agent!r} in {str(trained)!r} is a {type(model).__name__}, not a {expected.__name__}."
            )
    # Loading seeds the environment as in the run before. With this run's own seed it does not repeat the same episodes
    env.seed(env_seed(seed))
    return team
