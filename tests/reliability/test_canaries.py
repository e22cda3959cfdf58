"""A stranger's code in every member of a file, by every way in which files are loaded: it never runs."""

import io
import itertools
import json
import pickle
import shutil
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th

from sb3_belief import BeliefPPO, Team
from sb3_belief.cli.main import main
from sb3_belief.common.safe_files.trust import Trust
from sb3_belief.team.fixed_partners.partners import load_model
from tests.archives import Evil, archive_of, changed, changed_json, evil_data, members_of
from tests.field.command_lines import ENV, SMALL, TINY

MADE = "canary"
AGENT = "agents/follower.zip"


def evil_pickle(_):
    return pickle.dumps(Evil(MADE))


def evil_weights(_):
    """What ``torch.save`` writes, with a call in it."""
    file = io.BytesIO()
    th.save({"weight": Evil(MADE)}, file)
    return file.getvalue()


def evil_legacy_weights(_):
    file = io.BytesIO()
    th.save({"weight": Evil(MADE)}, file, _use_new_zipfile_serialization=False)
    return file.getvalue()


def evil_arrays(_):
    file = io.BytesIO()
    np.savez(file, weight=np.array([Evil(MADE)], dtype=object))
    return file.getvalue()


def evil_names(_):
    return json.dumps({"is": "function", "name": "os:system"}).encode()


PAYLOADS = [evil_pickle, evil_weights, evil_legacy_weights, evil_arrays, evil_names]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A folder of a run, with a normalised team."""
    folder = tmp_path_factory.mktemp("run")
    settings = [*SMALL["belief_ppo"], "normalize:true"]
    assert main(["train", *TINY, "-f", str(folder), "-params", *settings]) == 0
    (folder / "belief_ppo" / f"{ENV}_1").rename(folder / "run")
    return folder / "run"


def entry_points(folder, agent):
    """All ways to load the team in a run's folder, and its agent's own zip."""
    team = folder / "team.zip"
    train = ["train", "-n", "4", "-f", str(folder / "logs"), "--eval-freq", "-1", "--verbose", "0"]
    return {
        "Team.load": lambda: Team.load(team, device="cpu"),
        "set_parameters": lambda: Team.load(folder / "whole.zip", device="cpu").set_parameters(team),
        "partner": lambda: load_model(team, "follower"),
        "BeliefPPO.load": lambda: BeliefPPO.load(agent, device="cpu"),
        "partner of one": lambda: load_model(agent, ""),
        "enjoy": lambda: main(["enjoy", str(folder), "-n", "3"]),
        "export": lambda: main(["export", f"{folder}:follower", "--output", str(folder / "a.pt2"), "--format", "torch"]),
        "-i": lambda: main([*train, "-i", str(folder)]),
    }


def everywhere(run, tmp_path, team):
    """Load a changed team in every way; no code runs, and what is raised is an error that names it."""
    folder = tmp_path / "run"
    shutil.copytree(run, folder, dirs_exist_ok=True)
    shutil.copy(run / "team.zip", folder / "whole.zip")
    (folder / "team.zip").write_bytes(team)
    agent = tmp_path / "follower.zip"
    agent.write_bytes(members_of(team).get(AGENT, b""))
    said = {}
    for name, load in entry_points(folder, agent).items():
        try:
            said[name] = load()
        except (ValueError, TypeError) as error:
            said[name] = str(error)
        assert not Path(MADE).exists(), name
    return said


def test_the_payloads_are_payloads(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pickle.loads(evil_pickle(b""))
    assert Path(MADE).exists()
    for payload in (evil_weights, evil_legacy_weights):
        Path(MADE).rmdir()
        th.load(io.BytesIO(payload(b"")), weights_only=False)
        assert Path(MADE).exists()
    Path(MADE).rmdir()
    with np.load(io.BytesIO(evil_arrays(b"")), allow_pickle=True) as arrays:
        assert arrays["weight"] is not None and Path(MADE).exists()


def test_a_canary_in_every_member_never_sings(run, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    whole = (run / "team.zip").read_bytes()
    outer, inner = members_of(whole), members_of(members_of(whole)[AGENT])
    assert {"data", "policy.pth", "policy.optimizer.pth", "sb3_belief.json", "sb3_belief.bin"} <= inner.keys()
    # Each member meets some of the payloads by way of all entries, all of them by Team.load
    payloads = itertools.cycle(PAYLOADS)
    for name in [*outer, *(f"{AGENT}/{each}" for each in inner), "parts/new.json", f"{AGENT}/new.pth"]:
        place, _, member = name.partition(f"{AGENT}/")
        for payload in PAYLOADS:
            change = changed(AGENT, changed(member, payload)) if member else changed(place, payload)
            (tmp_path / "one.zip").write_bytes(change(whole))
            try:
                Team.load(tmp_path / "one.zip", device="cpu")
            except ValueError as error:
                assert "one.zip" in str(error)
            assert not Path(MADE).exists(), name
        payload = next(payloads)
        change = changed(AGENT, changed(member, payload)) if member else changed(place, payload)
        everywhere(run, tmp_path, change(whole))
    capsys.readouterr()


def test_pickles_of_sb3_are_left_alone(run, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    whole = (run / "team.zip").read_bytes()
    for key in ("policy_class", "lr_schedule", "observation_space"):
        said = everywhere(run, tmp_path, changed(AGENT, changed("data", evil_data(key, MADE)))(whole))
        # What takes their place is there, so that the file loads as if nothing were
        assert isinstance(said["Team.load"], Team) and said["enjoy"] == 0
    said = everywhere(run, tmp_path, changed(AGENT, changed("data", evil_data("new", MADE)))(whole))
    assert "entry 'new' is there as a pickle only" in said["Team.load"] and said["enjoy"] == 2
    capsys.readouterr()


def only_sb3(content):
    members = members_of(content)
    return archive_of({name: each for name, each in members.items() if not name.startswith(("sb3_belief", "SHA"))})


def test_files_without_our_members_need_a_word_of_trust(run, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    whole = (run / "team.zip").read_bytes()
    evil_agent = changed("data", evil_data("lr_schedule", MADE))
    said = everywhere(run, tmp_path, changed(AGENT, lambda agent: only_sb3(evil_agent(agent)))(whole))
    for name in ("Team.load", "partner", "BeliefPPO.load", "partner of one"):
        assert "a pickle can run any code of whoever made the file" in said[name] and "trust_pickle=True" in said[name]
    assert said["enjoy"] == said["export"] == said["-i"] == 2
    # A team of the earlier layout
    older = members_of(changed("team.json", changed_json(format=1))(changed(AGENT, evil_agent)(whole)))
    del older["SHA256SUMS"]
    older["agents/follower.vecnormalize.pkl"] = evil_pickle(b"")
    said = everywhere(run, tmp_path, archive_of(older))
    assert "is of an earlier version" in said["Team.load"] and said["enjoy"] == 2
    with pytest.raises(Exception, match=r"."):
        load_model(tmp_path / "run" / "team.zip", "follower", Trust(trust_pickle=True))
    assert Path(MADE).exists()
    capsys.readouterr()


NAMES = ["os:system", "builtins:eval", "builtins:exec", "subprocess:Popen", "posix:system", "pickle:loads", "os:path.join"]
#: Of allowed packages, but nothing that a model is made of
NAMES += [
    "stable_baselines3.common.save_util:load_from_pkl",
    "stable_baselines3.common.logger:CSVOutputFormat",
    "stable_baselines3.common.monitor:Monitor",
    "stable_baselines3.common.save_util:th.load",
    "torch.nn.modules.module:torch.load",
    "sb3_belief.cli.main:main",
]


@pytest.mark.parametrize("name", NAMES)
def test_names_of_what_could_do_something_are_refused(name, run, tmp_path):
    whole = (run / "team.zip").read_bytes()
    with pytest.raises(ValueError, match="agent 'follower'"):
        load_changed(tmp_path, changed("team.json", changed_json(classes={"follower": name}))(whole))
    owner = {"is": "object", "class": name, "state": {}}
    method = {"is": "method", "name": "load_replay_buffer", "self": owner}
    for tree in ({"is": "class", "name": name}, {"is": "function", "name": name}, owner, method):
        for key in ("lr_schedule", "policy_class", "policy_kwargs"):

            def with_tree(text, tree=tree, key=key):
                about = json.loads(text)
                about["entries"][key] = {"tree": tree, "size": 0}
                return json.dumps(about).encode()

            content = changed(AGENT, changed("sb3_belief.json", with_tree))(whole)
            with pytest.raises(ValueError, match=rf"agent 'follower', member 'sb3_belief.json', entry '{key}'"):
                load_changed(tmp_path, content)
    statistics = changed("agents/follower.vecnormalize.json", lambda _: json.dumps(owner).encode())(whole)
    with pytest.raises(ValueError, match=r"agent 'follower', member 'agents/follower\.vecnormalize\.json'"):
        load_changed(tmp_path, statistics)


def load_changed(folder, content):
    (folder / "changed.zip").write_bytes(content)
    return Team.load(folder / "changed.zip", device="cpu")


def test_an_environment_in_the_file_is_not_made(tmp_path):
    model = BeliefPPO("BeliefPolicy", gym.make("CartPole-v1"), belief="none", n_steps=8, batch_size=8)
    model.save(tmp_path / "a.zip")
    (tmp_path / "canary_module.py").write_text("raise SystemExit('imported')")
    content = changed("data", changed_json(env="canary_module:Env-v0"))((tmp_path / "a.zip").read_bytes())
    (tmp_path / "a.zip").write_bytes(content)
    with pytest.raises(ValueError, match="member 'data': it holds an environment"):
        BeliefPPO.load(tmp_path / "a.zip")


def test_what_a_stranger_writes_beside_the_team_runs_nothing(run, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "run"
    Path("evil.pkl").write_bytes(evil_pickle(b""))
    envs = ["stable_baselines3.common.save_util:load_from_pkl", "os:system", "lbf/canary:Env-v0", "torch.nn:Linear"]
    envs += ["sb3_belief.cli.main:main", "stable_baselines3.common.monitor:Monitor"]
    outside = {
        "callback": {"stable_baselines3.common.callbacks.CheckpointCallback": {"save_freq": 1, "save_path": "../elsewhere"}},
        "env_wrapper": {"stable_baselines3.common.monitor.Monitor": {"filename": "elsewhere"}},
        "visibility": "stable_baselines3.common.save_util.load_from_pkl",
    }
    commands = [["enjoy", str(folder), "-n", "2"], ["watch", str(folder)]]
    commands += [["train", "-i", str(folder), "-n", "4", "--eval-freq", "-1", "-f", "logs"]]
    for env in envs:
        for command in commands:
            shutil.rmtree(folder, ignore_errors=True)
            shutil.copytree(run, folder)
            record = changed_json(env=env, algo="belief_ppo")((folder / "run.json").read_bytes())
            (folder / "run.json").write_bytes(record)
            config = {env: {"policy": "BeliefPolicy", "n_timesteps": 4, "env_kwargs": {"path": "evil.pkl"}}}
            (folder / "config.yml").write_text(json.dumps(config))
            assert main(command) == 2 and "run.json: env" in capsys.readouterr().err
            assert sorted(path.name for path in tmp_path.iterdir()) == ["evil.pkl", "run"]
    for key, value in outside.items():
        for command in commands:
            shutil.rmtree(folder, ignore_errors=True)
            shutil.copytree(run, folder)
            config = {ENV: {"policy": "BeliefPolicy", "n_timesteps": 4, key: value}}
            (folder / "config.yml").write_text(json.dumps(config))
            assert main(command) == 2
            said = capsys.readouterr().err
            assert "config.yml" in said and key in said and "--trust" in said
            assert sorted(path.name for path in tmp_path.iterdir()) == ["evil.pkl", "run"]
