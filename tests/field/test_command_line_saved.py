"""Saved runs, whole, damaged and evil: refused with what is wrong with them, and never a call of what they hold."""

import os
import pickle
import shutil
import zipfile
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from stable_baselines3 import PPO

from sb3_belief.cli.main import main
from tests.archives import Evil, changed, evil_data, rewrite
from tests.field.command_lines import CODE, ENV, MADE, SMALL, TINY, check, draws
from tests.field.walkers import Walkers
from tests.team.helpers import Team, make_team_env


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A folder with a run, and copies of it that are damaged or evil in one way each."""
    folder = tmp_path_factory.mktemp("runs")
    home = Path.cwd()
    os.chdir(folder)
    try:
        assert main(["train", *TINY, "-f", "logs", "-params", *SMALL["belief_ppo"], "normalize:true"]) == 0
    finally:
        os.chdir(home)
    run = folder / "logs" / "belief_ppo" / f"{ENV}_1"
    run.rename(folder / "run")
    shutil.rmtree(folder / "logs")
    for name in ("record", "configuration", "team", "model", "statistics", "pickle", "class", "data", "weights", "empty"):
        shutil.copytree(folder / "run", folder / name)
    (folder / "record" / "run.json").write_text('{"algo": "belief')
    (folder / "empty" / "run.json").write_text("[]")
    (folder / "configuration" / "config.yml").write_text(f"{ENV}: {CODE[0]}\n")
    team = (folder / "run" / "team.zip").read_bytes()
    (folder / "team" / "team.zip").write_bytes(team[: len(team) // 2])
    shutil.copy(folder / "team" / "team.zip", folder / "cut.zip")
    shutil.copy(folder / "run" / "team.zip", folder / "moved.zip")
    (folder / "text.zip").write_text("no zip")
    _rewrite(folder / "model", "agents/follower.zip", lambda old: old[:99])
    _rewrite(folder / "statistics", "agents/follower.vecnormalize.json", lambda old: old[:99])
    _rewrite(folder / "pickle", "agents/follower.vecnormalize.pkl", lambda _: pickle.dumps(Evil(MADE)))
    _rewrite(folder / "class", "team.json", lambda old: old.replace(b"sb3_belief.belief_ppo.belief_ppo:", b"os:"))
    _rewrite(folder / "data", "agents/follower.zip", changed("data", evil_data("lr_schedule", MADE)))
    _rewrite(folder / "weights", "agents/follower.zip", changed("policy.pth", lambda _: pickle.dumps(Evil(MADE))))
    with zipfile.ZipFile(folder / "run" / "team.zip") as archive:
        (folder / "single.zip").write_bytes(archive.read("agents/follower.zip"))
    return folder


def _rewrite(run, name, change):
    rewrite(run / "team.zip", name, change)


_RUNS = "run record configuration team model statistics pickle class data weights empty".split()
_RUNS += "run/team cut.zip moved.zip text.zip single.zip nowhere / \\x00".split(" ")
_MORE = st.lists(
    st.sampled_from(
        [
            *(
                ["--env", ENV],
                ["--env", "traffic-junction-easy"],
                ["--env", "os:system"],
                ["--algo", "belief_ppo"],
                ["--algo", "ppo"],
            ),
            *(
                ["--device", "gpu"],
                ["--env-kwargs", "m:3"],
                ["--env-kwargs", "x:1"],
                ["--seed", "-1"],
                ["--seed", "1"],
                ["-n", "4"],
            ),
            *(["--allow-package", "nowhere"], ["--stochastic"], ["--fps", "0"], ["--episodes", "1"], ["--x"]),
        ]
    ),
    max_size=3,
)


@draws(300)
@given(name=st.sampled_from(_RUNS), command=st.sampled_from(["enjoy", "train"]), more=_MORE)
@example(name="pickle", command="enjoy", more=[])
@example(name="data", command="train", more=[["-n", "4"]])
@example(name="weights", command="enjoy", more=[])
@example(name="class", command="enjoy", more=[])
def test_saved_runs(name, command, more, runs):
    words = [word for each in more for word in each]
    if command == "enjoy":
        output = ["--output", "episode.gif"] if len(more) == 1 else []
        check(["enjoy", name, "-n", "3", *output, *words], runs)
    else:
        check(["train", "-i", name, "-n", "4", "-f", "logs", "--eval-freq", "-1", "--verbose", "0", *words], runs)


@pytest.mark.parametrize("name", ["run", "moved.zip"])
def test_what_is_not_damaged_is_played_and_continued(name, runs):
    # Otherwise the property above would hold for a program that refuses everything
    env, algo = (["--env", ENV], ["--algo", "belief_ppo"]) if name == "moved.zip" else ([], [])
    assert check(["enjoy", name, "-n", "3", *env], runs) == 0
    assert check(["train", "-i", name, "-n", "4", "--eval-freq", "-1", "--verbose", "0", *env, *algo], runs) == 0


def test_agents_whose_names_are_quoted_in_the_file_are_found(tmp_path):
    class Walk(Walkers):
        def __init__(self):
            super().__init__()
            self.possible_agents = ["left/first", "right"]

    team = Team(PPO, "MlpPolicy", make_team_env(Walk), normalize=True, n_steps=8, batch_size=8, device="cpu").learn(8)
    team.save(tmp_path / "team.zip")
    assert Team.load(tmp_path / "team.zip").possible_agents == ["left/first", "right"]
    rewrite(tmp_path / "team.zip", "agents/left%2Ffirst.vecnormalize.json", lambda _: b"[]")
    with pytest.raises(ValueError, match=r"agent 'left/first', member 'agents/left%2Ffirst\.vecnormalize\.json'"):
        Team.load(tmp_path / "team.zip")


def test_a_word_of_trust_loads_anything(runs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # What is pickled in the file is there as plain data too, so the pickles are left alone
    for name in ("pickle", "data"):
        assert main(["enjoy", str(runs / name), "-n", "3"]) == 0 and not (tmp_path / MADE).exists()
    main(["enjoy", str(runs / "data"), "--trust"])
    assert (tmp_path / MADE).exists()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("record", "run.json: is not readable as JSON"),
        ("empty", "run.json: must be a mapping, not list"),
        ("model", "agent 'follower' wasn't a zip-file, or it is damaged"),
        ("statistics", "agent 'follower', member 'agents/follower.vecnormalize.json': it is no JSON"),
        ("weights", "agent 'follower', member 'policy.pth': it holds no tensors"),
        ("class", "the agent 'follower' is a os:BeliefPPO, but 'os:BeliefPPO' is of a package that is not allowed"),
        ("single.zip", "It is the zip of a single model"),
    ],
)
def test_what_is_damaged_is_named(name, message, runs, capsys):
    env = ["--env", ENV] if name.endswith(".zip") else []
    assert main(["enjoy", str(runs / name), *env]) == 2
    assert message in capsys.readouterr().err
