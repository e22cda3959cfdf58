"""Replay of a trained team, in a window or as a GIF or MP4 file."""

import sys
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sb3_belief.report.frames import NoPictureError, frame_of
from sb3_belief.team import Team, TeamVecEnv, observing
from sb3_belief.zoo.errors import ConfigError
from sb3_belief.zoo.evaluate import Outcome
from sb3_belief.zoo.preflight import check_device, check_output
from sb3_belief.zoo.replay import (
    ShownEnvironment,
    ShownTeam,
    environment_of,
    render_modes_of,
    team_in_its_environment,
    with_mode,
)
from sb3_belief.zoo.run_folder import find_team

VIDEO_FORMATS = (".gif", ".mp4")


@dataclass(frozen=True)
class EnjoyOptions(ShownTeam):
    """
    Options of a replay, besides the team.

    :param episodes: Number of episodes to play
    :param n_timesteps: Number of steps to play instead, or None
    :param deterministic: Whether the agents act greedily. Otherwise they sample their actions
    :param seed: Seed of the environment, and of what the agents sample
    :param output: Path of a ``.gif`` or ``.mp4`` file, or None for a window
    :param fps: Frames per second of the file, or None for the environment's own rate
    :param observe: Whether the agents observe, so that their beliefs adapt to those whom they meet here
    """

    episodes: int = 1
    n_timesteps: int | None = None
    deterministic: bool = True
    seed: int = 0
    output: str | None = None
    fps: int | None = None
    observe: bool = False


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
    shown = _with_render_mode(environment_of(path, options, "enjoy"), options)
    with team_in_its_environment(path, shown, options, options.seed, "enjoy") as (team, env), ExitStack() as stack:
        frames: list[np.ndarray] | None = None if options.output is None else []
        played: Any = env
        if options.observe:
            try:
                played = stack.enter_context(observing(team, env))
            except ValueError as error:
                raise ConfigError(f"--observe: {error}") from error
        outcome = _play(team, played, options, frames)
        if options.observe:
            print("Observed steps: " + ", ".join(f"{agent} {n}" for agent, n in played.steps.items()))
        if options.output is not None and frames:
            write_video(Path(options.output), frames, options.fps or shown.frame_rate)
            print(f"Wrote {len(frames)} frames to {options.output}")
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


def _with_render_mode(shown: ShownEnvironment, options: EnjoyOptions) -> ShownEnvironment:
    """Add a render mode, if the environment has one for what is asked, and its frame rate."""
    shown, modes = render_modes_of(shown, "enjoy")
    wanted = "human" if options.output is None else "rgb_array"
    if wanted in modes:
        return with_mode(shown, wanted)
    if options.output is not None:
        raise ConfigError(f"enjoy: {shown.env_id} has no images to write to {options.output!r}; leave out --output.")
    instead = " Write a file instead: --output episode.gif" if "rgb_array" in modes else ""
    print(f"Nothing is shown: {shown.env_id} has no render mode 'human'.{instead}")
    return shown


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
                beside = f"  beside {infos[0]['partner']}" if isinstance(infos[0].get("partner"), str) else ""
                print(f"Episode {len(returns)}: return {returns[-1]:.3f}, {infos[0]['episode']['l']} steps{success}{beside}")
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
    try:
        return frame_of(env)
    except NoPictureError as error:
        raise ConfigError(f"enjoy: {error}") from error


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
