"""Reports of tunings, of which no package of the search is needed."""

import csv
import json
import sys

import pytest

for package in ("pyarrow", "scipy", "vl_convert"):
    pytest.importorskip(package, reason="reports need the extra 'study'")

from sb3_belief.cli.main import main  # noqa: E402
from sb3_belief.study.reporting import ReportOptions, write_report  # noqa: E402
from sb3_belief.zoo.errors import ConfigError  # noqa: E402
from tests.study.folders import write_run, write_tuning  # noqa: E402
from tests.study.test_reporting import Page  # noqa: E402


@pytest.fixture(scope="module")
def tuning(tmp_path_factory):
    return write_tuning(tmp_path_factory.mktemp("tunings") / "junction")


@pytest.fixture(scope="module")
def report(tuning):
    """Its report, without the package that searches, and what it says."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "optuna", None)
        return write_report(ReportOptions(str(tuning)))


def rows_of(path):
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_a_tuning_has_a_page_with_its_files(tuning, report):
    path, summary = report
    assert path == tuning / "report.html" and "is trial 4, with a mean return of" in summary
    page = Page(path)
    assert len(page.ids) == len(set(page.ids))
    for words in (
        "therefore too high",
        "n_epochs: 3",
        "1 trial failed; the table of trials says why.",
        "no memory </script> & <b>x</b>",
        "0.0001 to 0.01, on a logarithmic scale, falling linearly to 0",
        "plays 8 episodes greedily every 1,000 joint steps",
    ):
        assert words in page.shown
    files = path.with_name("report_files")
    figures = {"objective", "evaluations", *(f"setting-{name}" for name in ("learning_rate", "n_epochs", "gamma", "belief"))}
    figures.add("setting-policy_kwargs.net_arch")
    for suffix in ("svg", "png", "vl.json"):
        assert {each.name.removesuffix(f".{suffix}") for each in (files / "figures").glob(f"*.{suffix}")} == figures
    drawn, told = rows_of(tuning / "trials.csv"), rows_of(files / "tables" / "trials.csv")
    assert len(told) == len(drawn) == 12
    for one, other in zip(drawn, told, strict=True):
        assert (one["state"], one["value"], one["error"]) == (other["state"], other["value"], other["error"])
        assert one["search/learning_rate"].removeprefix("lin_") == other["search/learning_rate"]
        assert one["search/policy_kwargs.net_arch"] == other["search/policy_kwargs.net_arch"]


def test_only_what_has_ended_well_is_drawn(report):
    (holder,) = [text for text in Page(report[0]).scripts if text.startswith('{"objective')]

    kinds = {row["trial"]: row["arm"] for row in json.loads(holder)["objective"]["datasets"]["trials"]}
    assert kinds == {
        0: "complete",
        1: "complete",
        2: "complete",
        3: "pruned",
        4: "best",
        **dict.fromkeys(range(7, 11), "complete"),
    }


def test_a_tuning_without_a_complete_trial_has_a_page(tmp_path):
    folder = write_tuning(tmp_path / "young", n_trials=1)
    (folder / "best.yml").unlink()
    path, summary = write_report(ReportOptions(str(folder)))
    assert summary == "No trial is complete yet, so there is no best one. All trials: 1 running."
    page = Page(path)
    assert "figure" not in page.tags and "Copy these settings" not in page.shown and "running" in page.shown


def changed(text, *pairs):
    for old, new in pairs:
        assert old in text
        text = text.replace(old, new, 1)
    return text


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text[:-1], "its last line has no end"),
        (lambda text: text[:-5], "is damaged (unexpected end of data)"),
        (lambda text: text.replace("search/gamma", "search/beta"), "its columns are not trial, state"),
        (lambda text: changed(text, ("0,complete", "0,finished")), "row 1: the state 'finished' is none of complete, pruned"),
        (lambda text: changed(text, ("1,complete,return,", "1,complete,return,much")), "row 2: could not convert"),
        (lambda text: changed(text, ("4,complete,return,", "4,complete,")), "row 5: has too many or too few values"),
        (lambda text: changed(text, ('"[', '"{')), "row 1: "),
        (lambda text: "\xff\x00" + text, "trials.csv: is damaged ("),
        (lambda text: text.splitlines()[0] + "\n", "has no trial yet: sb3-belief tune begins them"),
        (lambda text: "", "has no trial yet"),
    ],
)
def test_a_damaged_table_is_said_in_a_line(tmp_path, capsys, change, message):
    folder = write_tuning(tmp_path / "x")
    path = folder / "trials.csv"
    path.write_text(change(path.read_text()), encoding="latin-1")
    assert main(["report", str(folder)]) == 2
    error = capsys.readouterr().err
    assert error.startswith("Refused: ") and message in error and error.count("\n") == 1
    assert not (folder / "report.html").exists() and not (folder / "report_files").exists()


def test_what_does_not_fit_a_tuning_is_refused(tuning, tmp_path):
    for options, message in (
        (ReportOptions(str(tuning), quantity="return"), r"--quantity: .* is a tuning, .*: leave --quantity out"),
        (ReportOptions(str(tuning), baseline="ippo"), r"--baseline: .* is a tuning, .*: leave --baseline out"),
        (ReportOptions(str(tuning), str(tuning / "tune.yml" / "x.html")), "-o: cannot write"),
    ):
        with pytest.raises(ConfigError, match=message):
            write_report(options)
    folder = write_tuning(tmp_path / "x")
    (folder / "tune.yml").write_text("algo: [")
    with pytest.raises(ConfigError, match=r"tune\.yml, line"):
        write_report(ReportOptions(str(folder)))


def trained(folder):
    """Write a tuning with the run of a trial."""
    write_tuning(folder)
    run = folder / "trials" / "0000" / "seed_1000" / "belief_ppo" / "junction_1"
    return write_run(run, "belief_ppo", "junction", 0, [0.1, 0.2], settings={"belief": "static"})


def test_a_tuning_among_runs_is_told_apart(tmp_path, capsys):
    logs = tmp_path / "logs"
    # The file of a tuning is no tuning: people keep theirs where they like
    logs.mkdir()
    (logs / "tune.yml").write_text("algo: ppo")
    for seed in range(2):
        write_run(logs / "belief_ppo" / f"junction_{seed}", "belief_ppo", "junction", seed, [0.3, 0.9])
    trained(logs / "tuning" / "tj")
    path, summary = write_report(ReportOptions(str(logs)))
    assert "interquartile mean of the success rate is belief_ppo 0." in summary
    page = Page(path)
    assert "The trials of tunings are not compared here; each tuning has a report: " in page.shown and "tj'." in page.shown
    assert len(rows_of(path.with_name("report_files") / "tables" / "runs.csv")) == 2
    assert main(["runs", str(logs)]) == 0
    said = capsys.readouterr()
    assert len(said.out.splitlines()) == 3 and "belief_ppo\tjunction" in said.out and "(static)" not in said.out
    assert said.err.startswith("The trials of the tuning ") and said.err.count("\n") == 1
    # Asked for by itself, the runs are there
    assert main(["runs", str(logs / "tuning" / "tj")]) == 0
    said = capsys.readouterr()
    assert len(said.out.splitlines()) == 2 and said.err == ""
    with pytest.raises(ConfigError, match=r"holds only tunings: give one of them: '.*tj'\."):
        write_report(ReportOptions(str(logs / "tuning")))
