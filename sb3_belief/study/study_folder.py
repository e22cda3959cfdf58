"""The folder of a study: which cells it has, whether they fit its file, and the table of their episodes."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from sb3_belief.common.durable_files import make_folder, replaced_file, sweep_temporary_files
from sb3_belief.study.cell_record import CELLS, EPISODES_FILE, FAILED, FINISHED, FREE_OPTIONS, WAITING, Cell, all_cells
from sb3_belief.study.specification import TRAIN_KEYS, Study
from sb3_belief.zoo.config import RunConfig
from sb3_belief.zoo.errors import ConfigError, reason_of, short
from sb3_belief.zoo.run_folder import folder_name
from sb3_belief.zoo.train_options import TrainOptions

STUDY_FILE = "study.yml"
# How many differences a message has
_SHOWN = 3


@dataclass(frozen=True)
class PlannedCell:
    """
    A cell as the file of its study has it.

    :param cell: Its place
    :param record: What its record begins with
    """

    cell: Cell
    record: dict[str, Any]


def planned_cells(study: Study, folder: Path, configs: dict[tuple[str, str], RunConfig]) -> list[PlannedCell]:
    """
    Return the cells of a study, in the order in which they are run: all pairs with the first seed, then with the next one.

    :param study: The study
    :param folder: Its folder
    :param configs: Configuration of each pair of a label and an environment
    :return: The cells
    """
    planned = []
    for seed in study.seeds:
        for arm, env_id in study.pairs():
            config = study.seeded(configs[arm, env_id], seed)
            place = folder / CELLS / arm / folder_name(env_id) / f"seed_{seed}"
            record = {
                "study": study.name,
                "arm": arm,
                "algo": config.algo,
                "env": env_id,
                "seed": seed,
                "status": WAITING,
                "attempts": 0,
                "error": None,
                "seconds": 0.0,
                "cpu_seconds": 0.0,
                "run": None,
                "n_timesteps": config.n_timesteps,
                "final_episodes": study.evaluation.final_episodes,
                # Joint steps between the points of a curve of the training's own episodes; None for evaluations apart
                "online_every": study.evaluation.every if study.evaluation.online else None,
                "options": cell_options(study),
                "settings": config.settings,
            }
            # As it reads from a file, so that the two can be compared
            planned.append(PlannedCell(Cell(place), json.loads(json.dumps(record))))
    return planned


def cell_options(study: Study) -> dict[str, Any]:
    """
    Return the options with which the runs of a study are trained, without those of a single run.

    :param study: The study
    :return: Arguments of ``TrainOptions``
    """
    evaluation = study.evaluation
    return {
        **TrainOptions.defaults(TRAIN_KEYS),
        **study.train,
        "eval_freq": -1 if evaluation.online else evaluation.every,
        "eval_episodes": evaluation.episodes,
        "n_eval_envs": evaluation.copies,
    }


def check_folder_of_study(study: Study, folder: Path, planned: Sequence[PlannedCell]) -> None:
    """
    Check that what a folder holds already is of this study, with the same settings.

    :param study: The study
    :param folder: Its folder, which need not exist
    :param planned: Its cells
    :raises ConfigError: If a cell that has been begun had other settings, or its record is damaged
    """
    if not folder.is_dir():
        return
    differing = []
    for each in planned:
        if not each.cell.path.is_file():
            continue
        before = each.cell.read()
        if before["attempts"] > 0 and (differences := _differences(before, each.record)):
            differing.append((each.cell, differences))
    if differing:
        cell, differences = differing[0]
        more = f" (and in {len(differing) - 1} more cells)" if len(differing) > 1 else ""
        raise ConfigError(
            f"{study.source}: {cell.name} of {folder} was begun with other settings: {_listed(differences)}{more}. Put them"
            " back, give the study another name, or move these folders away."
        )


def _differences(before: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """Return what decides a result and has changed, in words."""
    kept = {name: value for name, value in before["options"].items() if name not in FREE_OPTIONS}
    options = {name: value for name, value in now["options"].items() if name not in FREE_OPTIONS}
    found = [
        f"{name} was {short(before.get(name))} and is {short(now[name])}"
        for name in ("study", "arm", "algo", "env", "seed", "final_episodes", "online_every")
        if before.get(name) != now[name]
    ]
    for old, new, names in (
        (kept, options, {"eval_freq": "every", "eval_episodes": "episodes", "n_eval_envs": "copies"}),
        (before["settings"], now["settings"], {}),
    ):
        # Keys in the order of the file, then those that have gone
        for name in [*new, *(name for name in old if name not in new)]:
            if name not in old or name not in new or old[name] != new[name]:
                values = [short(each[name]) if name in each else "not given" for each in (old, new)]
                found.append(f"{names.get(name, name)} was {values[0]} and is {values[1]}")
    return found


def _listed(differences: list[str]) -> str:
    more = f", and {len(differences) - _SHOWN} more" if len(differences) > _SHOWN else ""
    return f"{', '.join(differences[:_SHOWN])}{more}"


def prepare_folder(study: Study, folder: Path, planned: Sequence[PlannedCell], retry: bool) -> list[str]:
    """
    Write the study's file and the records of its cells, as far as they are not there.

    A finished cell whose episodes are lost or damaged is evaluated again. Cells that another process runs are left alone.

    :param study: The study
    :param folder: Its folder
    :param planned: Its cells, which have been checked
    :param retry: Whether cells that failed are to be run again
    :return: What is worth saying, a line each
    :raises ConfigError: If nothing can be written
    """
    said: list[str] = []
    try:
        make_folder(folder)
        sweep_temporary_files(folder)
        with replaced_file(folder / STUDY_FILE, "w", encoding="utf-8") as file:
            yaml.safe_dump(study.to_data(), file, sort_keys=False, allow_unicode=True)
        for each in planned:
            said += _prepare(each, retry)
    except OSError as error:
        raise ConfigError(f"-f: cannot write in the folder {short(str(folder))} ({reason_of(error)}).") from None
    known = {each.cell.folder for each in planned}
    others = [cell for cell in all_cells(folder) if cell.folder not in known]
    if others:
        said.append(
            f"{len(others)} cells of {folder} are not in {study.source} (any more), such as {others[0].name}: left out."
        )
    return said


def _prepare(each: PlannedCell, retry: bool) -> list[str]:
    cell = each.cell
    said: list[str] = []
    if cell.path.is_file() and cell.read()["status"] == FINISHED:
        if (why := episodes_damage(cell)) is None:
            return []
        said = [f"{why} The final episodes of {cell.name} are played again."]
    make_folder(cell.folder)
    with cell.held() as held:
        if not held:
            return []
        sweep_temporary_files(cell.folder)
        if not cell.path.is_file():
            cell.create(each.record)
            return []
        before = cell.read()
        if before["attempts"] == 0:
            if before != each.record:
                cell.create(each.record)
            return []
        options = {**before["options"], **{name: each.record["options"][name] for name in FREE_OPTIONS}}
        now = {**before, "options": options}
        if said or (before["status"] == FAILED and retry):
            now.update(status=WAITING, error=None)
        if now != before:
            cell.write(now)
    return said


def episodes_damage(cell: Cell) -> str | None:
    """
    Return why the episodes of a finished cell cannot be read.

    :param cell: The cell
    :return: A sentence, or None if they can
    """
    # Imported here, since pyarrow may be missing
    from sb3_belief.report.episodes import read_episodes_table

    try:
        read_episodes_table(cell.episodes)
    except (OSError, ValueError) as error:
        return f"{error}" if str(error).endswith(".") else f"{error}."
    return None


def write_table(folder: Path, cells: Sequence[Cell]) -> Path:
    """
    Write the episodes of all finished cells into one file.

    :param folder: Folder of the study
    :param cells: Its cells
    :return: The file
    :raises ConfigError: If one cannot be read, or the file not be written
    """
    from sb3_belief.report.episodes import read_episodes_table, write_episodes_table

    finished = [cell for cell in cells if cell.path.is_file() and cell.read()["status"] == FINISHED]
    path = folder / EPISODES_FILE
    try:
        return write_episodes_table(read_episodes_table([cell.episodes for cell in finished]), path)
    except (OSError, ValueError) as error:
        reason = reason_of(error) if isinstance(error, OSError) else error
        raise ConfigError(f"{path} cannot be written: {reason}") from None
