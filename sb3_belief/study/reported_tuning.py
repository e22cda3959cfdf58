"""The folder of a tuning, as a report reads it: also while the tuning runs, and without Optuna."""

import csv
import io
import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from sb3_belief.report.tuning_page.facts import SearchedSetting, TrialFacts, TuningFacts
from sb3_belief.study.trials_table import BEST, COLUMNS, SEARCHED, STATES, setting_cell
from sb3_belief.study.tuning_space import SearchChoices, SearchRange
from sb3_belief.study.tuning_spec import load_tuning
from sb3_belief.zoo.errors import ConfigError, reason_of
from sb3_belief.zoo.run_files import SPEC, TABLE


def reported_tuning(folder: Path) -> TuningFacts:
    """
    Read the folder of a tuning.

    :param folder: The folder
    :return: What can be reported of it
    :raises ConfigError: If its file or its table of trials is damaged, or if there is no trial yet
    """
    spec = load_tuning(folder / SPEC)
    settings = [_setting(name, entry) for name, entry in spec.space.items()]
    trials = _trials(folder / TABLE, settings)
    if not trials:
        raise ConfigError(f"report: the tuning {str(folder)!r} has no trial yet: sb3-belief tune begins them.")
    return TuningFacts(
        name=spec.name,
        algorithm=spec.algo,
        environment=spec.env,
        settings=settings,
        trials=trials,
        n_trials=spec.n_trials,
        objective=spec.objective,
        seeds=spec.seeds,
        last_evaluations=spec.last_evaluations,
        every=spec.evaluation["every"],
        episodes=spec.evaluation["episodes"],
        n_timesteps=spec.n_timesteps,
        sampler=spec.sampler,
        pruner=spec.pruner,
        specification=replace(spec, source="").to_yaml(),
        best_settings=_text(folder / BEST),
    )


def _setting(name: str, entry: SearchRange | SearchChoices) -> SearchedSetting:
    if isinstance(entry, SearchChoices):
        return SearchedSetting(name, "choice", choices=[setting_cell(each) for each in entry.choices])
    is_integer = isinstance(entry.low, int) and entry.schedule is None
    return SearchedSetting(
        name,
        "integer" if is_integer else "number",
        ends=(entry.low, entry.high),
        is_log=entry.log,
        step=entry.step,
        falls=entry.schedule is not None,
    )


def _trials(path: Path, settings: list[SearchedSetting]) -> list[TrialFacts]:
    try:
        text = path.read_text(encoding="utf-8") if path.is_file() else ""
        reader = csv.DictReader(io.StringIO(text, newline=""), strict=True)
        rows = list(reader)
    except (OSError, ValueError, csv.Error) as error:
        raise _damaged(path, reason_of(error) if isinstance(error, OSError) else str(error)) from None
    if not text:
        return []
    expected = [*COLUMNS, *(f"{SEARCHED}{each.name}" for each in settings)]
    if reader.fieldnames != expected:
        raise _damaged(path, f"its columns are not {', '.join(expected)}")
    if not text.endswith("\n"):
        raise _damaged(path, "its last line has no end")
    found = []
    for index, row in enumerate(rows):
        try:
            if None in row or None in row.values():
                raise ValueError("has too many or too few values")
            found.append(_trial(row, settings))
        except (ValueError, TypeError, RecursionError) as error:
            raise _damaged(path, f"row {index + 1}: {error}") from None
    return found


def _trial(row: Mapping[str, str], settings: list[SearchedSetting]) -> TrialFacts:
    if row["state"] not in STATES:
        raise ValueError(f"the state {row['state'][:40]!r} is none of {', '.join(STATES)}")
    return TrialFacts(
        number=int(row["trial"]),
        state=row["state"],
        settings={each.name: _drawn(row[SEARCHED + each.name], each) for each in settings if row[SEARCHED + each.name]},
        value=float(row["value"]) if row["value"] and math.isfinite(float(row["value"])) else None,
        seed_values=[float(each) for each in json.loads(row["seed_values"])],
        evaluations=[float(each) for each in json.loads(row["evaluations"])],
        repeats=int(row["repeats"]) if row["repeats"] else None,
        started=row["started"],
        seconds=float(row["seconds"]) if row["seconds"] else None,
        error=row["error"],
    )


def _drawn(text: str, setting: SearchedSetting) -> float | int | str:
    if setting.kind == "choice":
        return text
    return int(text) if setting.kind == "integer" else float(text.removeprefix("lin_"))


def _damaged(path: Path, why: str) -> ConfigError:
    return ConfigError(f"{path}: is damaged ({why}): sb3-belief tune with the tuning's file writes it anew.")


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, ValueError):
        return ""
