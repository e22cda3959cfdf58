"""Cross-play: agents of each run among the agents of each other run, before and after they have observed them."""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from sb3_belief.common.durable_files import make_folder
from sb3_belief.report.adaptation import write_rows
from sb3_belief.report.crossplay import CROSSPLAY, MATRIX, crossplay_cells, crossplay_figures, crossplay_sentences
from sb3_belief.report.figures.drawing import check_drawing
from sb3_belief.report.page.files import remove_figures, write_figure
from sb3_belief.study.meetings import Among, Meeting, Play
from sb3_belief.zoo.errors import ConfigError, reason_of, short, unknown_setting
from sb3_belief.zoo.preflight import check_device, check_folder
from sb3_belief.zoo.replay import ShownEnvironment, ShownTeam, environment_of, load_into, make_shown_env
from sb3_belief.zoo.run_folder import find_team

_COMMAND = "crossplay"
# In what runs of one environment with the same arguments may still differ
_COMPARED = ("partners", "visibility", "env_wrapper", "observations besides (observe_last, memory_span)", "adapters")
#: Steps that an agent observes of those it meets
OBSERVED_STEPS = 800


@dataclass(frozen=True)
class CrossplayOptions(ShownTeam):
    """
    Options of cross-play. ``run`` is unused: the runs are ``runs``.

    :param runs: Folders of runs, or zips of teams, at least two
    :param output: Folder to write into
    :param agent: The agent that meets the others; None for each in turn
    :param steps: How many steps it observes of them; 0 to measure only what it does before
    :param play: How
    """

    runs: tuple[str, ...] = ()
    output: str = "crossplay"
    agent: str | None = None
    steps: int = OBSERVED_STEPS
    play: Play = field(default_factory=Play)


def crossplay(options: CrossplayOptions) -> tuple[Path, str]:
    """
    Measure cross-play, and write what was found.

    :param options: The options
    :return: The folder that was written, and what was found, in a paragraph
    :raises ConfigError: If something does not fit; nothing is written then
    """
    check_drawing()
    check_device(options.device)
    paths = [find_team(run, _COMMAND) for run in options.runs]
    if len({path.resolve() for path in paths}) < 2:
        raise ConfigError(f"{_COMMAND}: one team cannot meet another: give at least two runs.")
    if len({path.resolve() for path in paths}) < len(paths):
        raise ConfigError(f"{_COMMAND}: a run is given twice: give each once.")
    shown = _common_environment(paths, options)
    output = Path(options.output)
    check_folder(output, "-o")
    play = options.play
    rows: list[dict[str, Any]] = []
    with (
        closing(make_shown_env(shown, options, play.n_envs, play.seed, _COMMAND)) as env,
        closing(make_shown_env(shown, options, 1, play.seed, _COMMAND)) as observed_env,
    ):
        teams = [load_into(path, env, options, _COMMAND) for path in paths]
        agents = teams[0].possible_agents
        if len(agents) < 2:
            raise ConfigError(f"{_COMMAND}: {shown.env_id} has one agent only, {agents[0]!r}, so there are no others to meet.")
        if options.agent is not None and options.agent not in agents:
            raise unknown_setting("--agent", "agent", options.agent, agents)
        chosen = agents if options.agent is None else [options.agent]
        for name, team in zip(_names(options.runs), teams, strict=True):
            for other, others in zip(_names(options.runs), teams, strict=True):
                for agent in chosen:
                    meeting = Meeting(team, [agent], Among(team, agent, others), env, observed_env)
                    # Of who remembers nothing of earlier episodes nothing can change
                    steps = (0, options.steps) if meeting.can_adapt and options.steps else (0,)
                    rows += _measured(meeting, steps, play, shown.env_id, name, other)
            print(f"{name}: met {len(teams)} teams", flush=True)
    if len({row["steps"] for row in rows}) > 1:
        # Where some have a history and others none, these are afterwards as they were before
        rows = _completed(rows, options.steps)
    try:
        make_folder(output)
        # Not beside those of an earlier measurement after other numbers of steps
        remove_figures(output, "crossplay-*")
        write_rows(rows, output / CROSSPLAY)
        cells = [
            {"run": run, "others": others, "steps": steps, "return": of.value, "return_low": of.low, "return_high": of.high}
            for run, others, steps, of in crossplay_cells(rows)
        ]
        write_rows(cells, output / MATRIX)
        for name, (_, spec) in crossplay_figures(rows).items():
            write_figure(spec, output / f"{name}.svg", output / f"{name}.png")
    except OSError as error:
        raise ConfigError(f"-o: cannot write into {short(str(output))} ({reason_of(error)}).") from None
    return output, crossplay_sentences(rows)


def _common_environment(paths: Sequence[Path], options: CrossplayOptions) -> ShownEnvironment:
    first, *rest = [environment_of(path, replace(options, run=str(path)), _COMMAND) for path in paths]
    for path, shown in zip(paths[1:], rest, strict=True):
        if shown.env_id != first.env_id:
            raise ConfigError(
                f"{_COMMAND}: {str(paths[0])!r} is of {first.env_id}, {str(path)!r} of {shown.env_id}: give runs of one"
                " environment."
            )
        differing = [
            name
            for name in {**first.env_kwargs, **shown.env_kwargs}
            if first.env_kwargs.get(name) != shown.env_kwargs.get(name)
        ]
        if differing:
            raise ConfigError(
                f"{_COMMAND}: {str(paths[0])!r} and {str(path)!r} have other arguments of {first.env_id}: {differing}. Say by"
                " --env-kwargs which hold for all."
            )
        for what, one, other in zip(_COMPARED, _compared(first), _compared(shown), strict=True):
            if one != other:
                raise ConfigError(
                    f"{_COMMAND}: {str(paths[0])!r} and {str(path)!r} were trained with other {what}, so there is no"
                    " environment in which both can play: give runs that have the same."
                )
    return first


def _compared(shown: ShownEnvironment) -> tuple[Any, ...]:
    """Return what must be the same for agents of two runs to meet, as of ``_COMPARED``."""
    partners = shown.partners
    acting = None if partners is None else (partners.learners, partners.deterministic, vars(partners.pool))
    functions = (shown.visibility, shown.wrapper, shown.adapter)
    # Partial functions are equal only to themselves
    visibility, wrapper, adapter = ((f.func, f.keywords) if isinstance(f, partial) else f for f in functions)
    return acting, visibility, wrapper, shown.observation, adapter


def _measured(meeting: Meeting, steps: Sequence[int], play: Play, env_id: str, run: str, others: str) -> list[dict[str, Any]]:
    rows = []
    for repetition in range(play.repetitions):
        for observed, found in meeting.adapt(steps, play, repetition).items():
            common = {"environment": env_id, "run": run, "others": others, "agent": meeting.agents[0]}
            rows.append({**common, "steps": observed, "repetition": repetition, **found.columns()})
    return rows


def _completed(rows: list[dict[str, Any]], steps: int) -> list[dict[str, Any]]:
    def key(row: dict[str, Any]) -> tuple[Any, ...]:
        return row["run"], row["others"], row["agent"], row["repetition"]

    measured = {key(row) for row in rows if row["steps"] == steps}
    return rows + [{**row, "steps": steps} for row in rows if row["steps"] == 0 and key(row) not in measured]


def _names(runs: Sequence[str]) -> list[str]:
    """Return what runs are called: by their folders, or as they were given where two have one name."""
    names = [Path(run).resolve().name for run in runs]
    return [name if names.count(name) == 1 else run for name, run in zip(names, runs, strict=True)]
