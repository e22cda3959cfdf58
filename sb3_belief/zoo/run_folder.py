"""Folders of runs: their names, their records ``run.json``, and the saved teams in them."""

import json
import os
import platform
import re
import shlex
import sys
import time
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

from stable_baselines3.common.vec_env import VecEnv

from sb3_belief.common.durable_files import replaced_file
from sb3_belief.common.versions import versions
from sb3_belief.envs.suites import SUITES, comma_separated
from sb3_belief.team.checkpoints import checkpoint_files
from sb3_belief.zoo.config import RunConfig
from sb3_belief.zoo.errors import ConfigError, cause, reason_of, short
from sb3_belief.zoo.names import get_algo, load_env
from sb3_belief.zoo.run_files import BEST_MODEL as BEST_MODEL
from sb3_belief.zoo.run_files import CHECKPOINTS as CHECKPOINTS
from sb3_belief.zoo.run_files import TEAM as TEAM

CONFIG = "config.yml"
RECORD = "run.json"
#: The belief viewer, once it has been written
VIEWER = "viewer.html"
# How a run ended that can be continued, by its record
UNFINISHED = ("running", "interrupted", "failed")
# Flag of a run that continues training a saved team
_TRAINED = ("-i", "--trained-agent")
# Entries of a record that say how the run ended
_OF_AN_END = ("error", "signal", "timesteps", "seconds", "saved")


def make_run_folder(log_folder: str | os.PathLike[str], algo: str, env_id: str) -> Path:
    """
    Create the folder ``<log_folder>/<algo>/<env>_<k>/`` of a new run.

    ``<env>`` is what ``folder_name`` makes of the environment's id, and k is one above the highest number that exists.

    :param log_folder: Folder of all runs
    :param algo: Name of the algorithm
    :param env_id: Id of the environment
    :return: The new, empty folder
    :raises ConfigError: If it cannot be made
    """
    parent, name = Path(log_folder) / algo, folder_name(env_id)
    numbers = [path.name.removeprefix(f"{name}_") for path in parent.glob(f"{name}_*")]
    number = max((int(text) for text in numbers if text.isdecimal()), default=0)
    while True:
        number += 1
        folder = parent / f"{name}_{number}"
        try:
            # Of several runs that start at the same moment only one creates this folder. The others try the next number
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        except (OSError, ValueError) as error:
            raise ConfigError(
                f"-f: cannot make the folder {short(str(folder))} ({reason_of(error)}): name one that can be written."
            ) from None
        return folder


def folder_name(env_id: str) -> str:
    """
    Return an environment's id with all characters replaced that do not belong in the name of a folder.

    :param env_id: Id of an environment, e.g. ``"mpe/simple_spread_v3"`` or ``"my_games:make"``
    :return: Name of a single folder, e.g. ``"mpe-simple_spread_v3"`` or ``"my_games-make"``
    """
    return re.sub(r"[^\w.-]", "-", env_id)


def remove_run_folder(folder: Path) -> None:
    """
    Remove the folder of a run that was refused before it wrote anything, and the two folders above it if they are empty.

    :param folder: Folder that ``make_run_folder`` created
    """
    try:
        for path in (folder, folder.parent, folder.parent.parent):
            path.rmdir()
    except OSError:
        # The folder is not empty, so it belongs to other runs
        pass


def write_config(folder: Path, config: RunConfig) -> None:
    """
    Write the configuration of a run into its folder.

    :param folder: The folder
    :param config: The configuration
    """
    with replaced_file(folder / CONFIG, "w", encoding="utf-8") as file:
        file.write(config.to_yaml())


class RunRecord:
    """
    The file ``run.json``, which records what ran, with which seed, by which command, and how it ended.

    It is written at the start and at the end of the run, also if the run fails. Only in the record of a run that was killed
    the status remains ``running``.

    :param folder: Folder of the run
    :param command: The words of the command line
    :param before: The record of the run so far, if it is continued: its entries stay, and what is new comes into a list under
        ``resumed``
    :param content: Further entries
    """

    def __init__(self, folder: Path, command: list[str], before: dict[str, Any] | None = None, **content: Any) -> None:
        self.path = folder / RECORD
        self._start, self._seconds = time.monotonic(), 0.0
        now = {
            "command": shlex.join(command),
            "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
            "versions": versions(),
            "platform": platform.platform(),
        }
        self.content: dict[str, Any] = {"status": "running", **content, **now}
        if before is not None:
            seconds = before.get("seconds", 0.0)
            self._seconds = float(seconds) if isinstance(seconds, int | float) else 0.0
            kept = {key: value for key, value in before.items() if key not in ("status", *_OF_AN_END)}
            resumed = [*before.get("resumed", []), {key: value for key, value in now.items() if value != before.get(key)}]
            self.content = {"status": "running", **kept, **content, "resumed": resumed}
        self._write()

    def finish(self, status: str, **content: Any) -> None:
        """
        Record how the run ended.

        :param status: ``"finished"``, ``"interrupted"`` or ``"failed"``
        :param content: Results to add
        """
        seconds = self._seconds + time.monotonic() - self._start
        self.content.update(status=status, seconds=round(seconds, 1), **content)
        self._write()

    @contextmanager
    def failures(self) -> Iterator[None]:
        """Record what ends the lines in the context, unless they have recorded how they ended, and raise it on."""
        try:
            yield
        except KeyboardInterrupt as error:
            # Before the training had begun, so that there is nothing to save
            if self.content["status"] == "running":
                self.finish("interrupted", signal=getattr(error, "signal_name", "SIGINT"))
            raise
        except BaseException as error:
            if self.content["status"] == "running":
                self.finish("failed", error=cause(error))
            raise

    def _write(self) -> None:
        # A program that reads the record meanwhile gets the old or the new one, never a part
        with replaced_file(self.path, "w", encoding="utf-8") as file:
            file.write(json.dumps(self.content, indent=2) + "\n")


def environment_versions(env_id: str, env: VecEnv) -> dict[str, str]:
    """
    Return the versions of the packages that an environment comes from.

    :param env_id: Id of the environment
    :param env: The environment, after it has run, because StarCraft II reports its version only then
    :return: {package: version} of the packages of its suite, and the result of its own ``versions()`` if it has that method
    """
    suite = SUITES.get(env_id.partition("/")[0])
    found: dict[str, str] = {}
    if suite is not None:
        packages = metadata.packages_distributions()
        found.update((name, metadata.version(name)) for module in suite.modules for name in packages.get(module, ()))
    if env.has_attr("versions"):
        found.update(env.env_method("versions")[0])
    return found


def find_team(run: str | os.PathLike[str], flag: str, tells: bool = True) -> Path:
    """
    Return the path of a saved team.

    Of a run that has not ended, or was killed, it is the newest checkpoint, which is said on the standard error.

    :param run: Folder of a run, or zip of a team
    :param flag: Flag or command that it was given to, for the error message
    :param tells: Whether to say that the run has not finished
    :return: Path of the zip
    :raises ConfigError: If there is none
    """
    path = Path(run)
    if os.path.isfile(path):
        return path
    # os.path, because Path.is_dir raises for a name that is too long
    if not os.path.isdir(path):
        raise ConfigError(f"{flag}: no file or folder {str(path)!r}. Give a run's folder or a saved team's zip.")
    is_run = (path / RECORD).is_file()
    record = read_record(path) if is_run else {}
    status, checkpoint = record.get("status"), None
    # An earlier part of a run that goes on may have left a team. What ended before it began to learn has saved none
    saved_none = status == "running" or (status in UNFINISHED and "timesteps" not in record)
    if is_run and (saved_none or not (path / TEAM).is_file()):
        checkpoint = next(whole_checkpoints(path), None)
    if checkpoint is None and not (path / TEAM).is_file():
        # Not deeper: checkpoints lie one folder below, and the folder may be any
        others = sorted(file.relative_to(path).as_posix() for pattern in ("*.zip", "*/*.zip") for file in path.glob(pattern))
        names = comma_separated(others, most=10) or "it has none"
        raise ConfigError(f"{flag}: no {TEAM} in {str(path)!r}. Give one of its zips: {names}.")
    team = path / TEAM if checkpoint is None else checkpoint
    if status in UNFINISHED and tells:
        how = f" What -i trains is a new run; train --resume {path} continues this one exactly." if flag in _TRAINED else ""
        print(f"{path} has not finished ({status}): {team.relative_to(path)} is taken.{how}", file=sys.stderr)
    return team


def whole_checkpoints(folder: Path) -> Iterator[Path]:
    """
    Iterate over the checkpoints of a run that are whole, from the newest on. Damaged ones are said on the standard error.

    :param folder: Folder of the run
    :return: Their paths
    """
    for _, path in reversed(checkpoint_files(folder / CHECKPOINTS)):
        try:
            # Nothing is unpacked here
            with zipfile.ZipFile(path) as archive:
                damaged = archive.testzip()
                if damaged is None:
                    archive.getinfo("team.json")
        # Whatever was made of a file may make zipfile and zlib raise whatever they raise
        except Exception as error:
            damaged = cause(error)
        if damaged is None:
            yield path
        else:
            print(f"{path} is damaged ({damaged}): an earlier checkpoint is looked for.", file=sys.stderr)


def read_record(folder: Path) -> dict[str, Any]:
    """
    Read the record of a run.

    :param folder: Folder of the run
    :return: Its entries
    :raises ConfigError: If the file cannot be read
    """
    path = folder / RECORD
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(
            f"{path}: is not readable as JSON ({error}). Without it give the team's zip outside of the folder, with --env."
        ) from None
    if not isinstance(record, dict):
        raise ConfigError(f"{path}: must be a mapping, not {type(record).__name__}: it is damaged.")
    return record


def run_of(team: Path) -> tuple[str, str, Path] | None:
    """
    Return the run that saved a team.

    :param team: Zip of a team
    :return: Algorithm, environment id and configuration file of the run, or None if the zip is not in the folder of a run
    :raises ConfigError: If the record of the run is damaged
    """
    # Checkpoints lie one folder deeper than the final team
    for folder in list(team.resolve().parents)[:2]:
        if (folder / RECORD).is_file():
            run = run_of_record(folder, read_record(folder))
            if run is not None:
                return run
    return None


def run_of_record(folder: Path, record: dict[str, Any]) -> tuple[str, str, Path] | None:
    """
    Return what a run's record says of it.

    :param folder: Folder of the run
    :param record: Its record
    :return: Algorithm, environment id and configuration file of the run, or None if it has no such file
    :raises ConfigError: If the record is damaged
    """
    if not (folder / CONFIG).is_file():
        return None
    if not (isinstance(record.get("algo"), str) and isinstance(record.get("env"), str)):
        raise ConfigError(f"{folder / RECORD}: does not say which 'algo' and 'env' the run had: it is damaged.")
    return record["algo"], record["env"], folder / CONFIG


def check_record(
    run: tuple[str, str, Path], extra_packages: tuple[str, ...] = (), of_env: bool = True, trust: bool = False
) -> None:
    """
    Check the algorithm and the environment that a run's record names, so that no flag is blamed for them.

    :param run: What ``run_of`` returns
    :param extra_packages: See ``names.resolve``
    :param of_env: Whether to check the environment too
    :param trust: Whether the environment may be any callable of an allowed package
    :raises ConfigError: If there is no such algorithm, or no such environment. The message names the record
    """
    algo, env_id, conf_file = run
    record = conf_file.with_name(RECORD)
    get_algo(algo, f"{record}: algo")
    if of_env:
        load_env(env_id, f"{record}: env", extra_packages, of_file=not trust)
