"""What is tried before a run (a step of wrappers and optimisers), and which source a refusal names."""

import json

import pytest

from sb3_belief.cli.main import main
from tests.field.command_lines import SMALL, TINY, refused

JUNCTION = "traffic-junction-easy"
_CALLBACKS = "stable_baselines3.common.callbacks"
_CHECKPOINT = f"{_CALLBACKS}.CheckpointCallback"
_SECTIONS = "default: {n_timesteps: 8, policy: MlpPolicy, n_steps: 8, batch_size: 8}\n"


@pytest.mark.parametrize(
    ("pair", "message"),
    [
        ("policy_kwargs.optimizer_class:torch.optim.SparseAdam", "-params: policy_kwargs: the optimizer refuses what"),
        ("policy_kwargs.optimizer_class:torch.optim.LBFGS", "missing 1 required positional argument: 'closure'"),
        ("policy_kwargs.optimizer_class:torch.optim.Muon", "-params: policy_kwargs: "),
        ("policy_kwargs.optimizer_kwargs:{foo: 1}", "-params: policy_kwargs: the optimizer refuses what"),
        (
            "agent_kwargs:{follower: {policy_kwargs: {optimizer_class: torch.optim.LBFGS}}}",
            "-params: agent_kwargs: follower: policy_kwargs: the optimizer refuses what",
        ),
        ("env_wrapper:supersuit.clip_actions_v0", "-params: env_wrapper: convention-swap cannot be stepped with it: Attr"),
        (
            f"callback:{{{_CHECKPOINT}: {{save_freq: 4, save_path: /proc/ck}}}}",
            "-params: callback: save_path: cannot",
        ),
        (
            "env_wrapper:{supersuit.reward_lambda_v0: {change_reward_fn: x}}",
            "takes a function, which YAML cannot hold: write a function f(env) of your own that returns supersuit.reward_",
        ),
        ("env_wrapper:supersuit.frame_skip_v0", "supersuit.frame_skip_v0: needs 'num_frames'"),
        ("policy_kwargs.activation_fn:ReLU", "activation_fn: 'ReLU' is not a dotted path: write torch.nn.ReLU."),
        ("policy_kwargs.optimizer_class:adam", "'adam' is not a dotted path: write torch.optim.Adam."),
        ("env_wrapper:frame_stack_v1", "'frame_stack_v1' is not a dotted path: write supersuit.frame_stack_v1."),
        ("callback:CheckpointCallback", f"write {_CHECKPOINT}."),
        ("env_wrapper:nothing_v1", "'nothing_v1' is not a dotted path such as"),
        (
            "activation_fn:torch.nn.ReLU",
            "'activation_fn' is a setting of the policy: write policy_kwargs: {activation",
        ),
        ("normalize:{clip_obs:-1}", "unknown key 'clip_obs:-1'. A space belongs after the colon: clip_obs: -1."),
        ("env_kwargs:{m:3}", "unknown key 'm:3'. A space belongs after the colon: m: 3."),
        (f"callback:{{{_CALLBACKS}.EvalCallback: {{eval_freq: 4}}}}", "the team is evaluated every --eval-freq joint steps"),
    ],
)
def test_settings_that_would_fail_in_the_first_steps(pair, message, tmp_path, monkeypatch, capsys):
    if "Muon" in pair and not hasattr(pytest.importorskip("torch").optim, "Muon"):
        pytest.skip("this torch has no Muon")
    words = ["train", *TINY, "--algo", "ppo", "-params", *SMALL["ppo"]]
    if "optimizer" not in pair:
        words = [word for word in words if not word.startswith("policy_kwargs")]
    assert message in refused([*words, pair], tmp_path, monkeypatch, capsys)


def test_a_trial_changes_nothing_of_the_run(tmp_path, monkeypatch):
    # The wrapper changes nothing, and neither may the step in which it is tried
    monkeypatch.chdir(tmp_path)
    words = ["train", "--env", JUNCTION, "-n", "64", "--eval-freq", "-1", "--verbose", "0", "--seed", "3", "--algo", "ppo"]
    optimizer = "policy_kwargs.optimizer_class:torch.optim.Adam"
    results = {}
    for name, more in (("plain", []), ("tried", ["env_wrapper:{supersuit.dtype_v0: {dtype: float32}}", optimizer])):
        assert main([*words, "-f", name, "-params", "n_envs:1", "n_steps:16", "batch_size:16", *more]) == 0
        lines = next((tmp_path / name).rglob("monitor.csv")).read_text().splitlines()[2:]
        results[name] = [line.split(",")[:2] for line in lines]
    assert results["plain"] == results["tried"] and results["plain"]


def test_frames_may_be_skipped(tmp_path, monkeypatch):
    pytest.importorskip("mpe2")
    monkeypatch.chdir(tmp_path)
    words = ["train", "--env", "mpe/simple_spread_v3", "-n", "16", "--eval-freq", "-1", "--verbose", "0", "--algo", "ppo"]
    skipped = "env_wrapper:{supersuit.frame_skip_v0: {num_frames: 5}}"
    assert main([*words, "-params", "n_envs:1", "n_steps:8", "batch_size:8", skipped]) == 0
    lines = next(tmp_path.rglob("monitor.csv")).read_text().splitlines()
    # Of the 25 steps of an episode each joint step plays five
    assert [line.split(",")[1] for line in lines[2:]] == ["5"] * 3


@pytest.mark.parametrize(
    ("pairs", "source"),
    [
        # By the name of the setting, by the class that is its value, and where neither is told
        (["batch_size:1"], "-params"),
        (["policy_kwargs.activation_fn:torch.nn.Embedding"], "-params"),
        (["use_sde:true"], "-params"),
        (["agent_kwargs:{follower: {batch_size: 1}}"], "-params: agent_kwargs: follower"),
        (
            ["agent_kwargs:{follower: {policy_kwargs: {activation_fn: torch.nn.Embedding}}}"],
            "-params: agent_kwargs: follower",
        ),
        ([], "mine.yml, section convention-swap"),
    ],
)
def test_only_the_source_that_fails_is_named(pairs, source, tmp_path, monkeypatch, capsys):
    own = "" if pairs else "convention-swap: {policy_kwargs: {activation_fn: torch.nn.Embedding}}\n"
    (tmp_path / "mine.yml").write_text(_SECTIONS + own)
    words = ["train", "--env", "convention-swap", "--algo", "ppo", "-n", "8", "--conf-file", "mine.yml"]
    said = refused([*words, *(["-params", *pairs] if pairs else [])], tmp_path, monkeypatch, capsys)
    assert said.startswith(f"Refused: {source}: ppo cannot be set up on convention-swap: ")


@pytest.mark.parametrize("command", [["enjoy"], ["train", "-n", "4", "-i"]])
@pytest.mark.parametrize(("key", "value"), [("algo", "pppo"), ("env", "convention-swop"), ("env", "os:system")])
def test_a_record_is_blamed_for_what_it_names(command, key, value, tmp_path, monkeypatch, capsys):
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "team.zip").write_bytes(b"")
    (folder / "config.yml").write_text(_SECTIONS)
    (folder / "run.json").write_text(json.dumps({"algo": "ppo", "env": "convention-swap", key: value}))
    said = refused([*command, str(folder)], tmp_path, monkeypatch, capsys)
    assert said.startswith(f"Refused: {folder / 'run.json'}: {key}: ") and value.replace(":", ".") in said


def test_a_folder_is_no_configuration(tmp_path, monkeypatch, capsys):
    said = refused(["train", "--conf-file", str(tmp_path)], tmp_path, monkeypatch, capsys)
    assert f"--conf-file: '{tmp_path}' is a folder: name a file in it." in said
