"""Whom a trained team is to meet: partners that a file or folder names, or the environment's own by one of its arguments."""

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from sb3_belief.report.adaptation import ALL
from sb3_belief.zoo.checks import Location
from sb3_belief.zoo.errors import ConfigError, short
from sb3_belief.zoo.partners import check_partners, partners_of_flag
from sb3_belief.zoo.yaml_data import parse

# partner_seed:100..107, or partner_seed:3,5,9
_VALUES = re.compile(r"([A-Za-z_]\w*):(.+)")
_RANGE = re.compile(r"(\d+)\.\.(\d+)")
_MOST = 1000


@dataclass(frozen=True)
class PoolEntry:
    """
    A partner that a team meets.

    :param name: Its name
    :param partners: What acts, for all agents beside the team's or by agent, as ``zoo.partners.check_partners`` returns it;
        None for a partner that is part of the environment
    :param env_kwargs: The argument of the environment that makes it this partner
    """

    name: str
    partners: str | Mapping[str, str] | None = None
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)


def read_pool(given: str, extra_packages: tuple[str, ...] = ()) -> list[PoolEntry]:
    """
    Read whom a team is to meet.

    :param given: A YAML file as ``train --partners`` takes it, of which those that are held out are met, or all if none is;
        the folder of a run, or one with runs; zip of a team; or ``"argument:first..last"`` or ``"argument:a,b"``, for the
        environment's own partners with these values of one of its arguments
    :param extra_packages: See ``names.resolve``
    :return: The partners, in order
    :raises ConfigError: If there are none, or one is not as it must be
    """
    values = _VALUES.fullmatch(given)
    if values is not None and not os.path.exists(given):
        return _of_values(values[1], values[2])
    if not os.path.exists(given):
        raise ConfigError(
            f"--partners: no file or folder {short(given)}. Give a YAML file of partners, a run, a folder of runs, or for the"
            " environment's own partners an argument and its values, such as partner_seed:100..107."
        )
    location = Location("--partners", extra_packages)
    checked = check_partners(partners_of_flag(given), location) or {}
    members, held_out = checked.get("members", {}), checked.get("held_out", [])
    unknown = [name for name in held_out if name not in members]
    if unknown or not members:
        lacks = f"{unknown} are held out but no members" if unknown else "there are no members"
        raise ConfigError(f"--partners: {short(given)}: {lacks}. It must name partners, by members or runs.")
    if ALL in members:
        raise ConfigError(f"--partners: {short(given)}: a member is called {ALL!r}, as tables call all of them: rename it.")
    return [PoolEntry(str(name), member) for name, member in members.items() if name in (held_out or members)]


def _of_values(argument: str, text: str) -> list[PoolEntry]:
    numbers = _RANGE.fullmatch(text)
    if numbers is None:
        values = [parse(word, f"--partners: {argument}") for word in text.split(",")]
    else:
        first, last = int(numbers[1]), int(numbers[2])
        if not first <= last < first + _MOST:
            raise ConfigError(f"--partners: {argument}:{first}..{last} must go up, over {_MOST:,} values at most.")
        values = list(range(first, last + 1))
    twice = [value for i, value in enumerate(values) if value in values[:i]]
    if twice:
        raise ConfigError(f"--partners: {argument}: {twice} is given twice: give each value once.")
    return [PoolEntry(f"{argument}:{value}", env_kwargs={argument: value}) for value in values]
