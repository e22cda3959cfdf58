"""Saved runs, whole, damaged and evil: refused with what is wrong with them, and never a call of what they hold."""

import base64
import io
import json
import os
import pickle
import shutil
import zipfile
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from stable_baselines3 import PPO
from stable_baselines3.common.type_aliases import TrainFrequencyUnit
from stable_baselines3.common.vec_env import VecNormalize

from sb3_belief.zoo.cli import main
from sb3_belief.zoo.errors import ConfigError
from sb3_belief.zoo.trust import check_saved_team
from tests.field.command_lines import CODE, ENV, MADE, SMALL, TINY, check, draws
from tests.field.walkers import Walkers
from tests.team.helpers import Team, make_team_env


class _Evil:
    """What a stranger's pickle may hold: a call of anything."""

    def __reduce__(self):
        return os.mkdir, (MADE,)


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
    _rewrite(folder / "model" / "team.zip", "agents/follower.zip", lambda old: old[:99])
    _rewrite(folder / "statistics" / "team.zip", "agents/follower.vecnormalize.pkl", lambda old: old[:99])
    _rewrite(folder / "pickle" / "team.zip", "agents/follower.vecnormalize.pkl", lambda _: pickle.dumps(_Evil()))
    _rewrite(folder / "class" / "team.zip", "team.json", lambda old: old.replace(b"sb3_belief.belief_ppo.belief_ppo:", b"os:"))
    _rewrite(folder / "data" / "team.zip", "agents/follower.zip", _with_evil_data)
    _rewrite(folder / "weights" / "team.zip", "agents/follower.zip", _with_evil_weights)
    with zipfile.ZipFile(folder / "run" / "team.zip") as archive:
        (folder / "single.zip").write_bytes(archive.read("agents/follower.zip"))
    return folder


def _rewrite(path, name, change):
    with zipfile.ZipFile(path) as archive:
        parts = {each: archive.read(each) for each in archive.namelist()}
    parts[name] = change(parts[name])
    with zipfile.ZipFile(path, "w") as archive:
        for each, content in parts.items():
            archive.writestr(each, content)


def _changed_model(content, name, change):
    file = io.BytesIO(content)
    _rewrite(file, name, change)
    return file.getvalue()


def _with_evil_data(content):
    evil = base64.b64encode(pickle.dumps(_Evil())).decode()

    def change(data):
        return json.dumps({**json.loads(data), "lr_schedule": {":type:": "x", ":serialized:": evil}}).encode()

    return _changed_model(content, "data", change)


def _with_evil_weights(content):
    return _changed_model(content, "policy.pth", lambda _: pickle.dumps(_Evil()))


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
    check_saved_team(tmp_path / "team.zip", "enjoy")
    _rewrite(tmp_path / "team.zip", "agents/left%2Ffirst.vecnormalize.pkl", lambda _: pickle.dumps(_Evil()))
    with pytest.raises(ConfigError, match=r"agent 'left/first' needs 'posix\.mkdir'"):
        check_saved_team(tmp_path / "team.zip", "enjoy")


class MemberByName:
    """An Enum's member as some Pythons pickle it, and another attribute in the same way."""

    def __init__(self, owner, name):
        self.owner, self.name = owner, name

    def __reduce__(self):
        return getattr, (self.owner, self.name)


def test_members_of_an_enum_are_data_and_other_attributes_are_not(runs, tmp_path):
    def with_member(owner, name):
        pickled = pickle.dumps(MemberByName(owner, name))
        shutil.copy(runs / "run" / "team.zip", tmp_path / "team.zip")
        _rewrite(tmp_path / "team.zip", "agents/follower.vecnormalize.pkl", lambda _: pickled)
        check_saved_team(tmp_path / "team.zip", "enjoy")

    with_member(TrainFrequencyUnit, "STEP")
    for owner, name in ((TrainFrequencyUnit, "mro"), (VecNormalize, "load"), (VecNormalize, "__init__")):
        with pytest.raises(ConfigError, match=r"needs 'builtins\.getattr', which could run any code"):
            with_member(owner, name)


@pytest.mark.parametrize("name", ["pickle", "data"])
def test_a_word_of_trust_loads_anything(name, runs, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["enjoy", str(runs / name)]) == 2
    said = capsys.readouterr().err
    assert "agent 'follower' needs 'posix.mkdir'" in said and "--trust" in said and not (tmp_path / MADE).exists()
    main(["enjoy", str(runs / name), "--trust"])
    assert (tmp_path / MADE).exists()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("record", "run.json: is not readable as JSON"),
        ("empty", "run.json: must be a mapping, not list"),
        ("model", "the file of agent 'follower' cannot be read"),
        ("statistics", "the file of agent 'follower' cannot be read"),
        ("weights", "the file of agent 'follower' cannot be read"),
        ("single.zip", "it is the zip of a single SB3 model"),
    ],
)
def test_what_is_damaged_is_named(name, message, runs, capsys):
    env = ["--env", ENV] if name.endswith(".zip") else []
    assert main(["enjoy", str(runs / name), *env]) == 2
    assert message in capsys.readouterr().err
