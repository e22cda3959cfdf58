"""The command ``sb3-belief export``."""

import base64
import json
import os
import pickle
import tempfile
import zipfile
from pathlib import Path

import onnxruntime
import pytest
import torch as th

from sb3_belief import BeliefPPO, Team, make_team_env
from sb3_belief.zoo.cli import main


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A folder with the team of a run, and the zip of one of its agents."""
    folder = tmp_path_factory.mktemp("run")
    env = make_team_env("traffic-junction-easy", n_envs=2, seed=0)
    team = Team(BeliefPPO, "BeliefPolicy", env, seed=0, n_steps=8, batch_size=16, normalize=True)
    team.learn(16).save(folder / "team.zip")
    with zipfile.ZipFile(folder / "team.zip") as archive:
        archive.extract("agents/car_1.zip", folder)
    return folder


class Evil:
    """What a stranger's pickle may hold: a call of anything."""

    def __reduce__(self):
        return os.mkdir, ("made_by_code",)


@pytest.fixture(scope="module")
def evil(run, tmp_path_factory):
    """The same run and agent from a stranger, with code of the stranger's in them."""
    folder = tmp_path_factory.mktemp("evil")
    rewrite(run / "agents" / "car_1.zip", folder / "car_1.zip", "data", with_code)
    agent = (folder / "car_1.zip").read_bytes()
    rewrite(run / "team.zip", folder / "team.zip", "agents/car_1.zip", lambda _: agent)
    return folder


def with_code(data):
    pickled = base64.b64encode(pickle.dumps(Evil())).decode()
    return json.dumps({**json.loads(data), "lr_schedule": {":type:": "x", ":serialized:": pickled}}).encode()


def rewrite(path, target, name, change):
    with zipfile.ZipFile(path) as archive, zipfile.ZipFile(target, "w") as changed:
        for each in archive.namelist():
            changed.writestr(each, change(archive.read(each)) if each == name else archive.read(each))


def test_an_agent_is_written_where_one_is(run, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["export", f"{run}:car_1"]) == 0
    session = onnxruntime.InferenceSession("car_1.onnx")
    printed = capsys.readouterr().out
    assert "input   observation: float32 [B, 79]" in printed and "output  others.car_0: float32 [B, 2]" in printed
    for each in (*session.get_inputs(), *session.get_outputs()):
        assert f"{each.name}: " in printed
    assert main(["export", f"{run / 'team.zip'}:car_1", "--format", "torch", "--output", "deep/down.pt2"]) == 0
    # The agent's statistics went with it
    env = make_team_env("traffic-junction-easy", n_envs=3, seed=1)
    observations = env.reset()
    probabilities = th.export.load("deep/down.pt2").module()(th.as_tensor(observations["car_1"]))["action_probabilities"]
    actions, _ = Team.load(run / "team.zip").predict(observations, deterministic=True)
    assert (probabilities.argmax(dim=1).numpy() == actions["car_1"]).all()
    (onnx,) = session.run(["action_probabilities"], {"observation": observations["car_1"]})
    assert abs(onnx - probabilities.detach().numpy()).max() < 1e-5


def test_a_single_agents_zip_will_do(run, tmp_path):
    assert main(["export", str(run / "agents" / "car_1.zip"), "--output", str(tmp_path / "a.onnx")]) == 0
    assert (tmp_path / "a.onnx").exists()


@pytest.mark.parametrize(
    ("given", "options", "message"),
    [
        ("{run}", [], "Refused: export: name the agent: {run}:agent, one of ['car_0', 'car_1', 'car_2', 'car_3', 'car_4']"),
        ("{run}/team.zip", [], "name the agent: {run}/team.zip:agent, one of ['car_0'"),
        ("{run}:car_9", [], "has no agent 'car_9'. Did you mean"),
        ("{run}/agents/car_1.zip:car_1", [], "is the zip of a single agent"),
        ("nowhere:car_1", [], "no file or folder 'nowhere:car_1'"),
        ("{run}:car_1", ["--output", "car.pt2"], "end it in .onnx"),
        ("{run}:car_1", ["--output", "/proc/car.onnx"], "--output: cannot write the file"),
        ("{evil}:car_1", [], "'car_1' needs 'posix.mkdir', which could run any code"),
        ("{evil}/car_1.zip", [], "'car_1' needs 'posix.mkdir', which could run any code"),
    ],
)
def test_what_cannot_be_exported_is_refused(run, evil, tmp_path, monkeypatch, capsys, given, options, message):
    monkeypatch.chdir(tmp_path)
    assert main(["export", given.format(run=run, evil=evil), *options]) == 2
    assert message.format(run=run) in capsys.readouterr().err and list(tmp_path.iterdir()) == []


def changed_data(**changes):
    return lambda data: json.dumps({**json.loads(data), **changes}).encode()


def changed_model(change, name="data"):
    def changed(content):
        with tempfile.TemporaryDirectory() as folder:
            Path(folder, "a.zip").write_bytes(content)
            rewrite(Path(folder, "a.zip"), Path(folder, "b.zip"), name, change)
            return Path(folder, "b.zip").read_bytes()

    return changed


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("team.json", lambda _: b"[1]"),
        ("team.json", lambda data: data[:40]),
        ("team.json", changed_data(agents=3)),
        ("team.json", changed_data(classes=["x"])),
        ("team.json", changed_data(classes={"car_1": "torch.nn:Linear"})),
        ("agents/car_1.zip", lambda data: data[:99]),
        ("agents/car_1.zip", changed_model(lambda _: b"[1]")),
        ("agents/car_1.zip", changed_model(lambda _: b"{}")),
        ("agents/car_1.zip", changed_model(changed_data(observation_space=None))),
        ("agents/car_1.zip", changed_model(changed_data(policy_kwargs=[1]))),
        ("agents/car_1.zip", changed_model(changed_data(policy_kwargs={"net_arch": "x"}))),
        ("agents/car_1.zip", changed_model(changed_data(history_length="x"))),
        ("agents/car_1.zip", changed_model(changed_data(policy_class={":type:": "x", ":serialized:": "gAR9lC4="}))),
        ("agents/car_1.zip", changed_model(lambda data: data[:99], "policy.pth")),
        ("agents/car_1.vecnormalize.pkl", lambda data: data[:99]),
        ("agents/car_1.vecnormalize.pkl", lambda _: pickle.dumps(3)),
    ],
)
def test_a_damaged_file_is_refused_by_its_name(run, tmp_path, monkeypatch, capsys, name, change):
    team = tmp_path / "team.zip"
    rewrite(run / "team.zip", team, name, change)
    monkeypatch.chdir(tmp_path)
    # Also without the look at the file that trust leaves out
    for trust in ([], ["--trust"]):
        assert main(["export", f"{team}:car_1", *trust]) == 2
        said = capsys.readouterr().err
        assert said.startswith("Refused: export: ") and str(team) in said and said.count("\n") == 1
        assert "team.json" in name or "car_1" in said
    assert list(tmp_path.iterdir()) == [team]
