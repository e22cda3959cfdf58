"""The command ``sb3-belief export``."""

import shutil
import zipfile

import onnxruntime
import pytest
import torch as th

from sb3_belief import BeliefPPO, Team, make_team_env
from sb3_belief.cli.main import main
from tests.archives import archive_of, changed, changed_json, evil_data, members_of, rewrite


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


@pytest.fixture(scope="module")
def evil(run, tmp_path_factory):
    """The same run and agent from a stranger, with code of the stranger's in them."""
    folder = tmp_path_factory.mktemp("evil")
    shutil.copytree(run, folder, dirs_exist_ok=True)

    def as_of_sb3(content):
        """Leave out what this package writes besides, and put code into what SB3 does."""
        members = members_of(changed("data", evil_data("lr_schedule", "made_by_code"))(content))
        return archive_of({name: each for name, each in members.items() if name == "data" or name.endswith(".pth")})

    agent = as_of_sb3((run / "agents" / "car_1.zip").read_bytes())
    (folder / "car_1.zip").write_bytes(agent)
    rewrite(folder / "team.zip", "agents/car_1.zip", lambda _: agent)
    return folder


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
        ("{evil}:car_1", [], "agent 'car_1' has been written by Stable-Baselines3 alone"),
        ("{evil}/car_1.zip", [], "a pickle can run any code of whoever made the file"),
    ],
)
def test_what_cannot_be_exported_is_refused(run, evil, tmp_path, monkeypatch, capsys, given, options, message):
    monkeypatch.chdir(tmp_path)
    assert main(["export", given.format(run=run, evil=evil), *options]) == 2
    assert message.format(run=run) in capsys.readouterr().err and list(tmp_path.iterdir()) == []


AGENT, STATISTICS = "agents/car_1.zip", "agents/car_1.vecnormalize.json"


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("team.json", lambda _: b"[1]"),
        ("team.json", lambda data: data[:40]),
        ("team.json", changed_json(agents=3)),
        ("team.json", changed_json(classes=["x"])),
        ("team.json", changed_json(classes={"car_1": "torch.nn:Linear"})),
        (AGENT, lambda data: data[:99]),
        (AGENT, changed("data", lambda _: b"[1]")),
        (AGENT, changed("data", lambda _: b"{}")),
        (AGENT, changed("data", changed_json(policy_kwargs=[1]))),
        (AGENT, changed("data", changed_json(policy_kwargs={"net_arch": "x"}))),
        (AGENT, changed("data", changed_json(history_length="x"))),
        (AGENT, changed("policy.pth", lambda data: data[:99])),
        (AGENT, changed("sb3_belief.json", lambda data: data[:99])),
        (AGENT, changed("sb3_belief.json", changed_json(entries={}))),
        (AGENT, changed("sb3_belief.json", changed_json(entries={"policy_class": {"tree": 1, "size": 0}}))),
        (STATISTICS, lambda data: data[:99]),
        (STATISTICS, lambda _: b"3"),
    ],
)
def test_a_damaged_file_is_refused_by_its_name(run, tmp_path, monkeypatch, capsys, name, change):
    team = tmp_path / "team.zip"
    monkeypatch.chdir(tmp_path)
    # As damaged on its way, and as written so by someone
    for signed in (False, True):
        shutil.copy(run / "team.zip", team)
        rewrite(team, name, change, signed)
        assert main(["export", f"{team}:car_1"]) == 2
        said = capsys.readouterr().err
        assert said.startswith("Refused: export: ") and str(team) in said and said.count("\n") == 1
        assert name.removesuffix("zip").removesuffix("json") in said or "car_1" in said
    assert list(tmp_path.iterdir()) == [team]
