"""Monitor files of a team, of new runs and continued ones."""

import csv
import json
from functools import partial

import numpy as np
import pytest

from tests.team.helpers import make_team_env
from tests.team.toy_envs import ScriptedEnv, ToyEnv

ZEROS = {agent: np.zeros(1, int) for agent in ("stays", "dies", "cut", "last")}


def monitor_rows(path):
    """Return the rows of a monitor file, as SB3's ``load_results`` does, which needs pandas."""
    with open(path) as file:
        assert "t_start" in json.loads(file.readline()[1:])
        return list(csv.DictReader(file))


def test_monitor_files(tmp_path):
    env = make_team_env(ScriptedEnv, n_envs=2)
    env.start_monitor(tmp_path)
    env.reset()
    episodes = []
    for _ in range(24):
        _, _, _, infos = env.step({agent: np.zeros(2, int) for agent in ZEROS})
        episodes += [info for info in infos if "episode" in info]
    env.close()
    assert len(episodes) == 6
    rows = monitor_rows(tmp_path / "monitor.csv")
    assert [float(row["r"]) for row in rows] == pytest.approx([info["episode"]["r"] for info in episodes], abs=1e-5)
    assert [row["l"] for row in rows] == ["8"] * 6
    assert [row["is_success"] for row in rows] == ["False"] * 2 + ["True"] * 2 + ["False"] * 2
    rows = monitor_rows(tmp_path / "agents" / "cut.monitor.csv")
    assert [float(row["r"]) for row in rows] == pytest.approx(
        [info["agent_episode_rewards"][2] for info in episodes], abs=1e-5
    )


def test_monitor_dir_attribute(tmp_path):
    env = make_team_env(partial(ToyEnv, limit=2))
    env.monitor_dir = tmp_path
    env.reset()
    for _ in range(2):
        env.step({"agent_0": [0], "agent_1": [0]})
    env.close()
    assert len(monitor_rows(tmp_path / "monitor.csv")) == 1
    env.reset()
    assert len(monitor_rows(tmp_path / "monitor.csv")) == 1


def test_monitor_files_of_a_continued_run(tmp_path):
    """Rows after the state are dropped, later ones are appended, and times go on."""
    env = make_team_env(ToyEnv, n_envs=2, env_kwargs={"limit": 2})
    env.start_monitor(tmp_path)
    files = [tmp_path / "monitor.csv", tmp_path / "agents" / "agent_1.monitor.csv"]

    def play(env, steps):
        for _ in range(steps):
            env.step({agent: np.zeros(2, dtype=int) for agent in env.possible_agents})

    env.reset()
    play(env, 4)
    state = json.loads(json.dumps(env.monitor_state()))
    env.sync_monitor()
    before = [file.read_bytes() for file in files]
    play(env, 4)

    again = make_team_env(ToyEnv, n_envs=2, env_kwargs={"limit": 2})
    again._t_start -= 1000
    again.start_monitor(tmp_path, continue_from=state)
    assert [file.read_bytes() for file in files] == before
    again.reset()
    play(again, 2)
    assert [file.read_bytes()[: len(old)] for file, old in zip(files, before, strict=True)] == before
    rows = monitor_rows(files[0])
    assert len(rows) == 6
    # Not a thousand seconds later
    assert float(rows[3]["t"]) <= float(rows[4]["t"]) < 500
    env.close()
    again.close()


def test_monitor_files_that_are_gone_or_changed(tmp_path):
    env = make_team_env(ToyEnv)
    assert env.monitor_state()["sizes"] == []
    env.start_monitor(tmp_path / "first")
    state = env.monitor_state()
    env.start_monitor(tmp_path / "new", continue_from=state)
    assert (tmp_path / "new" / "monitor.csv").read_bytes() == (tmp_path / "first" / "monitor.csv").read_bytes()
    (tmp_path / "new" / "monitor.csv").write_bytes(b"#")
    with pytest.raises(ValueError, match=r"monitor\.csv is not the log of this run any more"):
        env.start_monitor(tmp_path / "new", continue_from=state)
    env.close()
