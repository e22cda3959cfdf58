"""The commands report, plot and runs."""

import pytest
from rich.console import Console

from sb3_belief.cli.main import main
from sb3_belief.study import listing
from tests.study.folders import write_run


@pytest.fixture
def logs(tmp_path):
    for seed in range(2):
        write_run(tmp_path / "logs" / "ippo" / f"x_{seed}", "ippo", "x", seed, [0.2, 0.4])
    return tmp_path / "logs"


def test_runs_are_listed_in_lines_for_pipes(logs, capsys):
    note = "uses the global state in training"
    write_run(logs / "ippo" / "x_8", "ippo", "x", 8, [0.2], status="failed", timesteps=500, started="?", note=note)
    killed = write_run(logs / "ippo" / "x_9", "ippo", "[red]", 9, [0.25], status="running", timesteps=None)
    (killed / "evaluations.npz").unlink()
    (killed / "progress.csv").write_text("a,time/total_timesteps\n1,200\n1,40")
    broken = write_run(logs / "ippo" / "x_A", "ippo", "x", 0, [0.2])
    (broken / "run.json").write_text("{")
    (broken / "evaluations.npz").write_text("PK")
    assert main(["runs", str(logs)]) == 0
    lines = [line.split("\t") for line in capsys.readouterr().out.splitlines()]
    assert lines[0] == ["run", "algorithm", "environment", "seed", "status", "joint steps", "last score", "age", "training"]
    rows = {line[0]: line[1:] for line in lines[1:]}
    assert len(rows) == 5
    assert rows["ippo/x_0"][:4] == ["ippo", "x", "0", "finished"] and rows["ippo/x_0"][4] == "2,000"
    assert rows["ippo/x_0"][5].startswith("success 0.")
    assert rows["ippo/x_8"][3:5] == ["failed", "500 of 1,000"] and rows["ippo/x_8"][6].endswith("s")
    assert rows["ippo/x_9"][3:5] == ["killed", "200 of 1,000"] and rows["ippo/x_9"][5] == "success 1.000 (learning)"
    assert rows["ippo/x_0"][7] == "decentralised" and rows["ippo/x_8"][7] == note
    # Nothing is known of a damaged one
    assert rows["ippo/x_A"][7] == "-" and rows["ippo/x_A"][2:4] == ["-", "damaged"] and rows["ippo/x_A"][5] == "damaged"


def test_runs_are_a_table_on_a_terminal(logs, capsys, monkeypatch):
    write_run(logs / "ippo" / "x_9", "ippo", "[red]", 9, [0.25])
    monkeypatch.setattr(listing, "Console", lambda: Console(force_terminal=True, width=120, color_system=None))
    assert main(["runs", str(logs)]) == 0
    out = capsys.readouterr().out
    assert "3 runs in" in out and "[red]" in out and "finished" in out and "\t" not in out


def test_plots_are_drawn_of_what_there_is(logs, tmp_path, capsys, monkeypatch):
    pytest.importorskip("vl_convert", reason="figures are drawn by vl-convert-python")
    from sb3_belief.study import plotting

    drawn = {}
    monkeypatch.setattr(plotting, "write_figure", lambda spec, path: drawn.update({path.name: spec}))
    assert main(["plot", str(logs), "-o", str(tmp_path / "a.png")]) == 0
    spec = drawn.pop("a.png")
    assert spec["title"] == "x, greedy evaluations" and [row["x"] for row in spec["datasets"]["centres"]] == [[1000, 2000]]
    seeds = {row["seed"]: row["y"] for row in spec["datasets"]["seeds"]}
    assert spec["datasets"]["centres"][0]["y"][1] == (seeds["0"][1] + seeds["1"][1]) / 2
    # A run that has not been evaluated twice: then the episodes of all, and another environment has its own picture
    write_run(logs / "ippo" / "x_5", "ippo", "x", 5, [0.3])
    write_run(logs / "ippo" / "y_1", "ippo", "mpe/y", 5, [0.3, 0.3])
    assert main(["plot", str(logs), "-o", str(tmp_path / "a.png"), "--quantity", "return", "--title", "T"]) == 0
    assert set(drawn) == {"a-x.png", "a-mpe-y.png"} and drawn["a-x.png"]["title"] == "T"
    assert {row["seed"] for row in drawn["a-x.png"]["datasets"]["seeds"]} == {"0", "1", "5"}
    assert capsys.readouterr().out.splitlines()[-1].endswith("a-mpe-y.png")


def test_a_plot_is_a_picture(logs, tmp_path):
    pytest.importorskip("vl_convert", reason="figures are drawn by vl-convert-python")
    assert main(["plot", str(logs), "-o", str(tmp_path / "new" / "a.svg")]) == 0
    assert "greedy evaluations" in (tmp_path / "new" / "a.svg").read_text()


def test_what_does_not_fit_is_refused_in_a_line(logs, tmp_path, capsys, monkeypatch):
    pytest.importorskip("vl_convert", reason="figures are drawn by vl-convert-python")
    (tmp_path / "empty").mkdir()
    for words, message in (
        (["plot", str(tmp_path / "empty")], "plot: no run in"),
        (["plot", str(logs), "-o", "a.gif"], "-o: 'a.gif' must end in .svg or .png"),
        (["runs", str(tmp_path / "nowhere")], "runs: no folder"),
        (["report", str(tmp_path / "nowhere")], "report: no folder"),
        (["report", str(tmp_path / "empty")], "holds no run and no study"),
    ):
        assert main(words) == 2
        error = capsys.readouterr().err
        assert error.startswith("Refused: ") and message in error and error.count("\n") == 1
    import sys

    monkeypatch.setitem(sys.modules, "vl_convert", None)
    assert main(["report", str(logs)]) == 2
    assert "vl-convert-python: pip install 'sb3-belief[study]'" in capsys.readouterr().err
    assert main(["plot", str(logs)]) == 2
    assert "vl-convert-python: pip install 'sb3-belief[study]'" in capsys.readouterr().err


def test_a_report_says_what_it_found(logs, capsys):
    for package in ("pyarrow", "scipy", "vl_convert"):
        pytest.importorskip(package, reason="reports need the extra 'study'")
    assert main(["report", str(logs)]) == 0
    out = capsys.readouterr().out
    assert "On x, the interquartile mean of the success rate is ippo" in out and f"Report: {logs / 'report.html'}" in out
