"""The measure of adapting: how well a trained team does beside partners it has not met, the longer it observes them."""

import math
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from sb3_belief.common.durable_files import make_folder
from sb3_belief.common.safe_files.trust import Trust
from sb3_belief.envs.registry import spec
from sb3_belief.report.adaptation import (
    ADAPTATION,
    BLIND,
    CURVE,
    NUMBERS,
    ORACLE,
    TEAM,
    TEXTS,
    adaptation_figure,
    adaptation_points,
    adaptation_sentences,
    write_rows,
)
from sb3_belief.report.figures.drawing import check_drawing
from sb3_belief.report.page.files import remove_figures, write_figure
from sb3_belief.study.meetings import Among, Meeting, Play
from sb3_belief.study.partner_pool import PoolEntry, read_pool
from sb3_belief.team.checkpoint import read_team
from sb3_belief.zoo.checks import Location, accepted_arguments, check_call
from sb3_belief.zoo.errors import ConfigError, cause, reason_of, short, unknown_setting
from sb3_belief.zoo.partners import PartnersConfig, partners_config
from sb3_belief.zoo.preflight import check_device, check_folder
from sb3_belief.zoo.replay import ShownEnvironment, ShownTeam, environment_of, load_into, make_shown_env
from sb3_belief.zoo.run_folder import RECORD, find_team, run_of

#: Steps observed since the swap at which is measured
CHECKPOINTS = (0, 25, 50, 100, 200, 400, 800)
# By these a partner of an environment's own stays, and is the same in all copies (where the environment has such arguments)
_STAYS: Mapping[str, Any] = {"redraw_every": None, "redraw_unit": "rollouts", "per_copy": False}
# And by this the convention of the games, where it is the environment's partners who are met; elsewhere K may be anything
_CONVENTION_STAYS: Mapping[str, Any] = {"K": None}
_COMMAND = "adapt"


@dataclass(frozen=True)
class AdaptOptions(ShownTeam):
    """
    Options of the measure of adapting, besides the team.

    :param pool: Whom it meets, see ``partner_pool.read_pool``
    :param output: Folder to write into. None for ``adaptation`` in the run's folder, or beside the zip
    :param agent: The agent that meets the others, where partners are the agents of other teams. None for each in turn
    :param blind: Run or team that knows nothing of the partner, or its return as a number; None for none
    :param oracle: Run or team that is told who the partner is, or its return as a number; None for none
    :param checkpoints: Numbers of observed steps at which is measured, ascending
    :param play: How
    """

    pool: str = ""
    output: str | None = None
    agent: str | None = None
    blind: str | None = None
    oracle: str | None = None
    checkpoints: tuple[int, ...] = CHECKPOINTS
    play: Play = field(default_factory=Play)


@dataclass(frozen=True)
class _Contender:
    """A saved team that meets the partners, in the environment of its own run."""

    role: str
    saved: ShownTeam
    path: Path
    shown: ShownEnvironment
    agents: list[str]

    @staticmethod
    def of(role: str, saved: ShownTeam, flag: str) -> "_Contender":
        path = find_team(saved.run, flag)
        # --env is of the team that is measured; others are told or not by the settings of their own run
        if role != TEAM and run_of(path) is not None:
            saved = replace(saved, env=None)
        # Those whom it has met in its training are not met here
        shown = environment_of(path, saved, flag, with_partners=False)
        try:
            agents = list(read_team(path, Trust.of(saved.trust, saved.extra_packages)).manifest["agents"])
        # A damaged file makes zipfile and json raise whatever they raise
        except Exception as error:
            raise ConfigError(f"{flag}: {str(path)!r} cannot be loaded: {cause(error)}") from error
        return _Contender(role, saved, path, shown, agents)


def adapt(options: AdaptOptions) -> tuple[Path, str]:
    """
    Measure how a team adapts, and write what was found.

    :param options: The options
    :return: The folder that was written, and what was found, in a paragraph
    :raises ConfigError: If something does not fit; nothing is written then
    """
    check_drawing()
    check_device(options.device)
    entries = read_pool(options.pool, options.extra_packages)
    contenders = [_Contender.of(TEAM, options, _COMMAND)]
    numbers = {}
    for role, given in ((BLIND, options.blind), (ORACLE, options.oracle)):
        number = _number(given, f"--{role}")
        if number is not None:
            numbers[role] = number
        elif given is not None:
            # The arguments of the environment are those of its own run: the oracle is told something
            contenders.append(_Contender.of(role, replace(options, run=given), f"--{role}"))
            own, other = contenders[0].shown.env_id, contenders[-1].shown.env_id
            if own != other:
                raise ConfigError(f"--{role}: {given!r} is of {other}, the team of {own}: their returns cannot be compared.")
    output = Path(options.output or contenders[0].path.parent / "adaptation")
    check_folder(output, "-o")
    # All partners are met for a moment first, so that the last of them is not refused after the others were measured
    for contender in contenders:
        for entry in entries:
            with _meetings(contender, entry, options) as meetings:
                if contender.role == TEAM and not any(meeting.can_adapt for _, meeting in meetings):
                    raise ConfigError(_without_history(contender, meetings[0][1]))
    rows: list[dict[str, Any]] = []
    for number, entry in enumerate(entries, start=1):
        for contender in contenders:
            rows += _measured(contender, entry, options)
        rows += [
            {**row, "role": role, "run": "", "steps": 0, "return": value, "success": None, "accuracy": None, "base_rate": None}
            for role, value in numbers.items()
            for row in rows
            if row["partner"] == entry.name and row["role"] == TEAM and row["steps"] == options.checkpoints[0]
        ]
        print(f"{number} of {len(entries)}: {_line(rows, entry.name, options.checkpoints)}", flush=True)
    points = adaptation_points(rows)
    try:
        make_folder(output)
        # Not beside those of an earlier measurement, which may have had one more
        remove_figures(output, "adaptation", "skill")
        write_rows(rows, output / ADAPTATION)
        write_rows([point.columns() for point in points], output / CURVE)
        title = f"{rows[0]['run']}, {rows[0]['environment']}"
        write_figure(adaptation_figure(rows, points, title), output / "adaptation.svg", output / "adaptation.png")
        if any(row["accuracy"] is not None for row in rows):
            write_figure(adaptation_figure(rows, points, title, skill=True), output / "skill.svg", output / "skill.png")
    except OSError as error:
        raise ConfigError(f"-o: cannot write into {short(str(output))} ({reason_of(error)}).") from None
    return output, adaptation_sentences(rows, points)


def _number(given: str | None, flag: str) -> float | None:
    if given is None or os.path.exists(given):
        return None
    try:
        number = float(given)
    except ValueError:
        return None
    if not math.isfinite(number):
        raise ConfigError(f"{flag}: {given} is no return: give a finite number, or a run.")
    return number


def _without_history(contender: _Contender, meeting: Meeting) -> str:
    found = ", ".join(f"{agent}: {type(meeting.team.agents[agent]).__name__}" for agent in meeting.agents)
    return (
        f"{_COMMAND}: nobody in {str(contender.path)!r} has a belief that a history feeds, or a recurrent state that lasts"
        f" over episodes, so observing changes nothing for them ({found}). Give it as --blind to a team that has:"
        " belief='adaptive', 'dynamic' or 'context', or memory_span='partner'."
    )


def _line(rows: Sequence[Mapping[str, Any]], partner: str, checkpoints: Sequence[int]) -> str:
    def mean(steps: int) -> float:
        own = [row["return"] for row in rows if (row["role"], row["partner"], row["steps"]) == (TEAM, partner, steps)]
        return sum(own) / len(own)

    return f"{partner}: return {mean(checkpoints[0]):.3g}, after {checkpoints[-1]} steps {mean(checkpoints[-1]):.3g}"


def _measured(contender: _Contender, entry: PoolEntry, options: AdaptOptions) -> list[dict[str, Any]]:
    """Return the rows of one team beside one partner."""
    checkpoints = options.checkpoints if contender.role == TEAM else (0,)
    rows = []
    with _meetings(contender, entry, options) as meetings:
        for agent, meeting in meetings:
            for repetition in range(options.play.repetitions):
                found = meeting.adapt(checkpoints, options.play, repetition)
                _check_one_partner(entry, meeting.told)
                rows += [
                    {
                        "role": contender.role,
                        "run": _name_of(contender.path),
                        "environment": contender.shown.env_id,
                        "partner": entry.name,
                        "agent": agent,
                        "repetition": repetition,
                        "steps": steps,
                        **each.columns(),
                        "accuracy": each.accuracy,
                        "base_rate": each.base_rate,
                    }
                    for steps, each in found.items()
                ]
        told = {name for _, meeting in meetings for name in meeting.told}
    _check_one_partner(entry, told)
    return [{name: {**row, "type": next(iter(told), "")}[name] for name in (*TEXTS, *NUMBERS)} for row in rows]


def _check_one_partner(entry: PoolEntry, told: Collection[str]) -> None:
    if len(told) > 1:
        raise ConfigError(
            f"{_COMMAND}: {entry.name} is not one partner but several, {sorted(told)}, one after the other: give"
            " --env-kwargs by which the environment's partner stays."
        )


def _name_of(path: Path) -> str:
    """Return what a saved team is called: by the folder of its run, if it is the team of one."""
    return path.parent.name if (path.parent / RECORD).is_file() else path.name


@contextmanager
def _meetings(contender: _Contender, entry: PoolEntry, options: AdaptOptions) -> Iterator[list[tuple[str, Meeting]]]:
    """Yield the meetings of a team with a partner, each with the name of the agent that is meant; empty for all of them."""
    saved, play = contender.saved, options.play
    shown = _shown(contender.shown, entry, saved)
    where = f"--partners: {entry.name}"
    seats = _free_seats(contender, shown, where)
    if seats:
        shown = replace(shown, partners=_beside(contender, entry, seats, play.deterministic))
    with ExitStack() as stack:
        env, own_env = (
            stack.enter_context(closing(make_shown_env(shown, saved, n_envs, play.seed, where))) for n_envs in (play.n_envs, 1)
        )
        team = load_into(contender.path, env, saved, _COMMAND)
        if seats or entry.partners is None:
            if options.agent is not None:
                raise ConfigError("--agent: all agents of the team learn beside these partners, so none can be chosen.")
            yield [("", Meeting(team, list(team.agents), team, env, own_env))]
            return
        if not isinstance(entry.partners, str):
            raise ConfigError(
                f"{where}: the team has models for all agents of {shown.env_id}, so a partner is the agents of another team:"
                " the path of a run or of a saved team."
            )
        if len(team.agents) == 1:
            raise ConfigError(f"{where}: {shown.env_id} has one agent only, so its partners are the environment's own.")
        if options.agent is not None and options.agent not in team.agents:
            raise unknown_setting("--agent", "agent", options.agent, team.agents)
        others = load_into(Path(entry.partners), env, saved, where)
        chosen = list(team.agents) if options.agent is None else [options.agent]
        yield [(agent, Meeting(team, [agent], Among(team, agent, others), env, own_env)) for agent in chosen]


def _shown(shown: ShownEnvironment, entry: PoolEntry, saved: ShownTeam) -> ShownEnvironment:
    """Return the environment with the arguments that make it a partner's."""
    env = spec(shown.env_id)
    make = env.load()
    given = check_call(
        make,
        dict(entry.env_kwargs),
        Location(f"--partners: {entry.name}", saved.extra_packages),
        skip=len(env.leading),
        of_env=True,
    )
    wanted = {**_STAYS, **(_CONVENTION_STAYS if entry.partners is None else {})}
    stays = {name: value for name, value in wanted.items() if name in accepted_arguments(make)[0]}
    asked = {pair.partition(":")[0] for pair in saved.env_kwargs}
    kept = {name: value for name, value in stays.items() if name not in asked}
    return replace(shown, env_kwargs={**shown.env_kwargs, **kept, **given})


def _free_seats(contender: _Contender, shown: ShownEnvironment, where: str) -> list[str]:
    """Return the agents for whom the team has no models."""
    with closing(make_shown_env(replace(shown, observation={}), contender.saved, 1, 0, where)) as env:
        agents = env.possible_agents
    # Of a team that does not fit its loading says why
    return [agent for agent in agents if agent not in contender.agents] if set(contender.agents) <= set(agents) else []


def _beside(contender: _Contender, entry: PoolEntry, seats: list[str], deterministic: bool) -> PartnersConfig:
    """Return the partner who acts for the agents for whom the team has no models, and stays."""
    location = Location(f"--partners: {entry.name}", contender.saved.extra_packages)
    if entry.partners is None:
        raise ConfigError(f"{location.text}: nobody acts for {seats}, for whom the team has no models: name partners.")
    settings = {
        "learners": contender.agents,
        "members": {entry.name: entry.partners},
        "redraw_every": None,
        "deterministic": deterministic,
    }
    return partners_config(settings, location)
