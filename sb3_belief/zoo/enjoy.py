"""Replay of a trained team, in a window or as a GIF or MP4 file."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sb3_belief.envs.registry import make_parallel_env, spec
from sb3_belief.team import Team, TeamVecEnv, make_team_env
from sb3_belief.zoo.checks import accepted_arguments
from sb3_belief.zoo.config import RunConfig, load_config
from sb3_belief.zoo.errors import ConfigError
from sb3_belief.zoo.evaluate import Outcome
from sb3_belief.zoo.run_folder import find_team, run_of

VIDEO_FORMATS = (".gif", ".mp4")


@dataclass(frozen=True)
class EnjoyOptions:
    """
    Options of a replay.

    :param run: Folder of a run, or zip of a team in it
    :param episodes: Number of episodes to play
    :param n_timesteps: Number of steps to play instead, or None
    :param deterministic: Whether the agents act greedily. Otherwise they sample their actions
    :param seed: Seed of the environment
    :param output: Path of a ``.gif`` or ``.mp4`` file, or None for a window
    :param fps: Frames per second of the file, or None for the environment's own rate
    :param env_kwargs: ``key:value`` pairs of arguments of the environment, which override those of the run
    :param extra_packages: See ``names.resolve``
    :param device: Device of all models: ``"auto"``, ``"cpu"``, ``"cuda"``, ...
    """

    run: str
    episodes: int = 1
    n_timesteps: int | None = None
    deterministic: bool = True
    seed: int = 0
    output: str | None = None
    fps: int | None = None
    env_kwargs: tuple[str, ...] = ()
    extra_packages: tuple[str, ...] = ()
    device: str = "auto"


def enjoy(options: EnjoyOptions) -> Outcome:
    """
    Replay a trained team and print its returns and successes.

    :param options: Options of the replay
    :return: Returns and successes of the finished episodes
    :raises ConfigError: If there is no such team, or it cannot be shown in the way that the options ask for
    """
    if options.output is not None and Path(options.output).suffix.lower() not in VIDEO_FORMATS:
        raise ConfigError(f"--output: {options.output!r} must end in {' or '.join(VIDEO_FORMATS)}.")
    path = find_team(options.run, "enjoy")
    config, frame_rate = _config_of(path, options)
    env = _make_team_env(config, options)
    try:
        team = Team.load(path, env=env, device=options.device)
        # This comes after loading, which seeds the environment as in the training
        env.seed(options.seed)
        frames: list[np.ndarray] | None = None if options.output is None else []
        outcome = _play(team, env, options, frames)
        if options.output is not None and frames:
            write_video(Path(options.output), frames, options.fps or frame_rate)
            print(f"Wrote {len(frames)} frames to {options.output}")
    finally:
        env.close()
    _print_summary(outcome)
    return outcome


def write_video(path: Path, frames: list[np.ndarray], fps: int) -> None:
    """
    Write frames to a video file.

    :param path: ``.gif`` or ``.mp4`` file. Its folder is created if necessary
    :param frames: Images, uint8 ``[height, width, 3]``
    :param fps: Frames per second
    :raises ConfigError: If imageio is not installed
    """
    try:
        import imageio.v2 as imageio
    except ImportError as error:
        raise ConfigError(f"Writing {path.name} needs imageio: pip install 'sb3-belief[plots]'.") from error
    path.parent.mkdir(parents=True, exist_ok=True)
    # imageio takes the duration of a frame in milliseconds for a GIF, and a frame rate for an MP4
    if path.suffix.lower() == ".gif":
        imageio.mimsave(path, frames, duration=1000 / fps, loop=0)  # type: ignore[arg-type]
    else:
        imageio.mimsave(path, frames, fps=fps, macro_block_size=2)  # type: ignore[arg-type]


def _config_of(team: Path, options: EnjoyOptions) -> tuple[RunConfig, int]:
    """
    Return the configuration for the replay and the environment's frame rate.

    :return: Configuration of the run, with a render mode if the environment has images, and frames per second
    """
    run = run_of(team)
    if run is None:
        raise ConfigError(
            f"enjoy: {str(team)!r} is not in the folder of a run (no config.yml and run.json), so its environment is unknown."
        )
    algo, env_id, conf_file = run
    config = load_config(algo, env_id, str(conf_file), env_kwargs=options.env_kwargs, extra_packages=options.extra_packages)
    render_mode = "human" if options.output is None else "rgb_array"
    # SB3's vectorised environments do not pass on the metadata, so it is read from a single copy
    env = _make_single_env(config)
    arguments, open_ended = accepted_arguments(spec(config.env_id).load())
    # An environment may render and still be made by a callable that does not take a render mode
    has_images = render_mode in env.metadata.get("render_modes", []) and (open_ended or "render_mode" in arguments)
    frame_rate = int(env.metadata.get("render_fps", 10))
    env.close()
    if has_images:
        return replace(config, env_kwargs={**config.env_kwargs, "render_mode": render_mode}), frame_rate
    if options.output is not None:
        raise ConfigError(f"enjoy: {config.env_id} has no images to write to {options.output!r}; leave out --output.")
    return config, frame_rate


def _make_single_env(config: RunConfig) -> Any:
    with _refusals_as_config_errors(config):
        return make_parallel_env(config.env_id, **config.env_kwargs)


def _make_team_env(config: RunConfig, options: EnjoyOptions) -> TeamVecEnv:
    with _refusals_as_config_errors(config):
        return make_team_env(config.env_id, seed=options.seed, env_kwargs=config.env_kwargs, wrapper=config.wrapper)


@contextmanager
def _refusals_as_config_errors(config: RunConfig) -> Iterator[None]:
    try:
        yield
    except (ValueError, TypeError, ImportError) as error:
        raise ConfigError(f"enjoy: {config.env_id} refuses its settings: {error}") from error


def _play(team: Team, env: TeamVecEnv, options: EnjoyOptions, frames: list[np.ndarray] | None) -> Outcome:
    returns: list[float] = []
    successes: list[bool] = []
    steps = 0
    state: Any = None
    episode_start = np.ones(1, dtype=bool)
    try:
        obs = env.reset()
        while len(returns) < options.episodes if options.n_timesteps is None else steps < options.n_timesteps:
            if frames is not None:
                frames.append(np.asarray(env.render(mode="rgb_array")))
            actions, state = team.predict(obs, state, episode_start, options.deterministic, action_masks=env.action_masks())
            obs, _, dones, infos = env.step(actions)
            steps += 1
            episode_start = dones
            if dones[0]:
                returns.append(infos[0]["episode"]["r"])
                if "is_success" in infos[0]:
                    successes.append(bool(infos[0]["is_success"]))
                success = f"  {'success' if successes[-1] else 'no success'}" if "is_success" in infos[0] else ""
                print(f"Episode {len(returns)}: return {returns[-1]:.3f}, {infos[0]['episode']['l']} steps{success}")
    except KeyboardInterrupt:
        print("Interrupted.")
    except RuntimeError as error:
        if options.output is not None:
            raise
        # pygame raises a RuntimeError where there is no screen
        raise ConfigError(f"enjoy: cannot open a window ({error}). Write a file instead: --output episode.gif") from error
    return Outcome(np.array(returns, dtype=float), np.array(successes, dtype=bool))


def _print_summary(outcome: Outcome) -> None:
    if outcome.returns.size == 0:
        print("No episode ended.")
        return
    print(f"Mean return over {outcome.returns.size} episodes: {outcome.returns.mean():.3f} (std {outcome.returns.std():.3f})")
    if outcome.success_rate is not None:
        print(f"Success rate: {outcome.success_rate:.3f}")
