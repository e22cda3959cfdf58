"""Teams that are sent to a hub and taken from it; the hub is a stand-in on this machine, and no other is contacted."""

import base64
import io
import json
import os
import pickle
import re
import shutil
import subprocess
import sys
import zipfile

import numpy as np
import pytest
import yaml

from sb3_belief.cli.main import main
from sb3_belief.zoo.run_score import run_scores
from tests.cli.fake_hub import TOKEN, fake_hub
from tests.study.folders import write_evaluations
from tests.zoo.runs import parameters, train

huggingface_hub = pytest.importorskip("huggingface_hub", reason="the hub's tests need it: pip install 'sb3-belief[hub]'")

REPO = "me/junction"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished run."""
    status, folder = train(tmp_path_factory.mktemp("runs"))
    assert status == 0
    return folder


@pytest.fixture
def hub(monkeypatch, tmp_path):
    """A hub, and the environment in which huggingface_hub speaks with it."""
    from huggingface_hub import constants

    with fake_hub() as found:
        monkeypatch.setattr(huggingface_hub.HfApi, "__init__", _at(found.endpoint))
        monkeypatch.setattr(constants, "ENDPOINT", found.endpoint)
        monkeypatch.setattr(
            constants, "HUGGINGFACE_CO_URL_TEMPLATE", found.endpoint + "/{repo_id}/resolve/{revision}/{filename}"
        )
        monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)
        for name, place in (("HF_HUB_CACHE", "hub"), ("HF_TOKEN_PATH", "token"), ("HF_HOME", "")):
            monkeypatch.setattr(constants, name, str(tmp_path / "hf" / place))
        monkeypatch.setenv("HF_TOKEN", TOKEN)
        yield found


def _at(endpoint, real=huggingface_hub.HfApi.__init__):
    def init(self, *args, **kwargs):
        real(self, *args, **{"endpoint": endpoint, **kwargs})

    return init


def environment(hub, folder):
    """The environment of a process that speaks with the hub, as users set it."""
    own = {"HF_ENDPOINT": hub.endpoint, "HF_TOKEN": TOKEN, "HF_HOME": str(folder / "hf"), "HF_HUB_DISABLE_XET": "1"}
    return {**os.environ, **own}


def card_of(hub):
    _, data, text = hub.repos[REPO]["README.md"].decode().split("---\n", 2)
    return yaml.safe_load(data), text


def test_a_team_comes_back_as_it_was_sent(run, hub, tmp_path, capsys):
    assert main(["push", str(run), REPO, "-m", "First"]) == 0
    assert f"to {hub.endpoint}/{REPO}" in capsys.readouterr().out
    names = {"team.zip", "best_model.zip", "config.yml", "run.json", "evaluations.npz", "README.md"}
    assert hub.repos[REPO].keys() == names and hub.messages == ["First"] and not hub.private[REPO]
    taken = tmp_path / "here" / "team"
    assert main(["load", REPO, "-o", str(taken)]) == 0
    assert {path.name for path in taken.iterdir()} == names and os.listdir(taken.parent) == ["team"]
    for name in ("team.zip", "best_model.zip", "config.yml", "evaluations.npz"):
        assert (taken / name).read_bytes() == (run / name).read_bytes()
    mine, theirs = parameters(taken / "team.zip"), parameters(run / "team.zip")
    assert mine["car_0"].keys() == theirs["car_0"].keys()
    assert main(["enjoy", str(taken), "--output", str(tmp_path / "x.gif")]) == 0 and (tmp_path / "x.gif").exists()
    # It can be sent again
    assert main(["push", str(run), REPO]) == 0


def test_the_record_tells_nothing_of_the_machine(run, hub):
    assert main(["push", str(run), REPO]) == 0
    text = hub.repos[REPO]["run.json"].decode()
    record = json.loads(text)
    assert (record["algo"], record["env"], record["seed"]) == ("ppo", "traffic-junction-easy", 3)
    assert record["versions"]["torch"] and record["options"]["eval_episodes"] == 6
    assert "command" not in record and str(run.parents[1]) not in text


def test_a_card_says_what_the_team_is(run, hub):
    assert main(["push", str(run), REPO]) == 0
    data, text = card_of(hub)
    with np.load(run / "evaluations.npz") as saved:
        last, successes = saved["results"][-1], saved["successes"][-1]
    (index,) = data["model-index"]
    (result,) = index["results"]
    assert result["dataset"] == {"name": "traffic-junction-easy", "type": "traffic-junction-easy"}
    assert result["task"]["type"] == "reinforcement-learning"
    metrics = {each["type"]: each for each in result["metrics"]}
    reward, success = metrics["mean_reward"], metrics["success_rate"]
    assert reward["value"] == f"{last.mean():.2f} +/- {last.std():.2f}"
    arguments = reward["args"]
    assert arguments["kind"] == "percentile bootstrap over episodes" and arguments["episodes"] == 6
    assert arguments["interval"][0] <= last.mean() <= arguments["interval"][1]
    assert success["value"] == pytest.approx(successes.mean(), abs=1e-4)
    assert {"reinforcement-learning", "stable-baselines3", "traffic-junction-easy"} <= set(data["tags"])
    versions = json.loads((run / "run.json").read_text())["versions"]
    for said in (
        "`ppo` (PPO)",
        "`traffic-junction-easy`",
        "| torch |",
        versions["torch"],
        "without pickle",
        "one run with one seed",
    ):
        assert said in text


@pytest.fixture
def cell(run, tmp_path):
    """A finished cell of a study with that run, and the final episodes of its two teams."""
    pa = pytest.importorskip("pyarrow", reason="final episodes are read with pyarrow")
    from sb3_belief.report.episodes import EPISODES, write_episodes_table

    folder = tmp_path / "study" / "cells" / "ppo" / "traffic-junction-easy" / "seed_3"
    copy = folder / "ppo" / run.name
    shutil.copytree(run, copy)
    entries = {"study": "s", "arm": "ppo", "algo": "ppo", "env": "traffic-junction-easy", "seed": 3, "attempts": 1}
    entries |= {"n_timesteps": 160, "final_episodes": 4, "options": {}, "settings": {}, "status": "finished"}
    (folder / "cell.json").write_text(json.dumps(entries))
    common = {"study": "s", "arm": "ppo", "algorithm": "ppo", "environment": "traffic-junction-easy", "seed": 3}
    rows = []
    for checkpoint, deterministic, level in (
        ("last", True, 10.0),
        ("last", False, 20.0),
        ("best", True, 30.0),
        ("best", False, 40),
    ):
        kind = {"phase": "final", "checkpoint": checkpoint, "deterministic": deterministic, "joint_steps": 80}
        scores = [{"episode": i, "episode_return": level + i, "success": float(i > 0), "length": 5} for i in range(4)]
        rows += [{**common, **kind, **each} for each in scores]
    write_episodes_table(pa.Table.from_pylist(rows, schema=EPISODES), folder / "episodes.parquet")
    return folder, copy


@pytest.mark.parametrize("which", [0, 1])
def test_the_score_of_a_study_s_run_is_that_of_its_final_episodes(cell, hub, which):
    assert main(["push", str(cell[which]), REPO]) == 0
    assert hub.repos[REPO]["team.zip"] == (cell[1] / "team.zip").read_bytes()
    data, text = card_of(hub)
    metrics = {each["type"]: each for each in data["model-index"][0]["results"][0]["metrics"]}
    assert metrics["mean_reward"]["value"] == "31.50 +/- 1.12" and metrics["success_rate"]["value"] == 0.75
    arguments = metrics["mean_reward"]["args"]
    assert (arguments["episodes"], arguments["deterministic"], arguments["team"]) == (4, True, "best_model.zip")
    assert "| Best team, of 80 joint steps (`best_model.zip`) | 31.5 [30.5, 32.5] | 0.75 " in text
    assert "| Last team, of 80 joint steps (`team.zip`) | 11.5 [" in text
    assert (
        "the 4 final episodes of a study" in text and "not too high for that reason" in text and "highest of many" not in text
    )


def test_the_evaluations_count_where_a_cell_has_no_final_episodes(cell, hub, capsys):
    folder, copy = cell
    record = json.loads((folder / "cell.json").read_text())
    (folder / "cell.json").write_text(json.dumps({**record, "status": "failed"}))
    assert main(["push", str(folder), REPO]) == 0
    assert "| Last evaluation, at " in card_of(hub)[1]
    (folder / "cell.json").write_text(json.dumps(record))
    # A later run of the cell is the one whose episodes these are
    shutil.copytree(copy, copy.with_name("traffic-junction-easy_7"))
    assert main(["push", str(copy), REPO]) == 0
    assert "| Last evaluation, at " in card_of(hub)[1]
    half = (folder / "episodes.parquet").read_bytes()[:100]
    (folder / "episodes.parquet").write_bytes(half)
    capsys.readouterr()
    assert main(["push", str(folder), REPO]) == 2
    error = capsys.readouterr().err
    assert "push: " in error and "episodes.parquet: is damaged" in error
    shutil.rmtree(folder / "ppo")
    assert main(["push", str(folder), REPO]) == 2
    assert "is the folder of a cell whose run has not begun: sb3-belief study runs it." in capsys.readouterr().err


def test_the_last_episodes_of_a_training_count_where_nothing_else_was_played(cell, hub):
    import pyarrow.parquet as pq

    from sb3_belief.report.episodes import write_episodes_table

    folder, _ = cell
    table = pq.read_table(folder / "episodes.parquet")
    rows = [row for row in table.to_pylist() if row["checkpoint"] == "last" and not row["deterministic"]]
    write_episodes_table(
        table.from_pylist([{**row, "success": None} for row in rows], table.schema), folder / "episodes.parquet"
    )
    assert main(["push", str(folder), REPO]) == 0
    data, text = card_of(hub)
    (metric,) = data["model-index"][0]["results"][0]["metrics"]
    assert metric["value"] == "21.50 +/- 1.12" and metric["args"]["deterministic"] is False
    assert "the last 4 episodes of the training, with sampled actions" in text


@pytest.mark.slow
def test_the_program_of_a_card_works(run, hub, tmp_path):
    env = environment(hub, tmp_path)
    command = [sys.executable, "-m", "sb3_belief", "push", str(run), REPO]
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=50)
    assert done.returncode == 0, done.stderr
    (program,) = re.findall(r"```python\n(.*?)```", card_of(hub)[1], re.DOTALL)
    done = subprocess.run([sys.executable, "-c", program], env=env, capture_output=True, text=True, timeout=50)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout.splitlines()[-1]) < 0


def test_the_intervals_are_those_of_the_episodes(tmp_path):
    from scipy import stats

    rng = np.random.default_rng(3)
    results = np.stack([rng.normal(2, 1, 400), rng.normal(1, 2, 400)])
    successes = np.zeros((2, 400), dtype=bool)
    successes[1, :100] = True
    write_evaluations(tmp_path, [10, 20], results, successes)
    scores = run_scores(tmp_path)
    assert scores is not None
    last, best = scores
    assert last.success is not None and best.success is not None
    assert last.returns.low is not None and last.returns.high is not None and best.success.high is not None
    assert (last.joint_steps, best.joint_steps, last.n_episodes) == (20, 10, 400)
    # For so many episodes, that of the normal distribution
    half = stats.norm.ppf(0.975) * results[1].std() / 20
    assert last.returns.mean == pytest.approx(results[1].mean())
    assert last.returns.high - last.returns.mean == pytest.approx(half, rel=0.1)
    assert last.returns.mean - last.returns.low == pytest.approx(half, rel=0.1)
    assert (last.success.mean, best.success.mean, best.success.low) == (0.25, 0.0, 0.0)
    # No success in 400 episodes is not known to be none at all
    assert best.success.high == pytest.approx(0.0095, abs=1e-3)
    assert run_scores(tmp_path / "nowhere") is None


def test_a_private_team_needs_a_token(run, hub, tmp_path, monkeypatch, capsys):
    assert main(["push", str(run), REPO, "--private"]) == 0 and hub.private[REPO]
    monkeypatch.delenv("HF_TOKEN")
    assert main(["load", REPO, "-o", str(tmp_path / "team")]) == 2
    assert "needs a token: hf auth login, or HF_TOKEN" in capsys.readouterr().err
    assert main(["push", str(run), "me/other"]) == 1
    assert "Failed: push: the hub has refused it" in capsys.readouterr().err
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    assert main(["load", REPO, "-o", str(tmp_path / "team")]) == 0


def evil(path, kind):
    """Make a team that does something when it is unpickled, or is damaged."""
    if kind == "cut":
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        return
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    inner = io.BytesIO(files["agents/car_0.zip"])
    with zipfile.ZipFile(inner) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}

    class Evil:
        def __reduce__(self):
            return os.mkdir, ("made_by_code",)

    data = json.loads(parts["data"])
    data["policy_class"] = {":type:": "x", ":serialized:": base64.b64encode(pickle.dumps(Evil())).decode()}
    parts["data"] = json.dumps(data).encode()
    inner = io.BytesIO()
    with zipfile.ZipFile(inner, "w") as archive:
        for name, content in parts.items():
            archive.writestr(name, content)
    files["agents/car_0.zip"] = inner.getvalue()
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)


@pytest.mark.parametrize("kind", ["cut", "pickle"])
@pytest.mark.parametrize("name", ["team.zip", "best_model.zip"])
def test_a_team_that_is_not_plain_data_is_neither_taken_nor_sent(run, hub, tmp_path, monkeypatch, capsys, kind, name):
    monkeypatch.chdir(tmp_path)
    copy = tmp_path / "run"
    shutil.copytree(run, copy)
    evil(copy / name, kind)
    hub.repos[REPO] = {path.name: path.read_bytes() for path in copy.iterdir() if path.is_file()}
    hub.private[REPO] = False
    assert main(["load", REPO, "-o", "deep/team"]) == 2
    assert f"{name} does not load as plain data, and is refused" in capsys.readouterr().err
    assert not (tmp_path / "deep").exists() and not (tmp_path / "made_by_code").exists()
    hub.requests.clear()
    assert main(["push", str(copy), "me/second"]) == 2
    assert f"{name} does not load as plain data" in capsys.readouterr().err and hub.requests == []


def test_only_files_of_known_names_are_taken(run, hub, tmp_path):
    assert main(["push", str(run), REPO]) == 0
    hub.repos[REPO].update({"setup.py": b"x", "agents/x.csv": b"x", "other.zip": b"x"})
    assert main(["load", REPO, "-o", str(tmp_path / "team")]) == 0
    assert not {"setup.py", "agents", "other.zip", ".cache"} & set(os.listdir(tmp_path / "team"))


@pytest.mark.parametrize(
    ("words", "status", "message"),
    [
        (["load", "me/none"], 2, "load: the hub shows no repository me/none"),
        (["load", "me"], 2, "'me' is no name of a repository: give owner and name, as in me/my-team"),
        (["load", "me/../x"], 2, "is no name of a repository"),
        (["load", "me/empty"], 2, "me/empty has no team.zip"),
        (["load", "me/empty", "--revision", "v9"], 2, "me/empty has no such revision"),
        (["load", "me/empty", "-o", "there"], 2, "-o: 'there' exists already: name a new folder."),
        (["push", "there", "me/empty"], 2, "push: 'there' is not the folder of a run: it has no run.json."),
    ],
)
def test_what_cannot_be_is_said_in_a_line(hub, tmp_path, monkeypatch, capsys, words, status, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there").mkdir()
    hub.repos["me/empty"], hub.private["me/empty"] = {"x.txt": b"x"}, False
    assert main(words) == status
    said = capsys.readouterr().err
    # Progress of huggingface_hub is no line
    assert message in said and said.count("\n") - said.count("it/s]\n") == 1
    assert not [name for name in os.listdir(tmp_path) if name not in ("there", "hf")]


def test_a_hub_that_refuses_or_is_away_is_said(run, hub, tmp_path, monkeypatch, capsys):
    hub.full = True
    assert main(["push", str(run), REPO]) == 1
    assert "Failed: push: the hub has refused it" in capsys.readouterr().err
    # Nobody listens there
    monkeypatch.setattr(huggingface_hub.HfApi, "__init__", _at("http://127.0.0.1:9"))
    monkeypatch.setattr(huggingface_hub.constants, "ENDPOINT", "http://127.0.0.1:9")
    assert main(["load", REPO, "-o", str(tmp_path / "team")]) == 1
    assert "the hub cannot be reached" in capsys.readouterr().err and not (tmp_path / "team").exists()


@pytest.mark.parametrize(("words", "package"), [(["load", REPO], "huggingface_hub"), (["push", "x", REPO], "scipy")])
def test_a_missing_extra_is_said(monkeypatch, capsys, words, package):
    monkeypatch.setattr("sb3_belief.zoo.hub.find_spec", lambda name: None if name == package else json)
    assert main(words) == 2
    assert f"the hub needs {package}: pip install 'sb3-belief[hub]'." in capsys.readouterr().err
