"""Partners by YAML and by flags: who acts, what is recorded, and what is refused before anything is written."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from sb3_belief.cli.main import main, train_main
from sb3_belief.team import TeamVecEnv, make_team_env
from sb3_belief.zoo.checks import Location
from sb3_belief.zoo.config import load_config
from sb3_belief.zoo.errors import ConfigError
from sb3_belief.zoo.partners import check_partners, partners_of_flag
from sb3_belief.zoo.train import make_env
from tests.zoo.runs import table

EASY = "traffic-junction-easy"
TINY = ["n_envs:4", "n_steps:20", "batch_size:40", "n_epochs:1"]
HERE, FOLDER = "tests.zoo.test_partners", str(Path(__file__).parent)


def brake(obs):
    return 1


def drive(obs):
    return 0


def agents_space(env: TeamVecEnv, agent: str) -> Any:
    observed: Any = env.observation_space
    return observed[agent]


def plain_observer(obs):
    assert agents_space(make_team_env(EASY), "car_1").contains(obs)
    return 0


def train(folder, *words, params=(), algo="ppo"):
    flags = ["--env", EASY, "--seed", "3", "-f", str(folder), "--verbose", "0", "-n", "160", "--allow-package", "tests"]
    return train_main(["--algo", algo, *flags, "-params", *TINY, *params, *words])


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A folder with two runs of PPO, whose teams can be partners."""
    folder = tmp_path_factory.mktemp("partners") / "logs"
    for _ in range(2):
        assert train(folder, "--eval-freq", "-1") == 0
    return folder


def write(path, content):
    path.write_text(yaml.safe_dump(content))
    return str(path)


@pytest.fixture(scope="module")
def partnered(runs, tmp_path_factory):
    """The folder of a run beside runs, a checkpoint and functions."""
    folder = tmp_path_factory.mktemp("partnered")
    content = {
        "learners": "car_0",
        "members": {"brakes": f"{HERE}:brake", "drives": f"{HERE}:drive"},
        "runs": [f"{runs}/*/{EASY}_*", f"{runs}/ppo/{EASY}_1/*.zip"],
        "held_out": "drives",
        "redraw_every": 1,
    }
    words = ["--eval-freq", "80", "--eval-episodes", "3", "--n-eval-envs", "3", "--save-freq", "80"]
    assert train(folder / "logs", "--partners", write(folder / "partners.yml", content), *words) == 0
    return folder / "logs" / "ppo" / f"{EASY}_1"


def test_a_run_records_its_partners_and_goes_on_with_them(runs, partnered, capsys):
    recorded = yaml.safe_load((partnered / "config.yml").read_text())[EASY]["partners"]
    folder = runs / "ppo"
    assert recorded["members"] == {
        "brakes": f"{HERE}:brake",
        "drives": f"{HERE}:drive",
        f"ppo/{EASY}_1": f"{folder / f'{EASY}_1'}/team.zip",
        f"ppo/{EASY}_2": f"{folder / f'{EASY}_2'}/team.zip",
        f"{EASY}_1/team": f"{folder / f'{EASY}_1'}/team.zip",
    }
    assert "runs" not in recorded and recorded["learners"] == ["car_0"] and recorded["held_out"] == ["drives"]
    # One agent learned, and the log knows beside whom; held out members only play in evaluations
    assert [path.name for path in (partnered / "agents").glob("*.csv")] == ["car_0.monitor.csv"]
    met = {key for row in table(partnered / "progress.csv") for key in row if key.startswith("partners/")}
    assert met and "partners/drives/ep_rew_mean" not in met
    assert met <= {f"partners/{name}/ep_rew_mean" for name in recorded["members"]}
    evaluated = [row for row in table(partnered / "progress.csv") if row.get("eval/mean_reward")]
    assert len(evaluated) == 2
    for row in evaluated:
        assert {key for key in row if key.startswith("eval/partners/")} == {"eval/partners/drives/mean_reward"}
        assert row["eval/partners/drives/mean_reward"] == row["eval/mean_reward"]
    assert main(["train", "--resume", str(partnered), "--until", "240", "--verbose", "0", "--allow-package", "tests"]) == 0
    assert yaml.safe_load((partnered / "config.yml").read_text())[EASY]["partners"] == recorded
    with np.load(partnered / "evaluations.npz") as data:
        assert data["timesteps"].tolist() == [80, 160, 240]


def test_learners_observe_their_last_step_and_partners_do_not(tmp_path, capsys):
    """Who is told of another partner is told of those of the pool."""
    content = {"learners": "car_0", "members": {"a": f"{HERE}:plain_observer", "b": f"{HERE}:brake"}, "redraw_every": 2}
    params = ["observe_last:true", "memory_span:partner", "policy_kwargs.lstm_hidden_size:8"]
    words = [*("--partners", write(tmp_path / "partners.yml", content)), *("--eval-freq", "80", "--eval-episodes", "2")]
    assert train(tmp_path / "logs", *words, params=params, algo="recurrent_ppo") == 0
    run = tmp_path / "logs" / "recurrent_ppo" / f"{EASY}_1"
    config = load_config("recurrent_ppo", EASY, str(run / "config.yml"), extra_packages=("tests",))
    env = make_env(config, 3, 0)
    plain = agents_space(make_team_env(EASY), "car_0")
    assert env.possible_agents == ["car_0"] and env.unwrapped is env
    # Of each of the four others two actions and whether it was seen, of its own two, and the reward
    assert agents_space(env, "car_0")["observation"].shape == (plain.shape[0] + 4 * 3 + 2 + 1,)
    env.reset()
    before, changes = env.get_attr("partner"), []
    for _ in range(20 * 4):
        obs = env.step({"car_0": np.ones(3, dtype=int)})[0]
        now = env.get_attr("partner")
        assert obs["car_0"]["memory_start"][:, 0].tolist() == [old != new for old, new in zip(before, now, strict=True)]
        changes += [old != new for old, new in zip(before, now, strict=True)]
        before = now
    assert any(changes)
    capsys.readouterr()
    assert main(["enjoy", str(run), "--episodes", "1", "--allow-package", "tests"]) == 0
    assert "Episode 1: return" in capsys.readouterr().out


def test_enjoy_finds_the_partners_or_is_given_others(runs, partnered, tmp_path, capsys):
    common = ["--episodes", "1", "--output", str(tmp_path / "episode.gif"), "--allow-package", "tests"]
    assert main(["enjoy", str(partnered), *common]) == 0
    beside = capsys.readouterr().out
    assert "steps  beside drives\n" in beside or "success  beside drives\n" in beside
    assert main(["enjoy", str(partnered), *common, "--partners", str(runs / "ppo" / f"{EASY}_2")]) == 0
    other = capsys.readouterr().out
    # A file of nothing but the member, which is whom the run's evaluations meet
    file = write(tmp_path / "p.yml", {"members": {"drives": f"{HERE}:drive"}})
    assert main(["enjoy", str(partnered), *common, "--partners", file]) == 0
    assert capsys.readouterr().out == beside != other
    # Whose run's file names functions is trusted with known packages only
    assert main(["enjoy", str(partnered), *common[:-2]]) == 2
    assert "brakes" in capsys.readouterr().err


def test_members_of_a_flag_take_the_place_of_those_of_a_file(runs, tmp_path):
    conf = write(
        tmp_path / "ppo.yml",
        {
            EASY: {
                "policy": "MlpPolicy",
                "n_timesteps": 9,
                "partners": {"learners": ["car_1"], "members": {"a": f"{HERE}:brake"}},
            }
        },
    )
    run = runs / "ppo" / f"{EASY}_1"

    def load(*overrides, **kwargs):
        return load_config("ppo", EASY, conf, extra_packages=("tests",), overrides=overrides, **kwargs).partners

    assert load().pool.members == {"a": brake} and load().learners == ("car_1",)
    flag = ("--partners", {"partners": partners_of_flag(str(run))})
    assert load(flag).pool.members == {f"ppo/{EASY}_1": str(run / "team.zip")} and load(flag).learners == ("car_1",)
    folder = ("--partners", {"partners": partners_of_flag(str(runs))})
    assert load(folder).pool.members == {f"ppo/{EASY}_{k}": f"{runs}/ppo/{EASY}_{k}/team.zip" for k in (1, 2)}
    assert load(params=["partners:null"]) is None and load(params=["partners.seed:5"]).pool.schedule.seed == 5
    by_agent = {"learners": ["car_0"], "members": {"both": {"car_1": f"{run}/team.zip:car_3", "car_2": f"{HERE}:drive"}}}
    both = load(("--partners", {"partners": by_agent})).pool.members["both"]
    assert both == {"car_1": f"{run}/team.zip:car_3", "car_2": drive}


def test_who_has_moved_is_not_missed_where_others_take_their_place(runs, tmp_path, capsys):
    old = tmp_path / "old.zip"
    old.write_bytes((runs / "ppo" / f"{EASY}_1" / "team.zip").read_bytes())
    content: dict[str, Any] = {"learners": "car_0", "members": {"old": str(old), "other": f"{HERE}:drive"}}
    content |= {"held_out": "old", "weights": [1.0, 2.0]}
    words = ["--partners", write(tmp_path / "p.yml", content), "--eval-freq", "-1"]
    assert train(tmp_path / "logs", *words, algo="belief_ppo") == 0
    old.rename(tmp_path / "new.zip")
    run, new = tmp_path / "logs" / "belief_ppo" / f"{EASY}_1", str(tmp_path / "new.zip")
    words = ["--allow-package", "tests"]
    episode = ["--episodes", "1", "--output", str(tmp_path / "episode.gif"), *words]
    assert main(["enjoy", str(run), *episode]) == 2
    assert f"there is no file or folder '{old}'" in capsys.readouterr().err
    assert main(["enjoy", str(run), *episode, "--partners", new]) == 0
    further = ["-i", str(run), "-n", "80", "-f", str(tmp_path / "logs"), "--verbose", "0", "--eval-freq", "-1", *words]
    assert train_main([*further, "--partners", new]) == 0
    config = load_config("belief_ppo", EASY, str(run.with_name(f"{EASY}_2") / "config.yml"), extra_packages=("tests",))
    # With what was said of them by name
    assert config.partners is not None and list(config.partners.pool.members.values()) == [new]
    measure = ["--steps", "0", "--repetitions", "1", "--episodes", "1"]
    assert main(["adapt", str(run), "--partners", str(runs), *measure, *words]) == 0


def test_runs_are_called_by_the_shortest_ends_of_their_paths_that_differ(tmp_path):
    location, names = Location("partners"), ("seed_2", "seed_10")
    paths = [tmp_path / "cells" / name / "ppo" / f"{EASY}_1" for name in names]
    for path in paths:
        path.mkdir(parents=True)
        (path / "team.zip").write_bytes(b"")
    (tmp_path / "tuning" / "ppo").mkdir(parents=True)
    for name in ("tune.yml", "trials.csv", "ppo/team.zip"):
        (tmp_path / "tuning" / name).write_bytes(b"")
    runs = f"{tmp_path}/cells/*/ppo/*"
    checked = check_partners({"runs": runs}, location)
    assert checked == {
        "members": {f"{name}/ppo/{EASY}_1": f"{path}/team.zip" for name, path in zip(names, paths, strict=True)}
    }
    assert check_partners({"runs": f"{paths[0]}"}, location) == {"members": {f"ppo/{EASY}_1": f"{paths[0]}/team.zip"}}
    with pytest.raises(ConfigError, match=f"two members are called 'ppo/{EASY}_1'"):
        check_partners({"runs": [runs, str(paths[0])]}, location)
    # A folder's are called by their paths in it, without what was tried in a tuning
    assert partners_of_flag(str(tmp_path)) == {
        "members": {f"cells/{name}/ppo/{EASY}_1": str(path) for name, path in zip(names, paths, strict=True)}
    }
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match=r"no run in .* has saved a team"):
        partners_of_flag(str(tmp_path / "empty"))


def test_draws_are_those_of_the_runs_seed_unless_the_pool_has_its_own(tmp_path):
    members = {name: f"{HERE}:{name}" for name in ("brake", "drive")}
    common = {"learners": "car_0", "members": members, "redraw_unit": "rollouts", "per_copy": False}

    def drawn(run_seed, **own):
        flag = ("--partners", {"partners": {**common, **own}})
        config = load_config("ppo", EASY, extra_packages=("tests",), overrides=[flag])
        env = make_env(config, 2, run_seed)
        env.reset()
        found = []
        for _ in range(20):
            env.begin_rollout()
            first, second = env.get_attr("partner")
            assert first == second
            found.append(first)
        return found

    assert drawn(1) == drawn(1) != drawn(2)
    assert drawn(1, seed=5) == drawn(2, seed=5) == drawn(5)


@pytest.mark.parametrize(
    "partners, message",
    [
        ({"members": {"a": f"{HERE}:brake"}}, "needs 'learners'"),
        ({"learners": ["car_0"]}, "needs 'members'"),
        ({"learners": ["car_0"], "members": {}}, "needs 'members'"),
        ({"learner": ["car_0"]}, "Did you mean 'learners'"),
        ({"learners": ["car_0"], "members": {"a": "nothing.zip"}}, "members: a: there is no file or folder 'nothing.zip'"),
        ({"learners": ["car_0"], "members": {"a": "os:remove"}}, "members: a:.*--allow-package"),
        ({"learners": ["car_0"], "members": {"a": 3}}, "members: a: must be a path or module:function"),
        ({"learners": ["car_0"], "members": {"a": FOLDER}}, "is a folder without best_model.zip and team.zip"),
        ({"learners": ["car_0"], "runs": "nothing/*"}, "no folder of a run and no zip matches 'nothing/"),
        ({"learners": ["car_0"], "members": {"a": f"{HERE}:brake"}, "redraw_every": 0}, "every=0 must be an integer >= 1"),
        ({"learners": ["car_0"], "members": {"a": f"{HERE}:brake"}, "held_out": ["b"]}, r"\['b'\] are held out"),
        ({"learners": ["car_0"], "members": {"a": f"{HERE}:brake"}, "held_out": ["a"]}, "All members of the pool"),
        ({"learners": ["car_0"], "members": {"a": f"{HERE}:brake"}, "weights": [1, 2]}, "1 members, .* but 2 weights"),
        ({"learners": ["bob"], "members": {"a": f"{HERE}:brake"}}, r"the environment has no \['bob'\]"),
        ({"learners": [f"car_{i}" for i in range(5)], "members": {"a": f"{HERE}:brake"}}, "act for nobody"),
    ],
)
def test_wrong_partners_are_refused_before_anything_is_written(partners, message, tmp_path, capsys):
    assert train(tmp_path / "logs", "--partners", write(tmp_path / "p.yml", partners)) == 2
    assert re.search(message, capsys.readouterr().err)
    assert not (tmp_path / "logs").exists()


def test_wrong_files_and_functions_of_strangers(tmp_path):
    with pytest.raises(ConfigError, match=r"--partners: 'nothing.yml' cannot be read"):
        partners_of_flag("nothing.yml")
    with pytest.raises(ConfigError, match="must hold a mapping"):
        partners_of_flag(write(tmp_path / "list.yml", ["a"]))
    # The file of a run may be a stranger's: any function would be called with what the environment says
    stranger = Location("config.yml: partners", run_folder=tmp_path)
    with pytest.raises(ConfigError, match=r"may name no function of 'stable_baselines3\.common\.utils'"):
        check_partners({"members": {"a": "stable_baselines3.common.utils:set_random_seed"}}, stranger)
    assert check_partners(None, stranger) is None
