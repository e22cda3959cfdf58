"""What the tables of adapting and of cross-play say, worked out by hand, and how a report shows them."""

from typing import Any

import numpy as np
import pytest

from sb3_belief.report.adaptation import (
    ADAPTATION,
    NUMBERS,
    TEXTS,
    adaptation_points,
    adaptation_sentences,
    read_rows,
    write_rows,
)
from sb3_belief.report.crossplay import CROSSPLAY
from sb3_belief.report.page.content import Table
from sb3_belief.report.study_page.adapting import adapting_sections


def row(partner, steps, value, role="team", repetition=0, **columns):
    texts = {"role": role, "run": "run_1", "environment": "game", "partner": partner, "type": "", "agent": ""}
    numbers = {"repetition": repetition, "steps": steps, "episodes": 4, "return": value, "success": None}
    return {**texts, **numbers, "accuracy": None, "base_rate": None, **columns}


def table():
    """Two partners and two repetitions, in which the agent closes half of the gap beside the one, and all beside the other."""
    rows = []
    for partner, blind, oracle, adapted in (("left", 0.0, 4.0, 2.0), ("right", 2.0, 6.0, 6.0)):
        for repetition, shift in enumerate((-0.5, 0.5)):
            rows += [
                row(partner, 0, blind + shift, repetition=repetition, accuracy=0.5, base_rate=0.5),
                row(partner, 800, adapted + shift, repetition=repetition, accuracy=0.9, base_rate=0.5),
                row(partner, 0, blind, "blind", repetition),
                row(partner, 0, oracle, "oracle", repetition),
            ]
    return rows


def test_the_curve_by_hand():
    curve = adaptation_points(table())
    points: dict[Any, Any] = {(point.partner, point.steps): point for point in curve}
    assert list(points) == [(partner, steps) for partner in ("all", "left", "right") for steps in (0, 800)]
    last = points["all", 800]
    assert last.score.value == 4 and last.skill.value == pytest.approx(0.4)
    # Means first, then the ratio: (4 - 1) / (5 - 1)
    assert last.share.value == 0.75 and last.share.low < 0.75 < last.share.high
    assert points["left", 800].regret.value == 2 and points["right", 800].regret.value == 0
    assert points["all", 0].share.value == 0
    assert "closes 0%, then 75%" in adaptation_sentences(table(), curve)
    assert "largest regret after 800 steps is 2, beside left" in adaptation_sentences(table(), curve)


def test_agents_are_averaged_before_repetitions():
    rows = [
        row("left", 0, value, agent=agent, repetition=r) for r in (0, 1) for agent, value in (("a", 1.0 + r), ("b", 3.0 + r))
    ]
    (point, _) = adaptation_points(rows)
    assert point.score.value == 2.5 and point.score.n_seeds == 2


def test_without_a_gap_there_is_no_share():
    rows = [{**each, "return": 1.0} if each["role"] == "oracle" else each for each in table()]
    points = adaptation_points(rows)
    assert all(point.share is None for point in points if point.partner == "all")
    assert "There is no gap between blind" in adaptation_sentences(rows, points)


def test_a_table_is_read_as_it_was_written(tmp_path):
    write_rows(table(), tmp_path / ADAPTATION)
    assert read_rows(tmp_path / ADAPTATION, TEXTS, NUMBERS) == table()
    (tmp_path / ADAPTATION).write_text("role,run\nteam,x\n")
    with pytest.raises(ValueError, match="is damaged"):
        read_rows(tmp_path / ADAPTATION, TEXTS, NUMBERS)


def test_a_report_shows_what_lies_in_its_folder(tmp_path):
    assert adapting_sections(tmp_path) == []
    for name in ("run_1", "broken"):
        (tmp_path / name / "adaptation").mkdir(parents=True)
    write_rows(table(), tmp_path / "run_1" / "adaptation" / ADAPTATION)
    (tmp_path / "broken" / "adaptation" / ADAPTATION).write_text("nothing\n")
    pairs: Any = [
        {"environment": "game", "run": run, "others": others, "agent": agent, "steps": steps, "repetition": r, "episodes": 4}
        | {"return": (run == others) * (1 + (agent == "b") - r / 2), "success": None}
        for run in "xyz"
        for others in "xyz"
        for steps in (0, 800)
        for agent in "ab"
        for r in (0.0, 1.0)
    ]
    write_rows(pairs, tmp_path / CROSSPLAY)
    sections: Any = adapting_sections(tmp_path)
    adapting, crossplay = sections
    assert "is damaged" in adapting.blocks[1]
    (shown,) = [block for block in adapting.blocks if isinstance(block, Table)]
    assert [each["share"] for each in shown.rows] == [0, 0.75, 0, 0.5, 0, 1]
    names = [
        figure.name
        for section in (adapting, crossplay)
        for block in section.blocks
        if isinstance(block, list)
        for figure in block
    ]
    assert len(names) == len(set(names)) == 4
    assert "0 [0, 0] where it is among those of another run: a loss of 1.25" in crossplay.blocks[1].replace("\n", " ")
    cells = crossplay.blocks[-2][0].spec["data"]["values"]
    assert {(cell["row"], cell["column"]): cell["value"] for cell in cells}["x", "y"] == 0.0
    assert np.isfinite([cell["value"] for cell in cells]).all()
    table_of_cells: Any = crossplay.blocks[-1]
    assert len(table_of_cells.rows) == 3 * 3 * 2
    own = next(each for each in table_of_cells.rows if (each["run"], each["others"], each["steps"]) == ("y", "y", 800))
    # Of 1.5 and 1.0, the means over both agents in both repetitions
    assert own["return"] == 1.25 and own["return_95"][0] < 1.0 and own["return_95"][1] > 1.5
