"""Replay of a trained team, in a window or as a GIF or MP4 file."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sb3_belief.common.safe_files.trust import Trust
from sb3_belief.envs.registry import make_parallel_env, spec
from sb3_belief.team import Team, TeamVecEnv, make_team_env
from sb3_belief.zoo.checks import Location, accepted_arguments, check_call
from sb3_belief.zoo.config import load_config
from sb3_belief.zoo.errors import ConfigError, cause
from sb3_belief.zoo.evaluate import Outcome
from sb3_belief.zoo.names import get_env, load_env
from sb3_belief.zoo.preflight import check_device, check_output
from sb3_belief.zoo.run_folder import CONFIG, RECORD, check_record, find_team, run_of
from sb3_belief.zoo.yaml_data import parse_pairs

# Least side of a picture in pixels, as far as whole factors allow it
_SIDE = 480
VIDEO_FORMATS = (".gif", ".mp4")


@dataclass(frozen=True)
class EnjoyOptions:
    """
    Options of a replay.

    :param run: Folder of a run, or zip of a team
    :param env: Id of the environment, for the zip of a team that is not in the folder of a run. None for that of the run
    :param episodes: Number of episodes to play
    :param n_timesteps: Number of steps to play instead, or None
    :param deterministic: Whether the agents act greedily. Otherwise they sample their actions
    :param seed: Seed of the environment
    :param output: Path of a ``.gif`` or ``.mp4`` file, or None for a window
    :param fps: Frames per second of the file, or None for the environment's own rate
    :param env_kwargs: ``key:value`` pairs of arguments of the environment, which override those of the run
    :param extra_packages: See ``names.resolve`` and ``Team.load`` (``allow_packages``)
    :param trust: Whether to load the team, and what its run's folder names, even if that could run any code
    :param device: Device of all models: ``"auto"``, ``"cpu"``, ``"cuda"``, ...
    """

    run: str
    env: str | None = None
    episodes: int = 1
    n_timesteps: int | None = None
    deterministic: bool = True
    seed: int = 0
    output: str | None = None
    fps: int | None = None
    env_kwargs: tuple[str, ...] = ()
    extra_packages: tuple[str, ...] = ()
    trust: bool = False
    device: str = "auto"


def enjoy(options: EnjoyOptions) -> Outcome:
    """
    Replay a trained team and print its returns and successes.

    :param options: Options of the replay
    :return: Returns and successes of the finished episodes
    :raises ConfigError: If there is no such team, or it cannot be shown in the way that the options ask for
    """
    if options.output is not None:
        if Path(options.output).suffix.lower() not in VIDEO_FORMATS:
            raise ConfigError(f"--output: {options.output!r} must end in {' or '.join(VIDEO_FORMATS)}.")
        check_output(options.output, "--output")
    check_device(options.device)
    path = find_team(options.run, "enjoy")
    shown = _environment_of(path, options)
    shown = _with_render_mode(shown, options)
    with _refusals_as_config_errors(shown):
        env = make_team_env(shown.env_id, seed=options.seed, env_kwargs=shown.env_kwargs, wrapper=shown.wrapper)
    try:
        team = _load_team(path, env, options)
        # This comes after loading, which seeds the environment as in the training
        env.seed(options.seed)
        frames: list[np.ndarray] | None = None if options.output is None else []
        outcome = _play(team, env, options, frames)
        if options.output is not None and frames:
            write_video(Path(options.output), frames, options.fps or shown.frame_rate)
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


@dataclass(frozen=True)
class _Shown:
    """
    The environment of a replay.

    :param env_id: Its id
    :param env_kwargs: Its arguments
    :param wrapper: Argument of ``make_team_env``
    :param frame_rate: Frames per second
    """

    env_id: str
    env_kwargs: dict[str, Any]
    wrapper: Callable[[Any], Any] | None
    frame_rate: int = 10


def _environment_of(team: Path, options: EnjoyOptions) -> _Shown:
    packages = options.extra_packages
    if options.env is not None:
        make_env = load_env(options.env, "--env", packages)
        given, n_leading = parse_pairs(options.env_kwargs, "--env-kwargs"), len(get_env(options.env, "--env").leading)
        return _Shown(
            options.env, check_call(make_env, given, Location("--env-kwargs", packages), skip=n_leading, of_env=True), None
        )
    run = run_of(team)
    if run is None:
        raise ConfigError(
            f"enjoy: {str(team)!r} is not in the folder of a run (no {CONFIG} and {RECORD}), so its environment is unknown:"
            " name it with --env, and its arguments with --env-kwargs."
        )
    algo, env_id, conf_file = run
    check_record(run, packages, trust=options.trust)
    folder = None if options.trust else conf_file.parent
    config = load_config(
        algo, env_id, str(conf_file), env_kwargs=options.env_kwargs, extra_packages=packages, run_folder=folder
    )
    return _Shown(config.env_id, config.env_kwargs, config.wrapper)


def _with_render_mode(shown: _Shown, options: EnjoyOptions) -> _Shown:
    """Add a render mode, if the environment has one for what is asked, and its frame rate."""
    # SB3's vectorised environments do not pass on the metadata, so it is read from a single copy
    with _refusals_as_config_errors(shown):
        env = make_parallel_env(shown.env_id, **shown.env_kwargs)
    arguments, open_ended = accepted_arguments(spec(shown.env_id).load())
    # An environment may render and still be made by a callable that does not take a render mode
    takes_mode = open_ended or "render_mode" in arguments
    modes = list(env.metadata.get("render_modes", [])) if takes_mode else []
    shown = replace(shown, frame_rate=int(env.metadata.get("render_fps", 10)))
    env.close()
    wanted = "human" if options.output is None else "rgb_array"
    if wanted in modes:
        return replace(shown, env_kwargs={**shown.env_kwargs, "render_mode": wanted})
    if options.output is not None:
        raise ConfigError(f"enjoy: {shown.env_id} has no images to write to {options.output!r}; leave out --output.")
    instead = " Write a file instead: --output episode.gif" if "rgb_array" in modes else ""
    print(f"Nothing is shown: {shown.env_id} has no render mode 'human'.{instead}")
    return shown


def _load_team(path: Path, env: TeamVecEnv, options: EnjoyOptions) -> Team:
    try:
        trust = Trust.of(options.trust, options.extra_packages)
        return Team.load(path, env=env, device=options.device, **trust._asdict())
    # A damaged file makes zipfile, pickle and torch raise whatever they raise
    except Exception as error:
        raise ConfigError(f"enjoy: {str(path)!r} cannot be loaded: {cause(error)}") from error


@contextmanager
def _refusals_as_config_errors(shown: _Shown) -> Iterator[None]:
    try:
        yield
    # An environment of the user's own may raise anything
    except Exception as error:
        raise ConfigError(f"enjoy: {shown.env_id} refuses its settings: {cause(error)}") from error


def _play(team: Team, env: TeamVecEnv, options: EnjoyOptions, frames: list[np.ndarray] | None) -> Outcome:
    returns: list[float] = []
    successes: list[bool] = []
    steps = 0
    state: Any = None
    episode_start = np.ones(1, dtype=bool)
    try:
        obs = env.reset()
        if frames is None:
            _warn_if_hidden()
        while len(returns) < options.episodes if options.n_timesteps is None else steps < options.n_timesteps:
            if frames is not None:
                frames.append(_frame(env))
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
    except Exception as error:
        if options.output is not None or not _is_of_window(error):
            raise
        raise ConfigError(f"enjoy: cannot open a window ({error}). Write a file instead: --output episode.gif") from error
    return Outcome(np.array(returns, dtype=float), np.array(successes, dtype=bool))


def _is_of_window(error: Exception) -> bool:
    # Where there is no screen, pygame raises a RuntimeError, and pyglet errors of its own
    return isinstance(error, RuntimeError) or type(error).__module__.partition(".")[0] == "pyglet"


def _frame(env: TeamVecEnv) -> np.ndarray:
    image = env.get_images()[0]
    frame = None if image is None else np.asarray(image)
    if frame is None or frame.ndim != 3 or frame.shape[2] not in (3, 4):
        found = type(image).__name__ if frame is None else f"an array of shape {frame.shape}"
        raise ConfigError(f"enjoy: the environment's render() returned {found}, not an image [height, width, 3].")
    # Small pictures, such as those of grids with a pixel a cell, are enlarged by a whole number, which keeps their edges
    factor = max(1, _SIDE // max(frame.shape[:2]))
    return frame[..., :3].astype(np.uint8).repeat(factor, axis=0).repeat(factor, axis=1)


def _warn_if_hidden() -> None:
    """Say so if pygame has opened its window on no screen: SDL then draws in memory, and raises no error."""
    pygame = sys.modules.get("pygame")
    if pygame is not None and pygame.display.get_init() and pygame.display.get_driver() in ("offscreen", "dummy"):
        print("Nothing is shown: there is no display. Write a file instead: --output episode.gif")


def _print_summary(outcome: Outcome) -> None:
    if outcome.returns.size == 0:
        print("No episode ended.")
        return
    if outcome.returns.size > 1:
        mean, std = outcome.returns.mean(), outcome.returns.std()
        print(f"Mean return over {outcome.returns.size} episodes: {mean:.3f} (std {std:.3f})")
    if outcome.success_rate is not None:
        print(f"Success rate: {outcome.success_rate:.3f}")
