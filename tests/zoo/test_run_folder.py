import json
import threading

import pytest

from sb3_belief.zoo.errors import ConfigError
from sb3_belief.zoo.run_folder import RunRecord, find_team, make_run_folder, remove_run_folder, run_of


def test_folders_are_numbered_by_algorithm_and_environment(tmp_path):
    names = [make_run_folder(tmp_path, algo, "env").relative_to(tmp_path).as_posix() for algo in ("ppo", "ppo", "a2c")]
    assert names == ["ppo/env_1", "ppo/env_2", "a2c/env_1"]


def test_an_environments_id_is_one_folder(tmp_path):
    ids = ["mpe/simple_spread_v3", "my_games.toys:make", "mpe/simple_spread_v3", "mpe/../../x"]
    folders = [make_run_folder(tmp_path, "ppo", env_id) for env_id in ids]
    names = ["mpe-simple_spread_v3_1", "my_games.toys-make_1", "mpe-simple_spread_v3_2", "mpe-..-..-x_1"]
    assert [folder.relative_to(tmp_path / "ppo").as_posix() for folder in folders] == names
    (tmp_path / "kept").touch()
    for folder in folders:
        remove_run_folder(folder)
    assert [path.name for path in tmp_path.iterdir()] == ["kept"]


def test_a_number_is_never_used_twice(tmp_path):
    for name in ("env_3", "env_old", "env_x_9", "other_7"):
        (tmp_path / "ppo" / name).mkdir(parents=True)
    assert make_run_folder(tmp_path, "ppo", "env").name == "env_4"
    assert make_run_folder(tmp_path, "ppo", "env_x").name == "env_x_10"


def test_runs_that_start_at_once_get_different_folders(tmp_path):
    n_threads, each = 8, 12
    barrier = threading.Barrier(n_threads)
    folders = []

    def make():
        barrier.wait()
        for _ in range(each):
            folders.append(make_run_folder(tmp_path, "ppo", "env"))

    threads = [threading.Thread(target=make) for _ in range(n_threads)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(int(folder.name.removeprefix("env_")) for folder in folders) == list(range(1, n_threads * each + 1))


def test_the_record_says_what_ran_and_how_it_ended(tmp_path):
    record = RunRecord(tmp_path, ["python", "train.py", "-params", "a:[1, 2]"], algo="ppo", env="env", seed=3)
    before = json.loads((tmp_path / "run.json").read_text())
    assert before["status"] == "running"
    assert before["command"] == "python train.py -params 'a:[1, 2]'"
    assert {"python", "torch", "stable-baselines3"} <= before["versions"].keys()
    record.finish("interrupted", timesteps=5)
    after = json.loads((tmp_path / "run.json").read_text())
    assert (after["status"], after["timesteps"], after["seed"]) == ("interrupted", 5, 3)


def test_a_team_is_found_by_its_run_and_a_run_by_its_team(tmp_path):
    RunRecord(tmp_path, [], algo="ppo", env="env")
    (tmp_path / "config.yml").write_text("env: {}\n")
    with pytest.raises(ConfigError, match=r"enjoy: no team\.zip in .*it has none"):
        find_team(tmp_path, "enjoy")
    checkpoint = tmp_path / "checkpoints" / "team_8_steps.zip"
    checkpoint.parent.mkdir()
    checkpoint.touch()
    with pytest.raises(ConfigError, match=r"Give one of its zips: checkpoints/team_8_steps\.zip"):
        find_team(tmp_path, "enjoy")
    (tmp_path / "team.zip").touch()
    assert find_team(tmp_path, "enjoy") == tmp_path / "team.zip"
    for path in (tmp_path / "team.zip", find_team(checkpoint, "enjoy")):
        assert run_of(path) == ("ppo", "env", tmp_path / "config.yml")
    assert run_of(tmp_path.parent / "elsewhere.zip") is None
