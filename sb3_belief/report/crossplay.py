"""Each run's agents among the agents of each other run: the table of what was measured, and what it says."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sb3_belief.report.adaptation import Row, estimate_text
from sb3_belief.report.figures.matrix import matrix_spec
from sb3_belief.report.statistics import IntervalEstimate, estimate

#: Name of the table in the folder of a measurement, and of the one with the cells of the matrices
CROSSPLAY, MATRIX = "crossplay.csv", "crossplay_matrix.csv"
CROSSPLAY_TEXTS = ("environment", "run", "others", "agent")
CROSSPLAY_NUMBERS = ("steps", "repetition", "episodes", "return", "success")


def crossplay_runs(rows: Sequence[Row]) -> list[str]:
    """
    Return the names of the runs.

    :param rows: The table
    :return: The names, in order
    """
    return list(dict.fromkeys(row["run"] for row in rows))


def crossplay_matrix(rows: Sequence[Row], steps: float) -> np.ndarray:
    """
    Return the mean returns of agents of each run among the agents of each.

    :param rows: The table
    :param steps: After how many observed steps
    :return: A row for each run whose agent it is, a column for each run of the others, ``[n, n]``
    """
    names = crossplay_runs(rows)
    cells: dict[tuple[str, str], list[float]] = {}
    for row in rows:
        if row["steps"] == steps:
            cells.setdefault((row["run"], row["others"]), []).append(row["return"])
    return np.array([[np.mean(cells[run, others]) for others in names] for run in names])


def crossplay_cells(rows: Sequence[Row]) -> list[tuple[str, str, int, IntervalEstimate]]:
    """
    Return the cells of all matrices, with 95 % intervals over repetitions of the mean over agents.

    :param rows: The table
    :return: For each the run whose agent it is, the run of the others, the steps observed before, and the mean return
    """
    names = crossplay_runs(rows)
    cells: dict[tuple[float, str, str], dict[float, list[float]]] = {}
    for row in rows:
        repetitions = cells.setdefault((row["steps"], row["run"], row["others"]), {})
        repetitions.setdefault(row["repetition"], []).append(row["return"])
    return [
        (run, others, int(steps), estimate([np.array([np.mean(of) for of in cells[steps, run, others].values()])], "mean"))
        for steps in _steps(rows)
        for run in names
        for others in names
    ]


def crossplay_estimates(matrix: np.ndarray) -> dict[str, IntervalEstimate]:
    """
    Return means over runs, with 95 % intervals over the runs whose agents meet the others.

    :param matrix: As of :func:`crossplay_matrix`, of at least two runs
    :return: ``own``, the diagonal; ``others``, of each run the mean among all other runs; and the ``loss`` between the two
    """
    own = matrix.diagonal()
    others = (matrix.sum(axis=1) - own) / (len(matrix) - 1)
    return {name: estimate([each], "mean") for name, each in (("own", own), ("others", others), ("loss", own - others))}


def crossplay_figures(rows: Sequence[Row]) -> dict[str, tuple[str, Mapping[str, Any]]]:
    """
    Return the pictures of the matrices, all with the same colours.

    :param rows: The table
    :return: {name of the files: (what it shows, specification)}
    """
    names, environment = crossplay_runs(rows), rows[0]["environment"]
    matrices = {steps: crossplay_matrix(rows, steps) for steps in _steps(rows)}
    domain = min(float(each.min()) for each in matrices.values()), max(float(each.max()) for each in matrices.values())
    figures: dict[str, tuple[str, Mapping[str, Any]]] = {}
    for steps, matrix in matrices.items():
        title = f"{environment}, {'before observing' if steps == 0 else f'after {steps:.0f} observed steps'}"
        values = {(run, others): float(matrix[i, j]) for i, run in enumerate(names) for j, others in enumerate(names)}
        spec = matrix_spec(title, values, names, "all others are of", "the agent is of", domain)
        figures[f"crossplay-{steps:.0f}"] = title, spec
    return figures


def crossplay_sentences(rows: Sequence[Row]) -> str:
    """
    Say in a paragraph how agents do among the agents of other runs.

    :param rows: The table
    :return: The paragraph
    """
    names, said = crossplay_runs(rows), []
    for steps in _steps(rows):
        found = crossplay_estimates(crossplay_matrix(rows, steps))
        when = "Before observing" if steps == 0 else f"After {steps:.0f} observed steps"
        said.append(
            f"{when} the team's return is {estimate_text(found['own'])} where an agent is among its own,"
            f" {estimate_text(found['others'])} where it is among those of another run: a loss of"
            f" {estimate_text(found['loss'])}."
        )
    n_repetitions = len({row["repetition"] for row in rows})
    return (
        f"{len(names)} runs on {rows[0]['environment']}, each with each ({n_repetitions} repetitions, 95 % intervals over"
        " runs). " + " ".join(said)
    )


def _steps(rows: Sequence[Row]) -> list[float]:
    return sorted({row["steps"] for row in rows})
