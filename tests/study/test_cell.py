"""A single run of a study: its final evaluations, its record, and how it goes on."""

import json
import shutil

import numpy as np
import pytest
import torch as th

from sb3_belief.report.episodes import read_episodes_table, scores
from sb3_belief.study.cell import BUSY, cell_main
from sb3_belief.study.final_evaluation import final_seed
from sb3_belief.team.agent_models import env_seed
from sb3_belief.zoo.errors import ConfigError
from sb3_belief.zoo.run_lock import run_lock
from tests.study.tiny import EASY, prepared, record


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    (cell,) = prepared(tmp_path_factory.mktemp("finished"))
    assert cell_main([str(cell.folder)]) == 0
    return cell


def rows(cell):
    return read_episodes_table(cell.episodes).to_pylist()


def test_a_finished_cell(finished):
    kept = record(finished)
    assert (kept["status"], kept["attempts"], kept["error"], kept["run"]) == ("finished", 1, None, f"ppo/{EASY}_1")
    assert kept["seconds"] > 0 and kept["cpu_seconds"] > 0
    # What train makes, in its place
    run = finished.folder / kept["run"]
    assert json.loads((run / "run.json").read_text())["status"] == "finished" and (run / "team.zip").is_file()


def test_episodes_of_all_evaluations(finished):
    table = rows(finished)
    groups: dict = {}
    for row in table:
        groups.setdefault((row["phase"], row["checkpoint"], row["deterministic"], row["joint_steps"]), []).append(row)
    with np.load(finished.folder / "ppo" / f"{EASY}_1" / "evaluations.npz") as data:
        means = data["results"].mean(axis=1)
        best = int(data["timesteps"][list(means).index(means.max())])
        np.testing.assert_array_equal([row["episode_return"] for row in table[:8]], data["results"].ravel())
        np.testing.assert_array_equal([row["length"] for row in table[:8]], data["ep_lengths"].ravel())
        np.testing.assert_array_equal([row["success"] for row in table[:8]], data["successes"].ravel())
    assert {key: len(each) for key, each in groups.items()} == {
        ("training", "current", True, 160): 4,
        ("training", "current", True, 320): 4,
        **{("final", "last", greedy, 400): 6 for greedy in (True, False)},
        **{("final", "best", greedy, best): 6 for greedy in (True, False)},
    }
    assert all([row["episode"] for row in each] == list(range(len(each))) for each in groups.values())
    names = {(row["study"], row["arm"], row["algorithm"], row["environment"], row["seed"]) for row in table}
    assert names == {("tiny", "ippo", "ppo", EASY, 0)}
    assert set(scores(read_episodes_table(finished.episodes), "success")[EASY]["ippo"]) == {0}


def test_final_episodes_are_played_again_alike(finished, tmp_path):
    before = rows(finished)
    copy = type(finished)(tmp_path / "cell")
    shutil.copytree(finished.folder, copy.folder)
    # As after a kill between the training and the final evaluations
    copy.write({**record(copy), "status": "running"})
    copy.episodes.unlink()
    th.set_num_threads(2)
    try:
        assert cell_main([str(copy.folder)]) == 0
        # As many as the run was trained with, which has set them before its episodes were played
        assert th.get_num_threads() == 1
    finally:
        th.set_num_threads(1)
    assert rows(copy) == before and record(copy)["attempts"] == 2


def test_final_episodes_have_seeds_of_their_own():
    # All other seeds of environments are below 2**30
    seeds = [final_seed(seed) for seed in range(200)]
    assert len(set(seeds)) == 200 and all(2**30 <= seed < 2**31 - 10_000 for seed in seeds)
    assert all(env_seed(seed, purpose, step) < 2**30 for seed in range(50) for purpose in (0, 1, 2) for step in (None, 5))


def test_a_cell_that_is_held_is_left_alone(finished, capsys):
    before = record(finished)
    with run_lock(finished.folder):
        assert cell_main([str(finished.folder)]) == BUSY
    assert cell_main([str(finished.folder)]) == 0
    assert record(finished) == before


def test_a_failure_is_recorded_with_its_traceback(tmp_path, monkeypatch):
    (cell,) = prepared(tmp_path)
    from sb3_belief.zoo import learning

    def fail(*args):
        raise RuntimeError("the environment is broken")

    monkeypatch.setattr(learning.SignalCheck, "_on_step", fail)
    assert cell_main([str(cell.folder)]) == 1
    assert record(cell)["status"] == "failed" and "the environment is broken" in record(cell)["error"]
    assert "in fail" in (cell.folder / "error.txt").read_text()
    monkeypatch.undo()
    # Tried again it goes on, and forgets the error
    assert cell_main([str(cell.folder)]) == 0
    assert record(cell)["status"] == "finished" and record(cell)["error"] is None
    assert not (cell.folder / "error.txt").exists()


def test_a_run_without_a_whole_checkpoint_begins_anew(finished, tmp_path):
    copy = type(finished)(tmp_path / "cell")
    shutil.copytree(finished.folder, copy.folder)
    run = copy.folder / "ppo" / f"{EASY}_1"
    (run / "run.json").write_text((run / "run.json").read_text().replace('"finished"', '"running"'))
    for path in (run / "checkpoints").iterdir():
        path.write_bytes(path.read_bytes()[:1000])
    copy.write({**record(copy), "status": "running"})
    assert cell_main([str(copy.folder)]) == 0
    assert [path.name for path in (copy.folder / "ppo").iterdir()] == [f"{EASY}_1"]
    assert "resumed" not in json.loads((run / "run.json").read_text()) and rows(copy) == rows(finished)


def test_a_damaged_file_of_the_run_is_a_failure_that_says_which(finished, tmp_path):
    copy = type(finished)(tmp_path / "cell")
    shutil.copytree(finished.folder, copy.folder)
    path = copy.folder / "ppo" / f"{EASY}_1" / "evaluations.npz"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    copy.write({**record(copy), "status": "running"})
    assert cell_main([str(copy.folder)]) == 1
    assert f"{path} is damaged" in record(copy)["error"]


def test_half_a_record_is_refused(finished, tmp_path):
    copy = type(finished)(tmp_path / "cell")
    shutil.copytree(finished.folder, copy.folder)
    copy.path.write_text(copy.path.read_text()[:100])
    with pytest.raises(ConfigError, match=r"cell.json: is damaged.*Move the folder"):
        copy.read()
    assert cell_main([str(copy.folder)]) == 1


def test_episodes_of_the_training_itself(tmp_path):
    changes = {
        "environments": {"convention-redraw": {"n_envs": 5, "batch_size": 80}},
        "algorithms": {"none": {"algo": "ippo"}},
    }
    online = {"online": True, "every": 160, "final_episodes": 12}
    (cell,) = prepared(tmp_path, **changes, evaluation=online, n_timesteps=480)
    assert cell_main([str(cell.folder)]) == 0
    (run,) = (cell.folder / "ippo").iterdir()
    assert not (run / "evaluations.npz").exists()
    with open(run / "monitor.csv") as file:
        monitor = [float(line.split(",")[0]) for line in file.readlines()[2:]]
    # 480 joint steps of episodes of 16, and for each point of the curve those that ended since the last one
    table = rows(cell)
    assert len(monitor) == 30
    curve = [row for row in table if row["phase"] == "training"]
    assert [row["joint_steps"] for row in curve] == [160] * 10 + [320] * 10 + [480] * 10
    assert [row["episode_return"] for row in curve] == monitor
    final = [row for row in table if row["phase"] == "final"]
    assert [row["episode_return"] for row in final] == monitor[-12:]
    assert {(row["checkpoint"], row["deterministic"], row["joint_steps"]) for row in final} == {("last", False, 480)}
    assert {row["length"] for row in table} == {16} and {row["success"] for row in table} == {None}


def test_a_run_that_cannot_be_continued_exactly_begins_anew(finished, tmp_path):
    copy = type(finished)(tmp_path / "cell")
    shutil.copytree(finished.folder, copy.folder)
    run = copy.folder / "ppo" / f"{EASY}_1"
    (run / "run.json").write_text((run / "run.json").read_text().replace('"finished"', '"running"'))
    for path in (run / "checkpoints").iterdir():
        # Whole, but without what an exact continuation needs
        shutil.copyfile(run / "team.zip", path)
    copy.write({**record(copy), "status": "running"})
    assert cell_main([str(copy.folder)]) == 0
    assert "resumed" not in json.loads((run / "run.json").read_text()) and rows(copy) == rows(finished)
