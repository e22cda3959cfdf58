import json
import re
import webbrowser

import pytest

from sb3_belief.cli.main import main
from sb3_belief.zoo.enjoy import EnjoyOptions, enjoy

pytest.importorskip("pygame")

EASY = "traffic-junction-easy"
SETTINGS = ["n_envs:2", "n_steps:40", "batch_size:80", "n_epochs:1"]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    logs = tmp_path_factory.mktemp("logs")
    words = ["train", "--env", EASY, "-n", "160", "--seed", "1", "--eval-freq", "-1", "--verbose", "0", "-f", str(logs)]
    assert main([*words, "--save-freq", "80", "-params", *SETTINGS]) == 0
    (record,) = logs.glob("*/*/run.json")
    return record.parent


@pytest.fixture
def opened(monkeypatch):
    pages: list[str] = []

    def open_page(page):
        pages.append(page)
        return True

    monkeypatch.setattr(webbrowser, "open", open_page)
    return pages


def data_of(page):
    found = re.search(r'id="data">(.*?)</script>', page.read_text(encoding="utf-8"), re.DOTALL)
    assert found is not None
    return json.loads(found[1])


def test_watch_writes_the_page_into_the_run_and_opens_it(run, opened, capsys):
    assert main(["watch", str(run), "--seed", "7"]) == 0
    page = run / "viewer.html"
    assert opened == [page.as_uri()] and f"Wrote {page}" in capsys.readouterr().out
    data = data_of(page)
    assert data["title"] == EASY and "seed 7, greedy" in data["subtitle"] and "160 joint steps" in data["subtitle"]
    assert data["spaces"]["car_0"]["labels"] == [["gas", "brake"]] and len(data["episodes"]) == 1
    assert page.stat().st_size < 2_000_000
    # Cars are where they are drawn
    cars = [
        set(step["at"]) == {car for car, view in step["views"].items() if view["active"]}
        for step in data["episodes"][0]["steps"]
    ]
    assert all(cars) and any(step["at"] for step in data["episodes"][0]["steps"])


@pytest.mark.parametrize("words", [[], ["--stochastic"]])
def test_watch_shows_the_episodes_that_enjoy_plays(words, run, tmp_path, opened, capsys):
    output = tmp_path / "new folder" / "page.html"
    assert main(["watch", str(run), "--episodes", "2", "--output", str(output), "--no-open", "--agent", "car_2", *words]) == 0
    said = [line for line in capsys.readouterr().out.splitlines() if line.startswith("Episode")]
    outcome = enjoy(EnjoyOptions(str(run), episodes=2, deterministic=not words))
    assert said == [line for line in capsys.readouterr().out.splitlines() if line.startswith("Episode")] and len(said) == 2
    data = data_of(output)
    assert [episode["return"] for episode in data["episodes"]] == pytest.approx(outcome.returns.tolist(), rel=1e-3)
    assert data["agent"] == "car_2" and data["deterministic"] == (not words) and opened == []


def test_a_checkpoint_is_shown_in_the_folder_of_its_run(run, opened):
    checkpoint = min((run / "checkpoints").glob("*.zip"))
    (run / "viewer.html").unlink(missing_ok=True)
    assert main(["watch", str(checkpoint), "--env-kwargs", "arrival_rate:0.0"]) == 0
    assert (run / "viewer.html").exists() and not any(
        step["at"] for step in data_of(run / "viewer.html")["episodes"][0]["steps"]
    )


def test_without_a_browser_it_says_so(run, monkeypatch, capsys):
    monkeypatch.setattr(webbrowser, "open", lambda _: False)
    assert main(["watch", str(run)]) == 0
    assert "No browser was found" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--agent", "car_9"], "--agent: unknown agent 'car_9'. Did you mean"),
        (["--output", "page.pdf"], "--output: 'page.pdf' must end in .html"),
        (["--output", "/proc/page.html"], "--output: cannot write the file '/proc/page.html'"),
        (["--episodes", "500"], "--episodes: 500 are too many for one page: at most 20"),
        (["--episodes", "0"], "argument --episodes: must be a whole number from 1"),
        (["--device", "cuda:99"], "--device: 'cuda:99' is not available"),
        (["--env-kwargs", "vission:1"], "vission"),
    ],
)
def test_what_is_refused_is_refused_before_anything_is_written(words, message, run, opened, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (run / "viewer.html").unlink(missing_ok=True)
    status: int | str | None
    try:
        status = main(["watch", str(run), *words])
    except SystemExit as error:
        status = error.code
    assert status == 2 and message in capsys.readouterr().err
    assert not (run / "viewer.html").exists() and list(tmp_path.iterdir()) == [] and opened == []


def test_what_is_no_run_is_refused(tmp_path, capsys):
    assert main(["watch", str(tmp_path / "nothing")]) == 2
    assert "watch: no file or folder" in capsys.readouterr().err
    (tmp_path / "team.zip").write_bytes(b"PK\x03\x04 half")
    assert main(["watch", str(tmp_path / "team.zip"), "--env", EASY]) == 2
    said = capsys.readouterr().err
    assert "cannot be loaded" in said and len(said.splitlines()) == 1 and not (tmp_path / "viewer.html").exists()
