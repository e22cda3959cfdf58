"""Export of a study's episodes in the JSON format of marl-eval (Gorsane et al. 2022, github.com/instadeepai/marl-eval)."""

import json
import math
import os
from collections import defaultdict
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_belief.common.durable_files import replaced_file
from sb3_belief.report.episodes import COLUMNS, episodes_of

if TYPE_CHECKING:
    import pyarrow as pa

# {(environment, arm): {seed: {joint steps: {metric: values of the episodes}}}}
_Evaluations = dict[tuple[str, str], dict[int, dict[int, dict[str, list[float]]]]]


def marl_eval_data(
    table: "pa.Table",
    *,
    checkpoint: str = "best",
    deterministic: bool = True,
    suites: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    """
    Return the episodes in the nested form that marl-eval reads.

    Its "tasks" are our environments, its "algorithms" our arms. It aggregates over the tasks of one "environment". A step
    holds the returns and, where all environments report them, the successes of one evaluation while training, and
    ``absolute_metrics`` those of the final evaluation. It can only read as many runs and evaluations of one arm as of
    another. So evaluations that not all runs of an environment have had are left out, and other gaps are refused.

    :param table: The episodes
    :param checkpoint: The weights of ``absolute_metrics``, ``"best"`` or ``"last"``. The protocol asks for the best ones, and
        for ten times as many episodes as in an evaluation while training
    :param deterministic: Whether the episodes in which the team acted greedily are exported, or those with sampled actions.
        Where there are no evaluations while training with sampled actions, the greedy ones are taken
    :param suites: {our environment: marl-eval's environment}; None for the name of the study for all
    :return: {environment: {task: {algorithm: {run: {step: {"step_count": ..., metric: [...]}}}}}}
    :raises ValueError: If the episodes do not fit into the format. The message says which
    """
    final = _grouped(episodes_of(table, checkpoint, deterministic))
    training = _grouped(episodes_of(table, "current", deterministic)) or _grouped(episodes_of(table, "current", True))
    if not final:
        raise ValueError(
            f"There are no final episodes of {checkpoint!r} weights with deterministic={deterministic} to export."
        )
    metrics = _metrics(final, training)
    _check_names({environment for environment, _ in final}, {arm for _, arm in final})
    seeds = _common_seeds(final)
    studies: dict[str, str] = dict(zip(table["environment"].to_pylist(), table["study"].to_pylist(), strict=True))
    data: dict[str, Any] = {}
    counts: dict[str, tuple[str, int]] = {}
    for environment in dict.fromkeys(each for each, _ in final):
        suite = (suites or {}).get(environment, studies[environment])
        arms = [arm for each, arm in final if each == environment]
        steps = _common_steps(training, environment, arms, seeds)
        first, count = counts.setdefault(suite, (environment, len(steps)))
        if count != len(steps):
            raise ValueError(
                f"marl-eval needs equally many evaluations in all tasks of {suite!r}: {first!r} has {count}, "
                f"{environment!r} has {len(steps)}. Export them apart, or give them suites of their own."
            )
        for arm in arms:
            runs = {
                f"seed_{seed}": {
                    **{
                        f"step_{index}": {"step_count": step, **_of(training[environment, arm][seed][step], metrics)}
                        for index, step in enumerate(steps, 1)
                    },
                    "absolute_metrics": _of(_only(final, environment, arm, seed), metrics),
                }
                for seed in seeds
            }
            data.setdefault(suite, {}).setdefault(environment, {})[arm] = runs
    _check_arms(data)
    return data


def write_marl_eval(table: "pa.Table", path: str | os.PathLike[str], **options: Any) -> Path:
    """
    Write the episodes to a JSON file that marl-eval reads.

    :param table: The episodes
    :param path: The file; its folder must exist
    :param options: Further arguments of ``marl_eval_data``
    :return: The path
    :raises ValueError: If the episodes do not fit into the format
    :raises OSError: If the file cannot be written
    """
    text = json.dumps(marl_eval_data(table, **options), allow_nan=False, indent=1)
    with replaced_file(path, "w", encoding="utf-8") as file:
        file.write(text + "\n")
    return Path(path)


def _grouped(table: "pa.Table") -> _Evaluations:
    found: _Evaluations = {}
    names = ["environment", "arm", "seed", "joint_steps", *COLUMNS.values()]
    for environment, arm, seed, step, *values in zip(*(table[name].to_pylist() for name in names), strict=True):
        steps = found.setdefault((environment, arm), {}).setdefault(seed, {})
        metrics = steps.setdefault(step, defaultdict(list))
        for metric, value in zip(COLUMNS, values, strict=True):
            if value is not None:
                if not math.isfinite(value):
                    raise ValueError(
                        f"Seed {seed} of {arm!r} on {environment!r} has a {metric} of {value}: leave the run out."
                    )
                metrics[metric].append(value)
    return found


def _metrics(*parts: _Evaluations) -> list[str]:
    """Return the metrics that all evaluations have."""
    all_metrics = [
        metrics for part in parts for seeds in part.values() for steps in seeds.values() for metrics in steps.values()
    ]
    return [metric for metric in COLUMNS if all(metrics.get(metric) for metrics in all_metrics)]


def _of(evaluation: Mapping[str, list[float]], metrics: Iterable[str]) -> dict[str, list[float]]:
    return {metric: list(evaluation[metric]) for metric in metrics}


def _only(final: _Evaluations, environment: str, arm: str, seed: int) -> dict[str, list[float]]:
    evaluations = final[environment, arm][seed]
    if len(evaluations) > 1:
        raise ValueError(f"Seed {seed} of {arm!r} on {environment!r} has several final evaluations: keep one of them.")
    return next(iter(evaluations.values()))


def _check_names(environments: set[str], arms: set[str]) -> None:
    for names in (environments, arms):
        lowered: dict[str, str] = {}
        for name in sorted(names):
            if lowered.setdefault(name.lower(), name) != name:
                raise ValueError(f"marl-eval makes all names lower case: rename {name!r} or {lowered[name.lower()]!r}.")
    commas = sorted(arm for arm in arms if "," in arm)
    if commas:
        raise ValueError(f"marl-eval allows no comma in the name of an algorithm: rename {', '.join(map(repr, commas))}.")


def _common_seeds(final: _Evaluations) -> list[int]:
    """Return the seeds, which must be the same everywhere: marl-eval looks for the first arm's runs in all others."""
    (first, seeds), *others = final.items()
    for other, found in others:
        if set(found) != set(seeds):
            raise ValueError(
                f"marl-eval needs the same runs everywhere: {first[1]!r} on {first[0]!r} has the seeds {sorted(seeds)}, and "
                f"{other[1]!r} on {other[0]!r} {sorted(found)}. Finish the study, or export a part of it."
            )
    return sorted(seeds)


def _common_steps(training: _Evaluations, environment: str, arms: list[str], seeds: list[int]) -> list[int]:
    sets = [set(training.get((environment, arm), {}).get(seed, {})) for arm in arms for seed in seeds]
    steps = sorted(set.intersection(*sets))
    if not steps:
        raise ValueError(f"The runs on {environment!r} have no evaluation while training in common, which marl-eval needs.")
    return steps


def _check_arms(data: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> None:
    for suite, tasks in data.items():
        (first, arms), *others = tasks.items()
        for other, found in others:
            if set(found) != set(arms):
                raise ValueError(
                    f"marl-eval needs the same algorithms in all tasks of {suite!r}: {first!r} has {', '.join(arms)}, and "
                    f"{other!r} {', '.join(found)}. Export them apart, or give them suites of their own."
                )
