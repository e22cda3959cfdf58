"""Groups of runs that differ in nothing but their seeds, and the names of these groups."""

from collections.abc import Collection, Container, Iterator, Sequence
from typing import Any

from sb3_belief.study.run_reading import RunData

#: The setting that says how long a run is, which is no other group where runs are listed or their curves are drawn
LENGTH = ("n_timesteps",)


def labels(runs: Sequence[RunData], ignored: Container[str] = (), deciding: Collection[RunData] | None = None) -> list[str]:
    """
    Return the name of each run's group: its algorithm, its belief, and the settings in which runs of one algorithm in one
    environment differ.

    :param runs: The runs
    :param ignored: Settings that make no group, though they differ
    :param deciding: The runs whose differences make groups. None for all
    :return: A name for each
    """
    settings_of: dict[tuple[str, str], list[dict[str, str]]] = {}
    for run in runs if deciding is None else deciding:
        # A damaged configuration says nothing
        if run.settings:
            settings_of.setdefault((run.algo, run.env), []).append(dict(_flat(run.settings)))
    differing: dict[str, dict[str, None]] = {}
    for (algo, _), group in settings_of.items():
        keys = dict.fromkeys(key for settings in group for key in settings)
        differing.setdefault(algo, {}).update(
            dict.fromkeys(key for key in keys if len({settings.get(key) for settings in group}) > 1)
        )
    names: list[str] = []
    for run in runs:
        settings = dict(_flat(run.settings))
        chosen = [key for key in differing.get(run.algo, {}) if key in settings and key != "belief" and key not in ignored]
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
