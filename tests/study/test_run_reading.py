import numpy as np
import pytest

from sb3_belief.study.groups import labels
from sb3_belief.study.run_reading import DAMAGED, KILLED, diagnostic_series, evaluation_series, read_run, run_folders
from sb3_belief.zoo.run_lock import run_lock
from tests.study.folders import write_run


def test_runs_are_found_at_any_depth(tmp_path):
    folders = [write_run(tmp_path / part, "ippo", "x", 0, [0.5]) for part in ("a/x_1", "b/c/d/x_2")]
    # What lies within a run is no run, and what is hidden is no folder of ours
    write_run(folders[0] / "old", "ippo", "x", 0, [0.5])
    write_run(tmp_path / ".trash" / "x_1", "ippo", "x", 0, [0.5])
    assert list(run_folders(tmp_path)) == folders and list(run_folders(folders[0])) == folders[:1]


def test_the_status_is_that_of_the_process(tmp_path):
    folder = write_run(tmp_path / "ippo" / "x-y_1", "ippo", "x/y", 3, [0.5], status="running")
    assert read_run(folder).status == KILLED
    with run_lock(folder):
        assert read_run(folder).status == "running"
    assert (read_run(folder).seed, read_run(folder).env, read_run(folder).total_steps) == (3, "x/y", 1000)


@pytest.mark.parametrize("content", ["", "{", "[]", "null", '{"status": 3}', "[" * 100_000])
def test_a_damaged_record_is_told_by_its_folder(content, tmp_path):
    folder = write_run(tmp_path / "ippo" / "x-y_1", "ippo", "x/y", 3, [0.5])
    (folder / "run.json").write_text(content)
    run = read_run(folder)
    # The configuration still has the id
    assert (run.status, run.algo, run.env, run.seed) == (DAMAGED, "ippo", "x/y", None)
    (folder / "config.yml").write_text("x: [")
    assert read_run(folder).env == "x-y"


def test_series_are_what_the_files_hold(tmp_path):
    folder = write_run(tmp_path / "x_1", "belief_ppo", "x", 0, [0.0, 1.0], beliefs=True)
    greedy = evaluation_series(folder, "success")["evaluations, greedy"]
    assert greedy[0].tolist() == [1000, 2000] and greedy[1].tolist() == [0, 1]
    returns = evaluation_series(folder, "return")["evaluations, greedy"]
    assert returns[1].tolist() == [-1, 1]
    path = folder / "agents" / "car_0" / "progress.csv"
    path.write_text(
        "time/total_timesteps,belief/accuracy,train/loss\n100,,1\n200,0.5,1\n300,nan,1\n400,0.75,1\n500,0.9\n600,0"
    )
    series = diagnostic_series(folder)
    assert {agent: values.tolist() for agent, (_, values) in series["belief/accuracy"].items()}["car_0"] == [0.5, 0.75]
    assert series["belief/accuracy"]["car_0"][0].tolist() == [200, 400] and "train/loss" not in series
    np.testing.assert_allclose(series["belief/fusion_ratio"]["car_1"][1], [0, 0.1])


def test_groups_are_named_by_what_differs(tmp_path):
    runs = [
        ("ippo", "x", {"n_steps": 8}),
        ("ippo", "y", {"n_steps": 16}),
        ("belief_ppo", "x", {"belief": "static", "gamma": 0.9}),
        ("belief_ppo", "x", {"belief": "dynamic", "gamma": 0.99, "policy_kwargs": {"latent_dim": 4}}),
        ("belief_ppo", "y", {}),
    ]
    read = [read_run(write_run(tmp_path / f"r_{i}", algo, env, 0, [0.5], settings=s)) for i, (algo, env, s) in enumerate(runs)]
    # Settings of different environments differ anyway
    assert labels(read) == [
        "ippo",
        "ippo",
        "belief_ppo (static, gamma=0.9)",
        "belief_ppo (dynamic, gamma=0.99, policy_kwargs.latent_dim=4)",
        "belief_ppo",
    ]
