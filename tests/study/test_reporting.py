import csv
import json
import re
import zipfile
from html.parser import HTMLParser
from urllib.parse import unquote

import numpy as np
import pytest
import yaml

for package in ("pyarrow", "scipy", "vl_convert"):
    pytest.importorskip(package, reason="reports need the extra 'study'")

import pyarrow as pa  # noqa: E402

from sb3_belief.report.episodes import EPISODES, read_episodes_table, scores, write_episodes_table  # noqa: E402
from sb3_belief.study.reporting import ReportOptions, write_report  # noqa: E402
from sb3_belief.zoo.errors import ConfigError  # noqa: E402
from tests.study.folders import ERROR, VERSIONS, cell_folder, write_cell_record, write_run, write_study  # noqa: E402

VOID = {"meta", "link", "input", "br", "hr", "img"}
ARMS = {"ippo": ("ippo", 0.4), "dynamic": ("belief_ppo", 0.8)}
ENVIRONMENTS = ["junction", "lbf/forest-v3"]


class Page(HTMLParser):
    """A page, whose elements must be closed in order."""

    def __init__(self, path):
        super().__init__()
        self.open: list[str] = []
        self.words: list = []
        self.addresses: list = []
        self.ids: list = []
        self.scripts: list = []
        self.tags: list = []
        self.text = path.read_text(encoding="utf-8")
        self.feed(self.text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        self.tags.append(tag)
        self.addresses += [value for key, value in attributes.items() if key in ("href", "src", "action", "data")]
        self.ids += [attributes["id"]] if "id" in attributes else []
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        # Only foreign elements may be
        assert "svg" in self.open, f"{tag} is closed at once"

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        (self.scripts if self.open and self.open[-1] in ("script", "style") else self.words).append(data)

    @property
    def shown(self):
        return " ".join(" ".join(self.words).split())


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    folder = write_study(
        tmp_path_factory.mktemp("studies") / "games",
        ARMS,
        ENVIRONMENTS,
        n_seeds=3,
        n_evaluations=4,
        episodes=16,
        final_episodes=24,
        ablations={"Table 2 <parts>": ["ippo", "dynamic"]},
    )
    failed = cell_folder(folder, "dynamic", "junction", 2)
    (failed / "episodes.parquet").unlink()
    (failed / "error.txt").write_text(ERROR)
    write_cell_record(failed, arm="dynamic", algo="belief_ppo", env="junction", seed=2, status="failed", error="ValueError")
    for seed, status in ((3, "waiting"), (4, "running")):
        cell = cell_folder(folder, "ippo", "junction", seed)
        write_cell_record(cell, arm="ippo", algo="ippo", env="junction", seed=seed, status=status)
    half = cell_folder(folder, "ippo", "lbf/forest-v3", 2) / "episodes.parquet"
    half.write_bytes(half.read_bytes()[:200])
    damaged = cell_folder(folder, "dynamic", "lbf/forest-v3", 7)
    damaged.mkdir()
    (damaged / "cell.json").write_text('{"arm": ')
    run = cell_folder(folder, "dynamic", "junction", 0) / "belief_ppo" / "junction_1"
    (run / "viewer.html").write_text("viewer")
    return folder


@pytest.fixture(scope="module")
def report(study):
    path, summary = write_report(ReportOptions(str(study)))
    assert path == study / "report.html" and "interquartile mean of the success rate" in summary
    return path


@pytest.fixture(scope="module")
def page(report):
    return Page(report)


def files(report):
    return report.with_name("report_files")


def test_the_page_is_whole_and_asks_nothing_of_a_network(report, page):
    assert len(page.ids) == len(set(page.ids))
    assert report.stat().st_size < 15e6
    paths = [address for address in page.addresses if not address.startswith("#")]
    paths.remove("data:,")
    for address in paths:
        assert not re.match(r"[a-z]+:|//", address, re.IGNORECASE)
        assert (report.parent / unquote(address)).is_file(), address
    ours = (
        "".join(page.words) + page.text[: page.text.index("window.vegaEmbed")].partition("<style>")[2].partition("</style>")[0]
    )
    assert "http" not in ours and "@import" not in ours and "url(" not in ours
    assert "default-src 'none'" in page.text.replace("&#x27;", "'")


def test_runs_that_do_not_count_are_named(page):
    assert "1 run (failed) does not count: dynamic on junction, seed 2." in page.shown
    assert "1 run (waiting) does not count: ippo on junction, seed 3." in page.shown
    assert "1 run (running) does not count: ippo on junction, seed 4." in page.shown
    assert "1 run (damaged) does not count: dynamic on lbf-forest-v3, seed 7." in page.shown
    assert "its episodes cannot be read" in page.shown


def test_tables_are_csv_files(study, report):
    def read(name):
        with open(files(report) / "tables" / f"{name}.csv", newline="") as file:
            return list(csv.DictReader(file))

    found = scores(read_episodes_table(study / "episodes.parquet"), "success", "best")
    results = {(row["environment"], row["arm"]): row for row in read("results")}
    assert len(results) == 6
    of_forest = found["lbf/forest-v3"]["dynamic"]
    assert len(of_forest) == 3
    assert float(results["lbf/forest-v3", "dynamic"]["iqm"]) == pytest.approx(np.mean(list(of_forest.values())))
    assert [results["junction", arm]["seeds"] for arm in ("ippo", "dynamic")] == ["3", "2"]
    assert results["junction", "ippo"]["verdict"] == "" and results["junction", "dynamic"]["verdict"] in (
        "better",
        "undecided",
    )
    runs = read("runs")
    assert len(runs) == 15 and {row["status"] for row in runs} == {"finished", "failed", "waiting", "running", "damaged"}
    assert {row["package"]: row["version"] for row in read("versions")} == VERSIONS


def test_every_table_says_what_is_not_decentralised(tmp_path):
    note = "uses the global state in training"
    folder = write_study(tmp_path / "mixed", {"ippo": ("ippo", 0.5), "central": ("qmix", 0.6)}, ["junction"], n_seeds=2)
    for path in folder.glob("cells/central/**/run.json"):
        path.write_text(json.dumps({**json.loads(path.read_text()), "note": note}))
    path, _ = write_report(ReportOptions(str(folder)))
    assert f"central {note}." in Page(path).shown
    for table, column in (("results", "trained"), ("other-evaluations", "trained"), ("runs", "note")):
        with open(files(path) / "tables" / f"{table}.csv", newline="") as file:
            said = {row["arm"]: row[column] for row in csv.DictReader(file)}
        assert said == {"ippo": "", "central": note}, table
    said_of_runs = {path.stem.rsplit("-", 1)[0]: note in Page(path).shown for path in (files(path) / "runs").glob("*.html")}
    assert {name.split("-")[0]: said for name, said in said_of_runs.items()} == {"ippo": False, "central": True}


def test_figures_are_files_and_hold_what_the_page_holds(report, page):
    (holder,) = [text for text in page.scripts if text.startswith('{"scores')]
    specs = json.loads(holder)
    for name, spec in specs.items():
        svg, png = ((files(report) / "figures" / f"{name}{suffix}").read_bytes() for suffix in (".svg", ".png"))
        assert svg.startswith(b"<svg") and png.startswith(b"\x89PNG"), name
        of_file = json.loads((files(report) / "figures" / f"{name}.vl.json").read_text())
        assert of_file["datasets"] == spec["datasets"]
    assert len(specs) == len(list((files(report) / "figures").glob("*.svg"))) > 12
    assert "ablation-Table-2-parts-junction" in specs and "belief-accuracy-junction" in specs


def test_each_run_has_a_page(study, report):
    pages = {path.stem: path for path in (files(report) / "runs").glob("*.html")}
    assert len(pages) == 15
    for path in pages.values():
        Page(path)
    failed = Page(pages["dynamic-junction-2"])
    assert "</script> & <b>no memory</b>" in failed.shown and "does not count in the comparison: failed" in failed.shown
    whole = Page(pages["dynamic-junction-0"])
    assert "n_timesteps: 4000" in whole.shown and "stable-baselines3 2.9.2" in whole.shown and "--seed 0" in whole.shown
    (viewer,) = [address for address in whole.addresses if address.endswith("viewer.html")]
    assert (pages["dynamic-junction-0"].parent / viewer).read_text() == "viewer"
    assert "../../report.html" in whole.addresses and "../vega.js" in whole.addresses


def test_options_of_a_report(study, tmp_path):
    path, summary = write_report(ReportOptions(str(study), str(tmp_path / "new" / "page.htm"), "return", "dynamic"))
    assert path.is_file() and (tmp_path / "new" / "page_files" / "vega.js").is_file()
    assert "normalised return" in summary and "ippo is" in summary
    for options, message in (
        (ReportOptions(str(study), baseline="ipo"), r"--baseline: unknown algorithm 'ipo'\. Did you mean 'ippo'\?"),
        (ReportOptions(str(study), str(tmp_path / "page.pdf")), r"-o: .*page\.pdf' must end in \.html"),
        (ReportOptions(str(tmp_path / "nowhere")), "report: no folder .*nowhere"),
        (ReportOptions(str(tmp_path / "new")), "holds no run and no study"),
        (ReportOptions(str(study), str(study / "study.yml" / "page.html")), "-o: cannot make the folder"),
    ):
        with pytest.raises(ConfigError, match=message):
            write_report(options)


def test_a_study_that_has_just_begun_has_a_page(tmp_path):
    folder = write_study(tmp_path / "young", ARMS, [])
    write_cell_record(
        cell_folder(folder, "ippo", "junction", 0), arm="ippo", algo="ippo", env="junction", seed=0, status="waiting"
    )
    path, summary = write_report(ReportOptions(str(folder)))
    assert summary.startswith("No run counts yet, so there is nothing to compare")
    assert "1 run (waiting) does not count: ippo on junction, seed 0." in Page(path).shown
    (folder / "study.yml").write_text("name: [")
    with pytest.raises(ConfigError, match=r"study\.yml: is damaged .*: run sb3-belief study again"):
        write_report(ReportOptions(str(folder)))


def test_the_trainings_own_episodes_count_where_nothing_else_was_evaluated(tmp_path):
    folder = write_study(tmp_path / "own", ARMS, ENVIRONMENTS[:1], n_seeds=3, n_evaluations=4)
    keys = {"online": True, "every": 1000, "final_episodes": 64}
    specification = yaml.safe_load((folder / "study.yml").read_text())
    (folder / "study.yml").write_text(yaml.safe_dump({**specification, "evaluation": keys}))
    for path in folder.glob("cells/*/*/*/episodes.parquet"):
        rows = read_episodes_table(path).to_pylist()
        own = [{**row, "deterministic": False} for row in rows if row["phase"] == "training"]
        own += [row for row in rows if row["checkpoint"] == "last" and not row["deterministic"]]
        write_episodes_table(pa.Table.from_pylist(own, schema=EPISODES), path)
    path, summary = write_report(ReportOptions(str(folder)))
    assert summary.startswith("On junction, the interquartile mean of the success rate is dynamic 0.")
    page = Page(path)
    assert "The episodes of the training count themselves, with sampled actions: a point of a learning curve" in page.shown
    assert "in the episodes of the training" in page.shown and "best team" not in page.shown
    with open(files(path) / "tables" / "results.csv", newline="", encoding="utf-8") as file:
        read = {row["arm"]: float(row["iqm"]) for row in csv.DictReader(file)}
    table = read_episodes_table(folder / "episodes.parquet")
    for arm, of_seeds in scores(table, "success", "last", False)["junction"].items():
        assert read[arm] == pytest.approx(np.mean(list(of_seeds.values())))
    assert not (files(path) / "tables" / "other-evaluations.csv").exists()


def test_cells_that_are_no_longer_planned_do_not_count(tmp_path):
    folder = write_study(tmp_path / "smaller", ARMS, ["junction"], n_seeds=3, n_evaluations=2)
    text = (folder / "study.yml").read_text()
    (folder / "study.yml").write_text(text.replace("seeds:\n- 0\n- 1\n- 2\n", "seeds: [0, 1]\n"))
    path, _ = write_report(ReportOptions(str(folder)))
    shown = Page(path).shown
    assert "2 runs (no longer in the study's file) do not count" in shown and "with 2 seeds each (4 runs" in shown


def test_names_of_all_kinds_are_text(tmp_path):
    evil = '"><img src=x onerror=alert(1)></script>'
    folder = write_study(
        tmp_path / "evil", {evil.replace("/", "_"): ("ippo", 0.5), "b": ("ippo", 0.7)}, ["junction"], n_seeds=2
    )
    specification = (folder / "study.yml").read_text().replace("name: evil", f"name: '{evil}'")
    (folder / "study.yml").write_text(specification)
    path, _ = write_report(ReportOptions(str(folder)))
    page = Page(path)
    assert "img" not in page.tags and evil in page.shown
    (holder,) = [text for text in page.scripts if text.startswith('{"scores')]
    assert "onerror" in holder and "<" not in holder


@pytest.fixture
def logs(tmp_path):
    folder = tmp_path / "logs"
    for seed in range(3):
        write_run(folder / "ippo" / f"junction_{seed}", "ippo", "junction", seed, [0.2, 0.4])
        write_run(
            folder / "belief_ppo" / f"junction_{seed}",
            "belief_ppo",
            "junction",
            seed,
            [0.3, 0.9],
            settings={"belief": "static"},
        )
    return folder


def test_runs_without_a_study_are_grouped_and_their_last_evaluation_counts(logs):
    lists = {"n_steps": 8, "policy_kwargs": {"net_arch": [8]}}
    write_run(
        logs / "belief_ppo" / "junction_8", "belief_ppo", "junction", 0, [0.5, 0.5], settings={"belief": "static", **lists}
    )
    again = write_run(logs / "ippo" / "junction_7", "ippo", "junction", 1, [0.1, 1.0], started="2027-01-01T00:00:00+0000")
    write_run(logs / "ippo" / "junction_9", "ippo", "junction", 5, [0.1], status="interrupted")
    write_run(logs / "ippo" / "junction_10", "ippo", "junction", 6, [0.1], start_timesteps=100)
    (write_run(logs / "ippo" / "junction_11", "ippo", "junction", 7, [0.1, 0.1]) / "evaluations.npz").write_bytes(b"PK")
    (write_run(logs / "ippo" / "junction_12", "ippo", "junction", 8, [0.1, 0.1]) / "evaluations.npz").unlink()
    (write_run(logs / "ippo" / "junction_13", "ippo", "junction", 9, [0.1, 0.1]) / "run.json").write_text("{")
    path, _ = write_report(ReportOptions(str(logs)))
    page = Page(path)
    for words in (
        "ippo on junction, seed 1.",
        "a newer run has the same settings and seed",
        "1 run (interrupted) does not count: ippo",
        "continues the training of another run",
        "its evaluations.npz is damaged",
        "1 run (never evaluated) does not count",
        "1 run (damaged) does not count",
        "the last evaluation during each training counts",
        "belief_ppo (static, n_steps=8, policy_kwargs.net_arch=[8])",
    ):
        assert words in page.shown, words
    with open(path.with_name("report_files") / "tables" / "runs.csv", newline="") as file:
        rows = {row["run"]: row for row in csv.DictReader(file)}
    with np.load(again / "evaluations.npz") as data:
        assert float(rows["ippo/junction_7"]["score"]) == data["successes"][-1].mean()
    assert rows["ippo/junction_1"]["score"] == "" and len(rows) == 13


def test_a_report_leaves_runs_as_they_are(logs):
    before = {path: path.read_bytes() for path in logs.rglob("*") if path.is_file()}
    write_report(ReportOptions(str(logs), str(logs.parent / "out" / "report.html")))
    assert {path: path.read_bytes() for path in logs.rglob("*") if path.is_file()} == before
    assert not zipfile.is_zipfile(logs.parent / "out" / "report.html")
