"""What a tuning has found: the table of its trials, and the best settings as a section of a configuration file."""

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_belief.common.durable_files import replaced_file
from sb3_belief.common.versions import __version__
from sb3_belief.study.tuning_spec import TuningSpec
from sb3_belief.zoo.run_files import TABLE

if TYPE_CHECKING:
    from optuna.trial import FrozenTrial

#: The settings of the best trial
BEST = "best.yml"
#: Columns of the table before those of the searched settings, which are named ``search/<setting>``
COLUMNS = ("trial", "state", "objective", "value", "seed_values", "evaluations", "repeats", "started", "seconds", "error")
#: What stands before the names of these
SEARCHED = "search/"
#: How a trial can be
STATES = ("complete", "pruned", "failed", "killed", "running", "waiting")
_STATES = {"COMPLETE": "complete", "PRUNED": "pruned", "RUNNING": "running", "WAITING": "waiting"}


def write_trials(folder: Path, spec: TuningSpec, trials: "Sequence[FrozenTrial]") -> None:
    """
    Write the table of the trials.

    ``state`` is complete, pruned, running, waiting (to be repeated), killed (repeated by a later trial) or failed. ``value``
    is the objective, of a pruned trial that of its last evaluation. ``seed_values`` and ``evaluations`` are JSON: the
    objective of each run that finished, and that of each evaluation.

    :param folder: Folder of the tuning
    :param spec: Its specification
    :param trials: The trials
    """
    space = spec.space
    with replaced_file(folder / TABLE, "w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*COLUMNS, *(f"{SEARCHED}{name}" for name in space)])
        for each in trials:
            attributes = each.user_attrs
            failed = "killed" if attributes.get("killed") else "failed"
            drawn = {**each.system_attrs.get("fixed_params", {}), **each.params}
            writer.writerow(
                [
                    each.number,
                    _STATES.get(each.state.name, failed),
                    spec.objective,
                    "" if each.value is None else repr(float(each.value)),
                    json.dumps(attributes.get("scores", [])),
                    json.dumps([each.intermediate_values[step] for step in sorted(each.intermediate_values)]),
                    attributes.get("repeats", ""),
                    "" if each.datetime_start is None else each.datetime_start.isoformat(timespec="seconds"),
                    attributes.get("seconds", ""),
                    attributes.get("error", ""),
                    *(setting_cell(space[name].setting(drawn[name])) if name in drawn else "" for name in space),
                ]
            )


def best_trial(trials: "Sequence[FrozenTrial]") -> "FrozenTrial | None":
    """
    Return the best complete trial, of equal ones the first.

    :param trials: The trials
    :return: The best one; None if none is complete
    """
    complete = [each for each in trials if each.state.name == "COMPLETE" and each.value is not None]
    return max(complete, key=lambda each: (each.value, -each.number), default=None)


def write_best(folder: Path, spec: TuningSpec, trials: "Sequence[FrozenTrial]", extra_packages: tuple[str, ...] = ()) -> None:
    """
    Write the best trial's settings as a configuration file, if any trial is complete.

    The number of joint steps in it is that of the configuration file, since a tuning's runs are often shorter.

    :param folder: Folder of the tuning
    :param spec: Its specification
    :param trials: The trials
    :param extra_packages: See ``names.resolve``
    """
    best = best_trial(trials)
    if best is None:
        return
    import optuna

    n_complete = sum(each.state.name == "COMPLETE" for each in trials)
    length = spec.config(best.params, extra_packages).n_timesteps
    lines = [
        f"Settings of trial {best.number} of the tuning {spec.name!r}, the best of {n_complete} complete ones by its mean"
        f" {spec.objective}, {best.value:.6g},",
        f"in evaluations of {spec.evaluation['episodes']} episodes, of runs of {length} joint steps with the seeds"
        f" {', '.join(map(str, spec.seeds))}. It is the best of many, so that other seeds will give less.",
        f"sb3-belief {__version__}, Optuna {optuna.__version__}. To train with it:",
        f"  sb3-belief train --algo {spec.algo} --env {spec.env} -conf {BEST}",
    ]
    section = spec.config(best.params, extra_packages, with_n_timesteps=False).to_yaml()
    with replaced_file(folder / BEST, "w", encoding="utf-8") as file:
        file.write("".join(f"# {line}\n" for line in lines) + section)


def setting_cell(value: Any) -> str:
    """
    Return a setting as the table has it.

    :param value: The setting
    :return: A text as it is, and anything else as JSON
    """
    return value if isinstance(value, str) else json.dumps(value)
