"""The folder of a run: its number, and the record of what ran in it."""

import json
import os
import platform
import re
import shlex
import time
from importlib import metadata
from pathlib import Path
from typing import Any

from stable_baselines3.common.vec_env import VecEnv

from sb3_belief.common.versions import versions
from sb3_belief.envs.suites import SUITES
from sb3_belief.zoo.errors import ConfigError

CONFIG = "config.yml"
RECORD = "run.json"
TEAM = "team.zip"
CHECKPOINTS = "checkpoints"


def make_run_folder(log_folder: str | os.PathLike[str], algo: str, env_id: str) -> Path:
    """
    Make ``<log_folder>/<algo>/<env>_<k>/`` with k one above the highest there is, and the environment's id as ``folder_name``
    writes it. Runs that start at the same moment get different folders: making one fails if another was faster, and then the
    next number is tried.

    :param log_folder: folder of all runs
    :param algo: name of the algorithm
    :param env_id: id of the environment
    :return: the new, empty folder
    """
    parent, name = Path(log_folder) / algo, folder_name(env_id)
    numbers = [path.name.removeprefix(f"{name}_") for path in parent.glob(f"{name}_*")]
    number = max((int(text) for text in numbers if text.isdecimal()), default=0)
    while True:
        number += 1
        folder = parent / f"{name}_{number}"
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        return folder


def folder_name(env_id: str) -> str:
    """
    :param env_id: id of an environment, e.g. ``"mpe/simple_spread_v3"`` or ``"my_games:make"``
    :return: one folder's name: ``"mpe-simple_spread_v3"``, ``"my_games-make"``
    """
    return re.sub(r"[^\w.-]", "-", env_id)


def remove_run_folder(folder: Path) -> None:
    """
    Take back ``make_run_folder`` for a run that was refused before it wrote anything; folders above that are empty go too.

    :param folder: the run's folder
    """
    try:
        for path in (folder, folder.parent, folder.parent.parent):
            path.rmdir()
    except OSError:
        # not empty: there are other runs
        pass


class RunRecord:
    """
    ``run.json``: what ran, with which seed, by which command, and how it ended. Written at the start and at the end, so that a
    run that was killed still says ``running``.

    :param folder: the run's folder
    :param command: the words of the command line
    :param content: whatever else belongs there
    """

    def __init__(self, folder: Path, command: list[str], **content: Any) -> None:
        self.path = folder / RECORD
        self._start = time.monotonic()
        self.content: dict[str, Any] = {
            "status": "running",
            **content,
            "command": shlex.join(command),
            "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
            "versions": versions(),
            "platform": platform.platform(),
        }
        self._write()

    def finish(self, status: str, **content: Any) -> None:
        """
        :param status: ``"finished"``, ``"interrupted"`` or ``"failed"``
        :param content: results to add
        """
        self.content.update(status=status, seconds=round(time.monotonic() - self._start, 1), **content)
        self._write()

    def _write(self) -> None:
        # first beside, then in place: who reads meanwhile finds the old or the new record, never half of one
        beside = self.path.with_suffix(".json.tmp")
        beside.write_text(json.dumps(self.content, indent=2) + "\n", encoding="utf-8")
        beside.replace(self.path)


def environment_versions(env_id: str, env: VecEnv) -> dict[str, str]:
    """
    :param env_id: id of the environment
    :param env: the environment, after it has run: StarCraft II tells its version only then
    :return: {package: version} of the packages that it comes from, and what its own ``versions()`` says, if it has one
    """
    family = SUITES.get(env_id.partition("/")[0])
    found: dict[str, str] = {}
    if family is not None:
        packages = metadata.packages_distributions()
        found.update((name, metadata.version(name)) for module in family.modules for name in packages.get(module, ()))
    if env.has_attr("versions"):
        found.update(env.env_method("versions")[0])
    return found


def find_team(run: str | os.PathLike[str], flag: str) -> Path:
    """
    :param run: a run's folder, or a team's zip
    :param flag: the flag or command that was given it, for the error message
    :return: the zip
    :raises ConfigError: if there is none
    """
    path = Path(run)
    if path.is_file():
        return path
    if not path.is_dir():
        raise ConfigError(f"{flag}: no file or folder {str(path)!r}. Give a run's folder or a saved team's zip.")
    if not (path / TEAM).is_file():
        others = sorted(str(file.relative_to(path)) for file in path.rglob("*.zip"))
        raise ConfigError(f"{flag}: no {TEAM} in {str(path)!r}. Give one of its zips: {', '.join(others) or 'it has none'}.")
    return path / TEAM


def run_of(team: Path) -> tuple[str, str, Path] | None:
    """
    :param team: a team's zip
    :return: algorithm, environment id and configuration file of the run that saved it, or None if it lies in no run's folder
    """
    for folder in list(team.resolve().parents)[:2]:
        if (folder / RECORD).is_file() and (folder / CONFIG).is_file():
            record = json.loads((folder / RECORD).read_text(encoding="utf-8"))
            return record["algo"], record["env"], folder / CONFIG
    return None
