"""
The setting ``partners`` of a configuration: who learns, and who acts for all other agents.

It is a mapping with

- ``learners``: the agents that learn, a name or a list; partners act for all others
- ``members``: {name: partner}, where a partner is the path of a run's folder, of a team's zip or of an SB3 model's, a function
  ``module:function``, or a mapping of one of these for each agent
- ``runs``: one or more patterns of paths (``logs/*/my-env_*``), each match of which is a member: a run by its team, a zip
- the arguments of ``PartnerPool``: ``redraw_every``, ``redraw_unit``, ``per_copy``, ``weights``, ``seed``, ``held_out``;
  without a ``seed`` the draws are those of the run's
- ``deterministic``: whether partners take their most likely actions

Paths are relative to the working folder. In ``config.yml`` they are absolute, and ``runs`` have become ``members``, so that a
run that is continued meets the partners that it has met before.
"""

import glob
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sb3_belief.common.safe_files.trust import is_allowed
from sb3_belief.team import PartnerPool, PartnersVecEnv, TeamVecEnv
from sb3_belief.zoo.checks import Location, accepted_arguments, check_value
from sb3_belief.zoo.errors import ConfigError, short, unknown_setting
from sb3_belief.zoo.names import resolve
from sb3_belief.zoo.run_files import BEST_MODEL, CHECKPOINTS, TEAM, is_tuning
from sb3_belief.zoo.yaml_data import parse

_FUNCTION = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")
_POOL_KEYS = {name: hint for name, hint in accepted_arguments(PartnerPool)[0].items() if name != "members"}
_KEYS: dict[str, Any] = {
    "learners": str | list[str],
    "members": dict[str, Any],
    "runs": str | list[str],
    **_POOL_KEYS,
    "weights": list[float] | None,
    "held_out": str | list[str],
    "deterministic": bool,
}


@dataclass(frozen=True)
class PartnersConfig:
    """
    The partners of a configuration.

    :param learners: Names of the agents that learn
    :param pool: The partners of all others, drawn for all of them at once
    :param has_seed: Whether the pool's seed is given; it is that of the environment otherwise
    :param deterministic: As for ``PartnersVecEnv``
    :param allow_packages: Packages of which files and functions may be
    """

    learners: tuple[str, ...]
    pool: PartnerPool
    has_seed: bool = False
    deterministic: bool = False
    allow_packages: tuple[str, ...] = ()

    def put_into(self, env: TeamVecEnv, seed: int, evaluation: bool = False, trust_pickle: bool = False) -> TeamVecEnv:
        """
        Have the partners act in an environment.

        :param env: The environment
        :param seed: Of the pool's draws, if it has none of its own
        :param evaluation: Whether it is one of evaluations, in which the members that are held out are met
        :param trust_pickle: Whether to unpickle what the partners' files hold
        :return: The environment of the learners
        :raises ValueError: If learners are unknown, nobody is left, or a partner does not fit
        """
        unknown = [agent for agent in self.learners if agent not in env.possible_agents]
        if unknown:
            raise ValueError(f"partners: learners: the environment has no {unknown}; its agents are {env.possible_agents}.")
        others = [agent for agent in env.possible_agents if agent not in self.learners]
        if not others:
            raise ValueError(f"partners: learners: all of {env.possible_agents} learn, so partners act for nobody.")
        pool = self.pool if self.has_seed else self.pool.with_seed(seed)
        return PartnersVecEnv(
            env, dict.fromkeys(others, pool), self.deterministic, evaluation, trust_pickle, self.allow_packages
        )


def check_partners(given: Mapping[str, Any] | None, location: Location) -> dict[str, Any] | None:
    """
    Check the setting in one source of settings.

    :param given: The mapping; None for no partners
    :param location: Where it is given
    :return: The same as plain data with absolute paths, in which ``runs`` have become ``members``
    :raises ConfigError: For an unknown key, a wrong type, or a member that cannot be found
    """
    if given is None:
        return None
    checked: dict[str, Any] = {}
    for key, value in given.items():
        if key not in _KEYS:
            raise unknown_setting(location.text, "key", key, _KEYS)
        checked[key] = check_value(value, _KEYS[key], location.key(key))
    members = {
        name: {agent: _source(each, location.key(f"members: {name}: {agent}")) for agent, each in member.items()}
        if isinstance(member, dict)
        else _source(member, location.key(f"members: {name}"))
        for name, member in checked.pop("members", {}).items()
    }
    patterns = checked.pop("runs", [])
    for name, path in _matches([patterns] if isinstance(patterns, str) else patterns, location.key("runs")).items():
        if name in members:
            raise ConfigError(f"{location.text}: two members are called {name!r}: give one a name of its own in members.")
        members[name] = path
    if {"members", "runs"} & given.keys():
        checked["members"] = members
    for key in ("learners", "held_out"):
        if isinstance(checked.get(key), str):
            checked[key] = [checked[key]]
    return checked


def partners_config(settings: Mapping[str, Any], location: Location) -> PartnersConfig:
    """
    Make the partners of a configuration.

    :param settings: What ``check_partners`` returned, merged from all sources
    :param location: Where they are given
    :return: The partners
    :raises ConfigError: If nobody learns, or the pool refuses its arguments
    """
    for key, example in (("learners", "[agent_0]"), ("members", "{name: path}")):
        if not settings.get(key):
            raise ConfigError(f"{location.text}: needs {key!r}, as in {{{key}: {example}}}.")
    members = {
        name: {agent: _partner(each, location) for agent, each in member.items()}
        if isinstance(member, dict)
        else _partner(member, location)
        for name, member in settings["members"].items()
    }
    try:
        pool = PartnerPool(members, **{key: settings[key] for key in _POOL_KEYS if key in settings})
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{location.text}: {error}") from None
    return PartnersConfig(
        tuple(settings["learners"]),
        pool,
        settings.get("seed") is not None,
        settings.get("deterministic", False),
        tuple(location.extra_packages),
    )


def partners_of_flag(given: str) -> dict[str, Any]:
    """
    Return the settings that the flag ``--partners`` stands for.

    :param given: A YAML file that holds what the setting ``partners`` holds; or, beside the learners that other settings name,
        a folder with runs, of which each that has saved a team is a member, or the folder of a run or a zip, which is then the
        only one
    :return: The setting
    :raises ConfigError: If the file cannot be read, or no run in the folder has saved a team
    """
    if not given.endswith((".yml", ".yaml")):
        return {"members": _runs_in(Path(given)) or {_names_of([Path(given)])[0]: given}}
    try:
        content = parse(Path(given).read_text(encoding="utf-8"), f"--partners {given}")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"--partners: {given!r} cannot be read: {error}") from None
    if not isinstance(content, dict):
        raise ConfigError(f"--partners: {given!r} must hold a mapping, {{learners: ..., members: ...}}, not {short(content)}.")
    return content


def _runs_in(folder: Path) -> dict[str, str]:
    """
    Return the runs within a folder that is none itself, by their paths in it, but for the trials of tunings: each has settings
    of its own, and is short.
    """
    if not folder.is_dir() or _saved_team(folder) is not None:
        return {}
    found: dict[str, str] = {}
    for path, folders, _ in os.walk(folder):
        here = Path(path)
        if here != folder and is_tuning(here):
            folders.clear()
        elif _saved_team(here) is not None:
            found[here.relative_to(folder).as_posix()] = path
    if not found:
        raise ConfigError(
            f"--partners: no run in {short(str(folder))} has saved a team ({BEST_MODEL} or {TEAM}): give the folder of a run"
            " that has, or one with such runs."
        )
    return dict(sorted(found.items(), key=lambda item: _by_numbers(item[0])))


def _saved_team(folder: Path) -> Path | None:
    """Return the team that a run has saved, the best one if there is such."""
    return next((folder / name for name in (BEST_MODEL, TEAM) if (folder / name).is_file()), None)


def _source(given: Any, location: Location) -> str:
    """Return where a partner is: an absolute path, or a function that may be imported."""
    if not isinstance(given, str):
        raise ConfigError(f"{location.text}: must be a path or module:function, not {short(given)}.")
    head, marker, agent = given.partition(".zip:")
    path = Path(f"{head}.zip" if marker else given)
    if path.is_dir():
        found = _saved_team(path)
        if found is None:
            raise ConfigError(f"{location.text}: {given!r} is a folder without {BEST_MODEL} and {TEAM}.")
        return os.path.abspath(found)
    if path.is_file():
        return os.path.abspath(path) + (f":{agent}" if marker else "")
    if not _FUNCTION.fullmatch(given) or marker:
        raise ConfigError(f"{location.text}: there is no file or folder {given!r}, nor is it a function, module:function.")
    function = resolve(given.replace(":", "."), location.text, location.extra_packages)
    if location.run_folder is not None and not is_allowed(
        getattr(function, "__module__", ""), ("sb3_belief.envs", *location.extra_packages)
    ):
        raise ConfigError(
            f"{location.text}: the file of a run may name no function of {given.partition(':')[0]!r}. If you trust it:"
            " --trust."
        )
    return given


def _partner(source: str, location: Location) -> Any:
    if os.path.isabs(source):
        return source
    return resolve(source.replace(":", "."), location.text, location.extra_packages)


def _matches(patterns: Sequence[str], location: Location) -> dict[str, str]:
    """Return the runs and zips that patterns of paths stand for, by name."""
    found: list[Path] = []
    for pattern in patterns:
        paths = map(Path, sorted(glob.glob(pattern, recursive=True), key=_by_numbers))
        matches = [path for path in paths if path.suffix == ".zip" or _saved_team(path) is not None]
        if not matches:
            raise ConfigError(f"{location.text}: no folder of a run and no zip matches {pattern!r}.")
        found += matches
    members: dict[str, str] = {}
    for name, path in zip(_names_of(found), found, strict=True):
        if name in members:
            raise ConfigError(f"{location.text}: two members are called {name!r}: give them names of their own in members.")
        members[name] = _source(str(path), location)
    return members


def _by_numbers(path: str) -> list[Any]:
    # Like ls -v: run_2 before run_10
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", path)]


def _names_of(paths: Sequence[Path]) -> list[str]:
    """
    Return the names of members: the ends of their paths, of a run ``<algo>/<env>_<k>``, of a zip its folder and its name, and
    longer ones where two would be called the same.
    """
    parts = [
        [part.removesuffix(".zip") for part in Path(os.path.abspath(path)).parts if part != CHECKPOINTS] for path in paths
    ]
    for length in range(2, max(map(len, parts), default=2) + 1):
        names = ["/".join(each[-length:]) for each in parts]
        if len(set(names)) == len(names):
            return names
    return ["/".join(each[-2:]) for each in parts]


def without_replaced(layers: Sequence[tuple[Location, dict[str, Any]]]) -> list[tuple[Location, dict[str, Any]]]:
    """
    Leave out of sources of settings the partners in whose place a later source has others or none, with what is said of them
    by name. Those with whom a run was trained may have been moved or deleted since.

    :param layers: Settings with the places where they are given, in the order in which they override each other
    :return: The same without them
    """
    kept: list[tuple[Location, dict[str, Any]]] = []
    replaced = False
    for location, layer in reversed(layers):
        partners = layer.get("partners")
        names_some = isinstance(partners, dict) and bool(partners.keys() & {"members", "runs"})
        if replaced and names_some:
            rest = {key: value for key, value in partners.items() if key not in ("members", "runs", "weights", "held_out")}
            layer = {**layer, "partners": rest}
        kept.append((location, layer))
        replaced = replaced or names_some or ("partners" in layer and partners is None)
    return kept[::-1]
