"""Runs without a study: which of them compare, and the table of the episodes of their evaluations."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa

from sb3_belief.envs.suites import comma_separated
from sb3_belief.report.episodes import EPISODES
from sb3_belief.report.evaluations import EVALUATIONS, read_evaluations
from sb3_belief.study.groups import labels
from sb3_belief.study.reported import Reported, ReportedRun
from sb3_belief.study.run_reading import RunData, read_run, run_folders
from sb3_belief.study.tuning_folder import tuning_folders
from sb3_belief.zoo.errors import ConfigError, short

_GIVE = "give the folder of a study or a tuning, or one with runs"


def reported_logs(folder: Path) -> Reported:
    """
    Read the runs in a folder.

    Runs of one algorithm with the same settings in an environment are one group, over seeds; where settings differ, they are
    part of the group's name. Of finished runs with the same seed the newest counts.

    :param folder: The folder
    :return: What can be reported of them
    :raises ConfigError: If there is no run
    """
    data = [read_run(path) for path in run_folders(folder)]
    tunings = [short(str(path)) for path in tuning_folders(folder)]
    if not data:
        what = (
            f"only tunings: give one of them: {comma_separated(tunings, most=5)}"
            if tunings
            else f"no run and no study: {_GIVE}"
        )
        raise ConfigError(f"{short(str(folder))}: holds {what}.")
    names = labels(data, deciding=[run for run in data if not _why_not(run)])
    runs = [ReportedRun(each, label, why_not=_why_not(each)) for each, label in zip(data, names, strict=True)]
    rows: list[dict[str, Any]] = []
    newest = _newest(runs)
    for index, run in enumerate(runs):
        if not run.why_not and newest[run.arm, run.data.env, run.data.seed] is not run:
            runs[index] = replace(run, why_not="a newer run has the same settings and seed")
        elif not run.why_not:
            try:
                own = _rows(run, folder.name)
            except ValueError as error:
                own, why = [], str(error)
            else:
                why = "never evaluated"
            rows += own
            if not own:
                runs[index] = replace(run, why_not=why)
    arms = list(dict.fromkeys(run.arm for run in sorted(runs, key=lambda run: run.arm)))
    counted = [run.data for run in runs if not run.why_not]
    return Reported(
        name=folder.resolve().name or "runs",
        folder=folder,
        is_study=False,
        arms=arms,
        baseline=next((arm for arm in arms if arm.split(" ")[0] == "ippo"), None),
        runs=runs,
        table=pa.Table.from_pylist(rows, schema=EPISODES),
        evaluation_every=_common(counted, "eval_freq"),
        evaluation_episodes=_common(counted, "eval_episodes"),
        notices=[f"The trials of tunings are not compared here; each tuning has a report: {', '.join(tunings)}."]
        * bool(tunings),
    )


def _why_not(run: RunData) -> str:
    if run.status != "finished":
        return run.status
    if run.record.get("start_timesteps"):
        return "continues the training of another run"
    return "" if run.seed is not None else "its record has no seed"


def _newest(runs: Sequence[ReportedRun]) -> dict[tuple[str, str, int | None], ReportedRun]:
    """Return the newest finished run of each group and seed."""
    found: dict[tuple[str, str, int | None], ReportedRun] = {}
    for run in sorted((run for run in runs if not run.why_not), key=lambda run: str(run.data.record.get("started", ""))):
        found[run.arm, run.data.env, run.data.seed] = run
    return found


def _rows(run: ReportedRun, study: str) -> list[dict[str, Any]]:
    """Return the episodes of a run's evaluations."""
    try:
        evaluations = read_evaluations(run.data.folder)
    except ValueError as error:
        raise ValueError(f"its {EVALUATIONS} is damaged ({error.__cause__})") from error
    common = {
        "study": study,
        "arm": run.arm,
        "algorithm": run.data.algo,
        "environment": run.data.env,
        "seed": run.data.seed,
    }
    return [] if evaluations is None else [{**common, **row} for row in evaluations.rows()]


def _common(runs: Sequence[RunData], option: str) -> int | None:
    """Return an option of the runs, or None if they differ or do not say."""
    values = {run.record.get("options", {}).get(option) for run in runs}
    value = values.pop() if len(values) == 1 else None
    return value if isinstance(value, int) else None
