"""Training of a team by a configuration, in a run folder of its own."""

import sys
import warnings
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from sb3_contrib.common.maskable.callbacks import MaskableEvalCallback
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback

from sb3_belief.common.safe_files.trust import Trust
from sb3_belief.team import Team, TeamVecEnv, make_team_env
from sb3_belief.team.agent_models import env_seed
from sb3_belief.zoo.config import RunConfig
from sb3_belief.zoo.errors import ConfigError, cause
from sb3_belief.zoo.preflight import (
    check_copies,
    check_device,
    check_eval_env,
    check_folder,
    check_memory,
    check_optimizers,
    check_step,
)
from sb3_belief.zoo.run_folder import (
    CHECKPOINTS,
    CONFIG,
    TEAM,
    RunRecord,
    environment_versions,
    find_team,
    folder_name,
    make_run_folder,
    remove_run_folder,
)


@dataclass(frozen=True)
class TrainOptions:
    """
    Options of a run that are not part of its configuration.

    :param seed: Seed of the team and its environments. None to draw one, which is recorded in ``run.json``
    :param log_folder: Folder of all runs
    :param tensorboard_log: Folder of the TensorBoard logs, or None for none
    :param eval_freq: Number of joint steps between evaluations, -1 for no evaluation
    :param eval_episodes: Number of episodes of an evaluation
    :param n_eval_envs: Number of environment copies of an evaluation
    :param save_freq: Number of joint steps between checkpoints, -1 to save the team at the end only
    :param vec_env: ``"dummy"`` to step all environment copies in this process, ``"subproc"`` for a worker process per copy
    :param device: Device of all models: ``"auto"``, ``"cpu"``, ``"cuda"``, ...
    :param num_threads: Number of torch's threads, -1 for torch's default
    :param jobs: Number of processes, the main one included, in which the agents with on-policy algorithms learn. Each agent
        learns wholly in one of them. The result is the same for any number, to the bit on the CPU. See ``Team``
    :param progress: Whether to show a progress bar
    :param trained_agent: Folder of a run, or zip of a team, whose training is to be continued
    :param extra_packages: See ``names.resolve`` and ``Team.load`` (``allow_packages``)
    :param trust: Whether to load the saved team even if it could run any code
    :param verbose: 0 for no output, 1 for the team's tables, 2 for those of the agents too
    :param command: The words of the command line, recorded in ``run.json``
    """

    seed: int | None = None
    log_folder: str = "logs"
    tensorboard_log: str | None = None
    eval_freq: int = 25_000
    eval_episodes: int = 100
    n_eval_envs: int = 50
    save_freq: int = -1
    vec_env: str = "dummy"
    device: str = "auto"
    num_threads: int = 1
    jobs: int = 1
    progress: bool = False
    trained_agent: str | None = None
    extra_packages: tuple[str, ...] = ()
    trust: bool = False
    verbose: int = 1
    command: list[str] = field(default_factory=lambda: list(sys.argv))


@dataclass(frozen=True)
class TrainResult:
    """
    Result of a run.

    :param folder: Folder of the run
    :param team: The trained team
    :param finished: Whether the training finished. False if it was interrupted by Ctrl-C
    """

    folder: Path
    team: Team
    finished: bool


def train(config: RunConfig, options: TrainOptions) -> TrainResult:
    """
    Train a team in a new folder ``<log_folder>/<algo>/<env>_<k>/``.

    Ctrl-C ends the training and saves the team.

    :param config: Configuration of the team and its environment
    :param options: Options of the run
    :return: The folder and the trained team
    :raises ConfigError: If the environment or the algorithm refuses its settings. Nothing has been written in this case
    """
    trained = None if options.trained_agent is None else find_team(options.trained_agent, "--trained-agent")
    _check_options(config, options)
    seed = int(np.random.SeedSequence().generate_state(1)[0] % 2**31) if options.seed is None else options.seed
    if options.num_threads > 0:
        th.set_num_threads(options.num_threads)

    with ExitStack() as stack:
        env = make_env(config, config.n_envs, seed, options.vec_env)
        stack.callback(env.close)
        config.check_agents(env.possible_agents)
        check_memory(config, env)
        _check_first_reset(config, env)
        if config.wrapper is not None:
            with closing(make_env(config, 1, seed)) as tried:
                check_step(config, tried)
        eval_env = None
        if options.eval_freq > 0:
            eval_config = replace(config, env_kwargs={**config.env_kwargs, **config.eval_env_kwargs})
            eval_env = make_env(eval_config, options.n_eval_envs, env_seed(seed, purpose=1), "dummy")
            stack.callback(eval_env.close)
            check_eval_env(config, env, eval_env)
        # The team opens its logs in the folder, so the folder must exist first. It is removed again if the team is refused
        folder = make_run_folder(options.log_folder, config.algo, config.env_id)
        try:
            team = make_team(config, options, env, seed, trained, folder)
            callbacks = _callbacks(team, config, options, folder, eval_env)
        except BaseException:
            remove_run_folder(folder)
            raise
        (folder / CONFIG).write_text(config.to_yaml(), encoding="utf-8")
        record = RunRecord(
            folder,
            options.command,
            algo=config.algo,
            env=config.env_id,
            seed=seed,
            source=config.source,
            trained_agent=None if trained is None else str(trained.absolute()),
            start_timesteps=team.num_timesteps,
            vec_env=options.vec_env,
            device=str(options.device),
            num_threads=th.get_num_threads(),
            jobs=options.jobs,
        )
        with record.failures():
            env.start_monitor(str(folder))
            if options.verbose:
                print(f"Run folder: {folder}  (seed {seed})")
            return _learn(team, config, options, folder, record, callbacks)


def _check_first_reset(config: RunConfig, env: TeamVecEnv) -> None:
    """Check that the environment can be reset, and that agents that need action masks get some."""
    try:
        # The team seeds the environment once it is made, so that this reset changes nothing of the training
        env.reset()
        masks = env.action_masks() or {}
    except Exception as error:
        raise ConfigError(f"{config.source}: {config.env_id} cannot be reset: {cause(error)}") from error
    for agent in env.possible_agents:
        takes_masks = "action_masks" in signature(config.agent(agent).algo_class.predict).parameters
        if takes_masks and agent not in masks:
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
    check_optimizers(config, options.device)
    check_copies(config.n_envs, options.vec_env, config.origin("n_envs"))
    if options.eval_freq > 0:
        check_copies(options.n_eval_envs, "dummy", "--n-eval-envs")


def make_env(config: RunConfig, n_envs: int, seed: int, vec_env: str = "dummy") -> TeamVecEnv:
    """
    Make the environment that a configuration describes.

    :param config: The configuration
    :param n_envs: Number of environment copies
    :param seed: Copy i is seeded with ``seed + i``
    :param vec_env: ``"dummy"`` or ``"subproc"``
    :return: The environment of the team
    :raises ConfigError: If the environment refuses its settings
    """
    try:
        return make_team_env(
            config.env_id,
            n_envs=n_envs,
            seed=seed,
            vec_env=vec_env,
            env_kwargs=config.env_kwargs,
            wrapper=config.wrapper,
            visibility=config.visibility,
        )
    # An environment of the user's own may raise anything, and any settings may be more than the memory holds
    except Exception as error:
        reason = cause(error)
        raise ConfigError(f"{config.origin(reason)}: {config.env_id} refuses its settings: {reason}") from error


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
    common: dict[str, Any] = dict(
        device=options.device,
        tensorboard_log=options.tensorboard_log
        and str(Path(options.tensorboard_log, config.algo, folder_name(config.env_id))),
        verbose=options.verbose,
        log_dir=None if folder is None else str(folder),
        jobs=options.jobs,
    )
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


def _callbacks(
    team: Team, config: RunConfig, options: TrainOptions, folder: Path, eval_env: TeamVecEnv | None
) -> list[BaseCallback]:
    try:
        callbacks: list[BaseCallback] = [callback(**kwargs) for callback, kwargs in config.callbacks]
    except Exception as error:
        raise ConfigError(f"{config.origin('callback:')}: callback: refuses its settings: {cause(error)}") from error
    # SB3's callbacks count their calls. There is one call for each step of all copies, which is n_envs joint steps
    if options.save_freq > 0:
        save_freq = max(options.save_freq // config.n_envs, 1)
        callbacks.append(CheckpointCallback(save_freq, str(folder / CHECKPOINTS), name_prefix="team", verbose=options.verbose))
    if eval_env is not None:
        # SB3 warns if only one of the two environments has worker processes, which is intended here
        warnings.filterwarnings("ignore", message="Training and eval env are not of the same type")
        callbacks.append(
            (MaskableEvalCallback if team.takes_masks else EvalCallback)(
                eval_env,
                n_eval_episodes=options.eval_episodes,
                eval_freq=max(options.eval_freq // config.n_envs, 1),
                log_path=str(folder),
                best_model_save_path=str(folder),
                verbose=options.verbose,
            )
        )
    return callbacks


def _learn(
    team: Team, config: RunConfig, options: TrainOptions, folder: Path, record: RunRecord, callbacks: list[BaseCallback]
) -> TrainResult:
    env = team.get_env()
    assert env is not None
    status = "finished"
    try:
        team.learn(
            config.n_timesteps,
            callback=callbacks or None,
            progress_bar=options.progress,
            # A team that continues its training continues counting its steps
            reset_num_timesteps=options.trained_agent is None,
        )
    except KeyboardInterrupt:
        status = "interrupted"
    finally:
        # A run that fails has come so far, too
        record.content["timesteps"] = team.num_timesteps
    team.save(folder / TEAM)
    record.finish(status, environment=environment_versions(config.env_id, env))
    if options.verbose or status == "interrupted":
        print(f"{status.capitalize()} after {team.num_timesteps} joint steps. Saved: {folder / TEAM}")
    return TrainResult(folder, team, status == "finished")
