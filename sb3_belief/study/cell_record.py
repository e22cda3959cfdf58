"""Cells of a study: one run each, with a folder and a record ``cell.json`` of its own."""

import json
import math
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from sb3_belief.common.durable_files import make_folder, replaced_file
from sb3_belief.zoo.errors import ConfigError
from sb3_belief.zoo.run_lock import run_lock

CELLS, CELL_RECORD, CELL_CONFIG, EPISODES_FILE = "cells", "cell.json", "config.yml", "episodes.parquet"
STATUSES = WAITING, RUNNING, FINISHED, FAILED = "waiting", "running", "finished", "failed"
# What a record must have to be of use, with the types of the entries
_ENTRIES: dict[str, Any] = {
    **{name: str for name in ("study", "arm", "algo", "env", "status")},
    **{name: int for name in ("seed", "attempts", "n_timesteps", "final_episodes")},
    **{name: dict for name in ("options", "settings")},
}
#: Options that change nothing of what is learned, so that they may differ from those with which a cell was begun
FREE_OPTIONS = ("save_every", "device", "num_threads", "jobs", "on_nan")


@dataclass(frozen=True)
class Cell:
    """
    A run of a study: an algorithm with its settings in an environment with a seed.

    :param folder: Its folder
    """

    folder: Path

    @property
    def path(self) -> Path:
        """Its record."""
        return self.folder / CELL_RECORD

    @property
    def name(self) -> str:
        """Its folder within the study, for messages."""
        return "/".join(self.folder.parts[-3:])

    @property
    def episodes(self) -> Path:
        """The file of the episodes of its evaluations."""
        return self.folder / EPISODES_FILE

    def read(self) -> dict[str, Any]:
        """
        Read the record.

        :return: Its entries
        :raises ConfigError: If it is damaged
        """
        try:
            record = json.loads(self.path.read_text(encoding="utf-8"))
            whole = all(isinstance(record[name], kind) for name, kind in _ENTRIES.items()) and record["status"] in STATUSES
        except (OSError, ValueError, RecursionError, KeyError, TypeError):
            whole = False
        if not whole:
            raise ConfigError(
                f"{self.path}: is damaged: no record of a run of a study. Move the folder {str(self.folder)!r} away to have it"
                " run again; all others keep their results."
            )
        return record

    def write(self, record: dict[str, Any]) -> None:
        """
        Write the record. Whoever reads it meanwhile gets the old or the new one.

        :param record: Its entries
        """
        with replaced_file(self.path, "w", encoding="utf-8") as file:
            file.write(json.dumps(record, indent=2) + "\n")

    def create(self, record: dict[str, Any]) -> None:
        """
        Make the folder of a cell that has not been begun, with its configuration.

        :param record: Its entries
        """
        make_folder(self.folder)
        with replaced_file(self.folder / CELL_CONFIG, "w", encoding="utf-8") as file:
            file.write(yaml.safe_dump({record["env"]: record["settings"]}, sort_keys=False))
        self.write(record)

    @contextmanager
    def held(self) -> Iterator[bool]:
        """
        Hold the cell, so that no process begins to run it meanwhile.

        :return: Whether it is held; False if a process runs it
        """
        with ExitStack() as stack:
            try:
                stack.enter_context(run_lock(self.folder))
            except ConfigError:
                yield False
                return
            yield True

    def run_folder(self, record: dict[str, Any]) -> Path | None:
        """
        Return the folder of its run.

        :param record: Its entries
        :return: The newest folder of the algorithm and the environment with a record, or None
        """
        found = []
        for path in (self.folder / record["algo"]).glob("*_*"):
            number = path.name.rpartition("_")[2]
            if number.isdecimal() and (path / "run.json").is_file():
                found.append((int(number), path))
        return max(found)[1] if found else None


def all_cells(folder: Path) -> Iterator[Cell]:
    """
    Iterate over the cells in the folder of a study, in the order of their names.

    :param folder: Folder of the study
    :return: The cells
    """
    for path in sorted((folder / CELLS).glob(f"*/*/seed_*/{CELL_RECORD}")):
        yield Cell(path.parent)


def steps_done(cell: Cell, record: dict[str, Any]) -> int:
    """
    Return how far a run is, as its tables say, without reading more than their ends.

    :param cell: The cell
    :param record: Its entries
    :return: Joint steps
    """
    if record["status"] == FINISHED:
        return int(record["n_timesteps"])
    run = cell.run_folder(record)
    if run is None:
        return 0
    try:
        with open(run / "progress.csv", "rb") as file:
            names = file.readline().decode().strip().split(",")
            size = file.seek(0, 2)
            file.seek(max(size - 8192, 0))
            # The last line may be in the middle of being written
            lines = file.read().decode(errors="replace").split("\n")[:-1]
        steps = float(dict(zip(names, lines[-1].split(","), strict=True))["time/total_timesteps"])
        return int(steps) if math.isfinite(steps) else 0
    except (OSError, ValueError, KeyError, IndexError):
        return 0
