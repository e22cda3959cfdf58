"""The belief viewer of a trained team: an episode is recorded, written as a page and opened in the browser."""

import webbrowser
from dataclasses import dataclass
from pathlib import Path

from sb3_belief.report.frames import NoPictureError
from sb3_belief.report.recording import Recording, record_episodes
from sb3_belief.report.viewer.page import write_viewer
from sb3_belief.team import Team, TeamVecEnv
from sb3_belief.zoo.errors import ConfigError, unknown_setting
from sb3_belief.zoo.preflight import check_device, check_output
from sb3_belief.zoo.replay import ShownTeam, environment_of, render_modes_of, team_in_its_environment, with_mode
from sb3_belief.zoo.run_folder import RECORD, VIEWER, find_team

#: Name of the page in the folder of a run
# Data of a longer recording would make a page that browsers open slowly
MOST_EPISODES = 20


@dataclass(frozen=True)
class WatchOptions(ShownTeam):
    """
    Options of the viewer, besides the team.

    :param episodes: Number of episodes to record
    :param deterministic: Whether the agents act greedily. Otherwise they sample their actions
    :param seed: Seed of the environment, and of what the agents sample
    :param agent: Name of the agent that the page shows at first. None for the first one that has a belief
    :param output: Path of the page, or None for ``viewer.html`` in the run's folder, or beside the zip
    :param opens: Whether to open the page in the browser
    """

    episodes: int = 1
    deterministic: bool = True
    seed: int = 0
    agent: str | None = None
    output: str | None = None
    opens: bool = True


def watch(options: WatchOptions) -> Path:
    """
    Record episodes of a trained team, and write and open the viewer's page.

    :param options: The options
    :return: Path of the page
    :raises ConfigError: If there is no such team or agent, its environment has no pictures, or the page cannot be written
    """
    if options.output is not None and Path(options.output).suffix.lower() not in (".html", ".htm"):
        raise ConfigError(f"--output: {options.output!r} must end in .html.")
    if options.episodes > MOST_EPISODES:
        raise ConfigError(f"--episodes: {options.episodes} are too many for one page: at most {MOST_EPISODES}.")
    check_device(options.device)
    path = find_team(options.run, "watch")
    output = Path(options.output or _folder_of(path) / VIEWER)
    check_output(str(output), "--output")
    shown, modes = render_modes_of(environment_of(path, options, "watch"), "watch")
    if "rgb_array" not in modes:
        raise ConfigError(f"watch: {shown.env_id} has no render mode 'rgb_array', whose pictures the viewer shows.")
    with team_in_its_environment(path, with_mode(shown, "rgb_array"), options, options.seed, "watch") as (team, env):
        agents = list(team.agents)
        if options.agent is not None and options.agent not in agents:
            raise unknown_setting("--agent", "agent", options.agent, agents)
        recording = _recorded(team, env, options)
    manner = "greedy" if options.deterministic else "sampled"
    steps = "one timestep" if team.num_timesteps == 1 else f"{team.num_timesteps:,} joint steps"
    subtitle = f"{path.resolve().parent.name}/{path.name} · trained for {steps} · seed {options.seed}, {manner}"
    write_viewer(recording, output, shown.env_id, subtitle, options.agent)
    print(f"Wrote {output} ({output.stat().st_size / 1e6:.1f} MB)")
    if options.opens and not webbrowser.open(output.resolve().as_uri()):
        print("No browser was found: open the file in one.")
    return output


def _folder_of(team: Path) -> Path:
    # A checkpoint lies one folder deeper than the final team
    folders = list(team.parents)[:2]
    return next((folder for folder in folders if (folder / RECORD).is_file()), team.parent)


def _recorded(team: Team, env: TeamVecEnv, options: WatchOptions) -> Recording:
    try:
        recording = record_episodes(team, env, options.episodes, options.deterministic)
    except NoPictureError as error:
        raise ConfigError(f"watch: {error}") from error
    for number, episode in enumerate(recording.episodes, start=1):
        success = "" if episode.success is None else f"  {'success' if episode.success else 'no success'}"
        cut = "" if episode.finished else " (not to its end: that is as much as a page shows)"
        print(f"Episode {number}: return {episode.team_return:.3f}, {len(episode.moments)} steps{success}{cut}")
    return recording
