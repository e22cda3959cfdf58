import csv

import pytest

from sb3_belief.report.page.content import NOTHING, Column, Table, number_text, unique_name
from sb3_belief.report.page.files import write_csv

MINUS = "\u2212"


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.71234, "0.712"),
        (-0.5, f"{MINUS}0.500"),
        (0.0, "0.000"),
        (0.0003, "0.0003"),
        (123.456, "123.5"),
        (12345.6, "12346"),
        (2.5e7, "2.5e+07"),
        (float("nan"), NOTHING),
    ],
)
def test_numbers_for_readers(value, text):
    assert number_text(value) == text


def test_values_are_shown_and_sorted_by_kind():
    interval, count, link = Column("i", "I", "interval"), Column("c", "C", "count"), Column("l", "L", "link")
    assert (interval.text((0.1, 0.25)), interval.sort_key((0.1, 0.25))) == ("0.100 to 0.250", 0.1)
    assert (count.text(16640), count.sort_key(16640)) == ("16,640", 16640.0)
    assert (link.text(("run", "x.html")), link.sort_key(("run", "x.html"))) == ("run", "run")
    assert {column.text(None) for column in (interval, count, link)} == {NOTHING} and interval.sort_key(None) is None


def test_a_csv_file_has_all_values_in_full(tmp_path):
    columns = [
        Column("arm", "A"),
        Column("iqm", "Q", "number"),
        Column("ci", "I", "interval"),
        Column("n", "N", "count", shown=False),
    ]
    rows: list[dict] = [
        {"arm": 'a,"b"\n', "iqm": 1 / 3, "ci": (0.1, 1 / 7), "n": 5},
        {"arm": "ä", "iqm": None, "ci": None, "n": 0},
    ]
    write_csv(Table("t", "T", columns, rows), tmp_path / "t.csv")
    with open(tmp_path / "t.csv", newline="", encoding="utf-8") as file:
        read = list(csv.reader(file))
    assert read[0] == ["arm", "iqm", "ci_low", "ci_high", "n"]
    assert read[1][0] == 'a,"b"\n' and [float(text) for text in read[1][1:]] == [1 / 3, 0.1, 1 / 7, 5]
    assert read[2] == ["ä", "", "", "", "0"]


def test_names_lead_nowhere_and_differ_on_every_file_system():
    taken: set[str] = set()
    names = [unique_name(text, taken) for text in ("../../etc", "A b", "a-b", "...", "mpe/x_v3", "é" * 200)]
    assert names == ["etc", "A-b", "a-b-2", "x", "mpe-x_v3", "é" * 80]
