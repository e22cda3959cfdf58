"""One configuration, trained in a folder of its own."""

import sys
import warnings
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from sb3_contrib.common.maskable.callbacks import MaskableEvalCallback
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback

from sb3_belief.team import Team, TeamVecEnv, make_team_env
from sb3_belief.zoo.config import RunConfig
from sb3_belief.zoo.errors import ConfigError
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

# Evaluation copies get seeds far from those of the training copies
EVAL_SEED_OFFSET = 1_000_000


@dataclass(frozen=True)
class TrainOptions:
    """
    What a run does besides learning.

    :param seed: of the team and its environments; None: drawn, and written down
    :param log_folder: folder of all runs
    :param tensorboard_log: folder for TensorBoard, None for none
    :param eval_freq: evaluate every that many joint steps, -1 for never
    :param eval_episodes: episodes of an evaluation
    :param n_eval_envs: environment copies of an evaluation
    :param save_freq: save the team every that many joint steps, -1 for never
    :param vec_env: ``"dummy"`` or ``"subproc"``
    :param device: ``"auto"``, ``"cpu"``, ``"cuda"``, ...
    :param num_threads: threads of torch, -1 for torch's own choice
    :param jobs: processes that update the agents at once, see ``Team``
    :param progress: whether to show a progress bar
    :param trained_agent: a run's folder or a team's zip to go on from
    :param verbose: 0 for silence, 1 for tables
    :param command: the words of the command line, to be written down
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
    verbose: int = 1
    command: list[str] = field(default_factory=lambda: list(sys.argv))


@dataclass(frozen=True)
class TrainResult:
    """
    :param folder: the run's folder
    :param team: the trained team
    :param finished: False if it was interrupted
    """

    folder: Path
    team: Team
    finished: bool


def train(config: RunConfig, options: TrainOptions) -> TrainResult:
    """
    Train a team; all it writes goes to a new folder ``<log_folder>/<algo>/<env>_<k>/``. Ctrl-C ends the training and saves.

    :param config: what to train, checked
    :param options: what to do besides
    :return: the folder and the team
    :raises ConfigError: if the environment or the algorithm refuses its settings; nothing has been written then
    """
    trained = None if options.trained_agent is None else find_team(options.trained_agent, "--trained-agent")
    seed = int(np.random.SeedSequence().generate_state(1)[0] % 2**31) if options.seed is None else options.seed
    if options.num_threads > 0:
        th.set_num_threads(options.num_threads)

    with ExitStack() as stack:
        env = make_env(config, config.n_envs, seed, options.vec_env)
        stack.callback(env.close)
        eval_env = None
        if options.eval_freq > 0:
            eval_env = make_env(config, options.n_eval_envs, seed + EVAL_SEED_OFFSET, "dummy")
            stack.callback(eval_env.close)
        # the team's logs go into the folder, so it must be there first; if the team is refused nothing stays behind
        folder = make_run_folder(options.log_folder, config.algo, config.env_id)
        try:
            team = make_team(config, options, env, seed, trained, folder)
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
            trained_agent=None if trained is None else str(trained),
            vec_env=options.vec_env,
            device=str(options.device),
            num_threads=th.get_num_threads(),
            jobs=options.jobs,
        )
        env.start_monitor(str(folder))
        if options.verbose:
            print(f"Run folder: {folder}  (seed {seed})")
        return _learn(team, config, options, folder, record, _callbacks(team, config, options, folder, eval_env))


def make_env(config: RunConfig, n_envs: int, seed: int, vec_env: str = "dummy") -> TeamVecEnv:
    """
    :param config: configuration
    :param n_envs: number of copies
    :param seed: copy i gets ``seed + i``
    :param vec_env: ``"dummy"`` or ``"subproc"``
    :return: the team's environment
    :raises ConfigError: if it refuses its settings
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
    except (ValueError, TypeError, ImportError) as error:
        raise ConfigError(f"{config.source}: {config.env_id} refuses its settings: {error}") from error


def make_team(
    config: RunConfig,
    options: TrainOptions,
    env: TeamVecEnv,
    seed: int,
    trained: Path | None = None,
    folder: Path | None = None,
) -> Team:
    """
    :param config: configuration
    :param options: device, tables, TensorBoard folder and jobs are taken from them
    :param env: what the team learns in
    :param seed: of the team
    :param trained: a saved team to load instead of making a new one
    :param folder: where its CSV logs go, None for no logs
    :return: the team
    :raises ConfigError: if the algorithm refuses its settings or the environment
    """
    common: dict[str, Any] = dict(
        device=options.device,
        tensorboard_log=options.tensorboard_log
        and str(Path(options.tensorboard_log, config.algo, folder_name(config.env_id))),
        verbose=options.verbose,
        log_dir=None if folder is None else str(folder),
        jobs=options.jobs,
    )
    try:
        if trained is not None:
            return _load_team(config, trained, env, seed, common)
        return Team(
            config.algo_class, config.policy, env, seed=seed, normalize=config.normalize, **common, **config.algo_kwargs
        )
    # SB3 checks action spaces and batch sizes by assertions
    except (ValueError, TypeError, AssertionError) as error:
        raise ConfigError(f"{config.source}: {config.algo} cannot be set up on {config.env_id}: {error}") from error


def _load_team(config: RunConfig, trained: Path, env: TeamVecEnv, seed: int, common: dict[str, Any]) -> Team:
    team = Team.load(trained, env=env, **common)
    for agent, model in team.agents.items():
        if type(model) is not config.algo_class:
            raise ValueError(f"{agent!r} in {str(trained)!r} is a {type(model).__name__}, not a {config.algo_class.__name__}")
    # Loading seeds the environment as in the run before: going on is not to meet the same episodes again
    env.seed(seed)
    return team


def _callbacks(
    team: Team, config: RunConfig, options: TrainOptions, folder: Path, eval_env: TeamVecEnv | None
) -> list[BaseCallback]:
    callbacks: list[BaseCallback] = [callback(**kwargs) for callback, kwargs in config.callbacks]
    # SB3's callbacks count calls, which come once per step of all the copies together
    if options.save_freq > 0:
        every = max(options.save_freq // config.n_envs, 1)
        callbacks.append(CheckpointCallback(every, str(folder / CHECKPOINTS), name_prefix="team", verbose=options.verbose))
    if eval_env is not None:
        # Training in worker processes, evaluation in this one: intended
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
    status = "failed"
    try:
        team.learn(
            config.n_timesteps,
            callback=callbacks or None,
            progress_bar=options.progress,
            # a team that goes on keeps counting its steps
            reset_num_timesteps=options.trained_agent is None,
        )
        status = "finished"
    except KeyboardInterrupt:
        status = "interrupted"
    finally:
        if status != "failed":
            team.save(folder / TEAM)
        told = {"environment": environment_versions(config.env_id, env)} if status != "failed" else {}
        record.finish(status, timesteps=team.num_timesteps, **told)
    if options.verbose or status == "interrupted":
        print(f"{status.capitalize()} after {team.num_timesteps} joint steps. Saved: {folder / TEAM}")
    return TrainResult(folder, team, status == "finished")
