"""The table of a study's episodes: its columns, its files, and what statistics take of it."""

import os
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sb3_belief.common.durable_files import replaced_file
from sb3_belief.common.exceptions import first_line

try:
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.csv as pa_csv
    import pyarrow.parquet as pq
except ImportError as error:
    raise ImportError("Tables of episodes need pyarrow: pip install 'sb3-belief[study]'.") from error

#: The columns, one row an episode. Only ``success`` may be empty: its environment then reports none
EPISODES = pa.schema(
    [
        pa.field("study", pa.string(), nullable=False),
        pa.field("arm", pa.string(), nullable=False),
        pa.field("algorithm", pa.string(), nullable=False),
        pa.field("environment", pa.string(), nullable=False),
        pa.field("seed", pa.int64(), nullable=False),
        pa.field("phase", pa.string(), nullable=False),
        pa.field("checkpoint", pa.string(), nullable=False),
        pa.field("deterministic", pa.bool_(), nullable=False),
        pa.field("joint_steps", pa.int64(), nullable=False),
        pa.field("episode", pa.int64(), nullable=False),
        pa.field("episode_return", pa.float64(), nullable=False),
        pa.field("success", pa.float64()),
        pa.field("length", pa.int64(), nullable=False),
    ]
)
#: The weights that each phase evaluates: those of the moment while training, and at the end the last and the best ones
CHECKPOINTS = {"training": ("current",), "final": ("last", "best")}
#: The column of each quantity that statistics are made of
COLUMNS = {"return": "episode_return", "success": "success"}
# What no two rows may share
_KEY = ["study", "arm", "environment", "seed", "phase", "checkpoint", "deterministic", "joint_steps", "episode"]
_SUFFIXES = (".parquet", ".csv")


def read_episodes_table(paths: str | os.PathLike[str] | Iterable[str | os.PathLike[str]]) -> pa.Table:
    """
    Read one or several files of episodes into one table.

    A Parquet file that was cut off is always noticed. A CSV file that was cut off is noticed unless the cut is just after
    the end of a line.

    :param paths: A file or several, ``.parquet`` or ``.csv``
    :return: Their rows in the columns of ``EPISODES``, in the order of the files
    :raises FileNotFoundError: If there is no such file
    :raises ValueError: If a file is damaged, has other columns, has values that are not allowed, or if two rows are about the
        same episode. The message has the path
    """
    files = [Path(paths)] if isinstance(paths, (str, os.PathLike)) else [Path(path) for path in paths]
    table = pa.concat_tables([EPISODES.empty_table(), *(_read(path) for path in files)])
    where = ", ".join(map(str, files)) if len(files) < 4 else f"{files[0]} and {len(files) - 1} more files"
    _check_doubles(table, where)
    return table


def write_episodes_table(table: pa.Table, path: str | os.PathLike[str]) -> Path:
    """
    Write a table of episodes to a file, as a whole or not at all.

    :param table: The table. ``pyarrow.Table.from_pylist(rows, schema=EPISODES)`` makes one of a list of dictionaries
    :param path: The file; ``.csv`` at its end makes it CSV, ``.parquet`` Parquet. Its folder must exist
    :return: The path
    :raises ValueError: If the suffix is another one, or the table has other columns, values that are not allowed or two rows
        about the same episode
    :raises OSError: If the file cannot be written
    """
    target = Path(path)
    _check_suffix(target)
    table = _checked(table, str(target))
    _check_doubles(table, str(target))
    with replaced_file(target) as file:
        if target.suffix == ".csv":
            pa_csv.write_csv(table, file)
        else:
            pq.write_table(table, file, compression="zstd")
    return target


def episodes_of(table: pa.Table, checkpoint: str, deterministic: bool) -> pa.Table:
    """
    Return the episodes of one kind of evaluation.

    :param table: The episodes
    :param checkpoint: The weights that were evaluated: ``"best"``, ``"last"``, or ``"current"`` for those while training
    :param deterministic: Whether the team acted greedily
    :return: Their rows
    :raises ValueError: For another checkpoint, or if two studies hold the same arm on the same environment
    """
    allowed = [name for names in CHECKPOINTS.values() for name in names]
    if checkpoint not in allowed:
        raise ValueError(f"checkpoint is {checkpoint!r}; it must be one of {', '.join(map(repr, allowed))}.")
    _check_studies(table)
    return table.filter((pc.field("checkpoint") == checkpoint) & (pc.field("deterministic") == deterministic))


def scores(
    table: pa.Table, quantity: str = "return", checkpoint: str = "best", deterministic: bool = True
) -> dict[str, dict[str, dict[int, float]]]:
    """
    Return the score of each run: the mean over its final episodes.

    :param table: The episodes
    :param quantity: ``"return"`` or ``"success"``
    :param checkpoint: Which weights count: ``"best"`` or ``"last"``, or ``"current"`` for the last evaluation while training,
        for runs that have had no final one
    :param deterministic: Whether the episodes in which the team acted greedily count, or those with sampled actions
    :return: {environment: {arm: {seed: score}}}, each in the order of its first row, seeds ascending. For successes without
        the environments that report none
    :raises ValueError: For another quantity or checkpoint, if two studies hold the same arm on the same environment, if a run
        has two final evaluations of one checkpoint or a score that is not finite, or if no environment reports successes
    """
    found: dict[str, dict[str, dict[int, float]]] = {}
    for (environment, arm, seed), evaluations in _evaluations(table, quantity, checkpoint, deterministic).items():
        if checkpoint != "current" and len(evaluations) > 1:
            raise ValueError(
                f"Seed {seed} of {arm!r} on {environment!r} has final evaluations of {checkpoint!r} weights after "
                f"{', '.join(map(str, sorted(evaluations)))} joint steps: keep one of them."
            )
        value = evaluations[max(evaluations)]
        if not np.isfinite(value):
            raise ValueError(
                f"Seed {seed} of {arm!r} on {environment!r} has a mean {quantity} of {value}, which no statistic can take: "
                f"leave the run out and say so."
            )
        found.setdefault(environment, {}).setdefault(arm, {})[seed] = value
    return {
        environment: {arm: dict(sorted(seeds.items())) for arm, seeds in arms.items()} for environment, arms in found.items()
    }


def curves(
    table: pa.Table, quantity: str = "return", deterministic: bool = True
) -> dict[str, dict[str, tuple[np.ndarray, np.ndarray, list[int]]]]:
    """
    Return the evaluations while training: a curve for each run, of the means over the episodes of each evaluation.

    :param table: The episodes
    :param quantity: ``"return"`` or ``"success"``
    :param deterministic: Whether the episodes in which the team acted greedily count, or those with sampled actions
    :return: {environment: {arm: (steps, values, seeds)}} with the joint steps of the evaluations ``[k]`` ascending, the values
        ``[seeds, k]`` and the seeds ascending. NaN where a seed was not evaluated after so many steps
    :raises ValueError: For another quantity, if two studies hold the same arm on the same environment, or if no environment
        reports successes
    """
    groups: dict[str, dict[str, dict[int, dict[int, float]]]] = {}
    for (environment, arm, seed), evaluations in _evaluations(table, quantity, "current", deterministic).items():
        groups.setdefault(environment, {}).setdefault(arm, {})[seed] = evaluations
    found: dict[str, dict[str, tuple[np.ndarray, np.ndarray, list[int]]]] = {}
    for environment, arms in groups.items():
        for arm, of_seeds in arms.items():
            seeds = sorted(of_seeds)
            steps = sorted({step for evaluations in of_seeds.values() for step in evaluations})
            values = np.array([[of_seeds[seed].get(step, np.nan) for step in steps] for seed in seeds])
            found.setdefault(environment, {})[arm] = np.array(steps, dtype=np.int64), values, seeds
    return found


def _check_suffix(path: Path) -> None:
    if path.suffix not in _SUFFIXES:
        raise ValueError(f"{path}: episodes are in files whose names end in {' or '.join(_SUFFIXES)}.")


def _read(path: Path) -> pa.Table:
    _check_suffix(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such file of episodes.")
    try:
        # read_table() would take columns from names of folders, such as "lr=0.1"
        table = pq.ParquetFile(path).read() if path.suffix == ".parquet" else _read_csv(path)
    except pa.ArrowException as error:
        raise ValueError(f"{path}: is damaged ({first_line(error)}): write it again or leave it out.") from error
    return _checked(table, str(path))


def _read_csv(path: Path) -> pa.Table:
    data = path.read_bytes()
    # Even a number that can be read may be the beginning of another one
    if not data.endswith(b"\n"):
        raise pa.ArrowInvalid("the last line has no end")
    # An empty field is a missing number. "nan" is a number here
    options = pa_csv.ConvertOptions(
        column_types={field.name: field.type for field in EPISODES}, null_values=[""], strings_can_be_null=True
    )
    return pa_csv.read_csv(pa.BufferReader(data), convert_options=options)


def _checked(table: pa.Table, where: str) -> pa.Table:
    """Return a table in the types and order of the schema, or refuse it."""
    missing = [name for name in EPISODES.names if name not in table.column_names]
    surplus = sorted({name for name in table.column_names if name not in EPISODES.names})
    if missing or surplus or table.num_columns != len(EPISODES.names):
        words = [f"lacks {', '.join(missing)}"] * bool(missing) + [f"has also {', '.join(surplus)}"] * bool(surplus)
        raise ValueError(
            f"{where}: {' and '.join(words) or 'has a column twice'}: the columns of episodes are {', '.join(EPISODES.names)}."
        )
    try:
        table = table.select(EPISODES.names).cast(EPISODES)
    # A missing value where none may be is a ValueError too
    except (pa.ArrowException, ValueError) as error:
        raise ValueError(f"{where}: has a value of another type than its column's ({first_line(error)}).") from error
    for name in EPISODES.names:
        if name != "success" and table[name].null_count:
            raise ValueError(f"{where}: {table[name].null_count} rows have no {name}; only success may be missing.")
    pairs = table.group_by(["phase", "checkpoint"]).aggregate([]).to_pylist()
    for pair in pairs:
        if pair["checkpoint"] not in CHECKPOINTS.get(pair["phase"], ()):
            allowed = "; ".join(f"{phase}: {', '.join(names)}" for phase, names in CHECKPOINTS.items())
            raise ValueError(f"{where}: checkpoint {pair['checkpoint']!r} in phase {pair['phase']!r}; there are {allowed}.")
    limits = pc.min_max(table["success"]).as_py()
    if limits["min"] is not None and not 0 <= limits["min"] <= limits["max"] <= 1:
        raise ValueError(f"{where}: success goes from {limits['min']} to {limits['max']}; it must be between 0 and 1.")
    return table


def _check_doubles(table: pa.Table, where: str) -> None:
    counts = table.group_by(_KEY).aggregate([([], "count_all")])
    doubled = counts.filter(pc.greater(counts["count_all"], 1))
    if doubled.num_rows:
        first: Mapping[str, Any] = doubled.slice(0, 1).to_pylist()[0]
        words = ", ".join(f"{name} {first[name]}" for name in _KEY)
        more = f", and {doubled.num_rows - 1} more are" if doubled.num_rows > 1 else " is"
        raise ValueError(f"{where}: the episode with {words}{more} there more than once: give each file of a study once.")


def _evaluations(
    table: pa.Table, quantity: str, checkpoint: str, deterministic: bool
) -> dict[tuple[str, str, int], dict[int, float]]:
    """Return {(environment, arm, seed): {joint steps: mean over the episodes of that evaluation}}."""
    if quantity not in COLUMNS:
        raise ValueError(f"quantity is {quantity!r}; it must be one of {', '.join(map(repr, COLUMNS))}.")
    column = COLUMNS[quantity]
    chosen = episodes_of(table, checkpoint, deterministic)
    reported = _reported(chosen) if quantity == "success" else None
    groups = chosen.group_by(["environment", "arm", "seed", "joint_steps"], use_threads=False)
    found: dict[tuple[str, str, int], dict[int, float]] = defaultdict(dict)
    for row in groups.aggregate([(column, "mean")]).to_pylist():
        if reported is None or row["environment"] in reported:
            found[row["environment"], row["arm"], row["seed"]][row["joint_steps"]] = row[f"{column}_mean"]
    return dict(found)


def _reported(table: pa.Table) -> set[str]:
    """Return the environments that report successes, in all episodes or in none."""
    found, groups = set(), table.group_by("environment").aggregate([("success", "count"), ([], "count_all")])
    for row in groups.to_pylist():
        if row["success_count"] not in (0, row["count_all"]):
            raise ValueError(
                f"Only {row['success_count']} of {row['count_all']} episodes on {row['environment']!r} report whether they "
                f"succeeded: take quantity='return'."
            )
        if row["success_count"]:
            found.add(row["environment"])
    if table.num_rows and not found:
        raise ValueError("No environment reports successes: take quantity='return'.")
    return found


def _check_studies(table: pa.Table) -> None:
    studies: dict[tuple[str, str], list[str]] = defaultdict(list)
    for row in table.group_by(["environment", "arm", "study"], use_threads=False).aggregate([]).to_pylist():
        studies[row["environment"], row["arm"]].append(row["study"])
    for (environment, arm), names in studies.items():
        if len(names) > 1:
            raise ValueError(
                f"Studies {_listed(names)} all hold {arm!r} on {environment!r}: keep one of them, or rename an arm."
            )


def _listed(names: Sequence[str]) -> str:
    return ", ".join(map(repr, names))
