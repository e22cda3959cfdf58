"""Groups of runs that differ in nothing but their seeds, and the names of these groups."""

from collections.abc import Iterator, Sequence
from typing import Any

from sb3_belief.study.run_reading import RunData


def labels(runs: Sequence[RunData]) -> list[str]:
    """
    Return the name of each run's group: its algorithm, its belief, and the settings in which runs of one algorithm in one
    environment differ.

    :param runs: The runs
    :return: A name for each
    """
    flat = [dict(_flat(run.settings)) for run in runs]
    differing: dict[str, dict[str, None]] = {}
    for run, settings in zip(runs, flat, strict=True):
        keys = differing.setdefault(run.algo, {})
        for other, theirs in zip(runs, flat, strict=True):
            # A damaged configuration says nothing
            if settings and theirs and (other.algo, other.env) == (run.algo, run.env):
                keys.update(dict.fromkeys(key for key in [*settings, *theirs] if settings.get(key) != theirs.get(key)))
    names: list[str] = []
    for run, settings in zip(runs, flat, strict=True):
        chosen = [key for key in differing[run.algo] if key in settings and key != "belief"]
        words = [str(settings["belief"])] if "belief" in settings else []
        words += [f"{key}={settings[key]}" for key in chosen]
        names.append(f"{run.algo} ({', '.join(words)})" if words else run.algo)
    return names


def _flat(settings: dict[str, Any], before: str = "") -> Iterator[tuple[str, str]]:
    for key, value in settings.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{before}{key}.")
        else:
            yield f"{before}{key}", str(value)
