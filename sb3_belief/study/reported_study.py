"""The folder of a study, as a report reads it: also while the study runs, and if a part of it is damaged."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import yaml

from sb3_belief.common.exceptions import first_line
from sb3_belief.report.episodes import EPISODES, read_episodes_table
from sb3_belief.study.cell_record import CELL_RECORD, CELLS, EPISODES_FILE
from sb3_belief.study.reported import Reported, ReportedRun
from sb3_belief.study.run_reading import DAMAGED, ERROR, RunData, read_run, run_folders
from sb3_belief.study.study_folder import STUDY_FILE
from sb3_belief.zoo.errors import ConfigError


def is_study(folder: Path) -> bool:
    """
    Return whether a folder is that of a study.

    :param folder: The folder
    :return: Whether it has a study's file
    """
    return (folder / STUDY_FILE).is_file()


def reported_study(folder: Path) -> Reported:
    """
    Read the folder of a study.

    :param folder: The folder
    :return: What can be reported of it
    :raises ConfigError: If the study's file is damaged
    """
    specification = _specification(folder / STUDY_FILE)
    cells = sorted((folder / CELLS).glob(f"*/*/seed_*/{CELL_RECORD}"))
    order = _names(specification.get("algorithms"))
    environments = _names(specification.get("environments"))
    seeds = specification.get("seeds")
    runs, tables = [], []
    for path in cells:
        run, table = _cell(path.parent)
        planned = run.arm in order and run.data.env in environments
        if table is not None and not (planned and (not isinstance(seeds, list) or run.data.seed in seeds)):
            run, table = replace(run, why_not="no longer in the study's file"), None
        runs.append(run)
        if table is not None:
            tables.append(table)
    arms = [*order, *sorted({run.arm for run in runs} - set(order))]
    environments += sorted({run.data.env for run in runs} - set(environments))
    # The table's order is that of the page
    runs.sort(key=lambda run: (environments.index(run.data.env), arms.index(run.arm), run.data.seed or 0))
    table = pa.concat_tables([EPISODES.empty_table(), *tables]).sort_by([("arm", "ascending"), ("seed", "ascending")])
    table = pa.concat_tables(
        [
            EPISODES.empty_table(),
            *(table.filter(pa.compute.field("environment") == env) for env in dict.fromkeys(environments)),
        ]
    )
    evaluation = specification.get("evaluation")
    evaluation = evaluation if isinstance(evaluation, dict) else {}
    ablations = specification.get("ablations")
    baseline = specification.get("baseline")
    return Reported(
        name=str(specification.get("name") or folder.resolve().name),
        folder=folder,
        is_study=True,
        arms=arms,
        baseline=baseline if baseline in arms else None,
        runs=runs,
        table=table,
        evaluation_every=_number(evaluation, "every"),
        evaluation_episodes=_number(evaluation, "episodes"),
        final_episodes=_number(evaluation, "final_episodes"),
        is_online=evaluation.get("online") is True,
        ablations=_panels(ablations),
    )


def _specification(path: Path) -> dict[str, Any]:
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError, RecursionError) as error:
        raise ConfigError(
            f"{path}: is damaged ({first_line(error)}): run sb3-belief study again, which writes it anew."
        ) from None
    if not isinstance(data, dict):
        raise ConfigError(f"{path}: is damaged: it is no mapping. Run sb3-belief study again, which writes it anew.")
    return data


def _cell(folder: Path) -> tuple[ReportedRun, pa.Table | None]:
    """Return what the folder of a cell tells, and its episodes if it counts."""
    record = _record(folder / CELL_RECORD)
    newest = max(run_folders(folder), key=lambda path: path.stat().st_mtime, default=None)
    run = None if newest is None else read_run(newest)
    # A cell that is damaged is still told by its path
    arm = str(record.get("arm", folder.parent.parent.name))
    seed = record.get("seed", folder.name.removeprefix("seed_"))
    data = RunData(
        folder=folder if run is None else run.folder,
        status=str(record.get("status", DAMAGED)),
        algo=str(record.get("algo", arm)),
        env=str(record.get("env", folder.parent.name)),
        seed=int(seed) if str(seed).isdecimal() else None,
        record={**({} if run is None else run.record), **_times(record)},
        settings={} if run is None else run.settings,
    )
    error = _text(folder / ERROR) or str(record.get("error") or "")
    if data.status != "finished":
        return ReportedRun(data, arm, why_not=data.status, error=error), None
    try:
        return ReportedRun(data, arm, error=error), read_episodes_table(folder / EPISODES_FILE)
    except (OSError, ValueError) as damage:
        return ReportedRun(data, arm, why_not=f"its episodes cannot be read: {damage}", error=error), None


def _record(path: Path) -> dict[str, Any]:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return record if isinstance(record, dict) else {}


def _times(record: Mapping[str, Any]) -> dict[str, Any]:
    seconds = record.get("seconds")
    return {"seconds": seconds} if isinstance(seconds, int | float) and seconds else {}


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""


def _names(value: Any) -> list[str]:
    return [str(each) for each in value] if isinstance(value, dict | list) else []


def _number(mapping: Mapping[str, Any], key: str) -> int | None:
    value = mapping.get(key)
    return value if isinstance(value, int) else None


def _panels(value: Any) -> dict[str, Sequence[str]]:
    if not isinstance(value, dict):
        return {}
    return {str(title): [str(arm) for arm in arms] for title, arms in value.items() if isinstance(arms, list | tuple)}
