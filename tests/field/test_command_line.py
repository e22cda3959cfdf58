"""The command line: what it refuses before anything is written, and what it takes."""

import io
import json
import re
import subprocess
import sys

import numpy as np
import pytest
import yaml

from sb3_belief.cli.main import COMMANDS, main, train_main
from sb3_belief.common.versions import __version__
from sb3_belief.envs import registry
from sb3_belief.team import Team
from sb3_belief.zoo import preflight
from sb3_belief.zoo.config import load_config
from sb3_belief.zoo.errors import ConfigError, cause, shorten
from tests.field.command_lines import SMALL, TINY, refused

JUNCTION = "traffic-junction-easy"
_RUN = "import sys; from sb3_belief.cli.main import main; sys.exit(main({words}))"


@pytest.mark.parametrize(
    ("pair", "message"),
    [
        ("n_epochs:0", "-params: n_epochs: must be at least 1, not 0"),
        ("policy_kwargs.net_arch:[8,-8]", "-params: policy_kwargs: net_arch: must be at least 1, not -8"),
        ("policy_kwargs.net_arch:{pi: [8], vf: [0]}", "net_arch: vf: must be at least 1, not 0"),
        (
            "policy_kwargs.net_arch:{pl: [8]}",
            "-params: policy_kwargs: net_arch: unknown network 'pl'. Did you mean 'pi'? Allowed: pi, vf.",
        ),
        ("policy_kwargs.net_arch:{pi: [8], qf: [8]}", "net_arch: unknown network 'qf'."),
        ("agent_kwargs:{car_1: {policy_kwargs: {net_arch: {v: [8]}}}}", "car_1: policy_kwargs: net_arch: unknown network 'v'"),
        ("policy_kwargs.embedding_dim:-1", "embedding_dim: must be at least 1, not -1"),
        ("ent_coef:.nan", "ent_coef: must be a finite number, not nan"),
        ("learning_rate:-.inf", "learning_rate: must be a finite number, not -inf"),
        ("learning_rate:lin_inf", "learning_rate: must be a finite number, not inf"),
        ("learning_rate:-1e-3", "learning_rate: must be at least 0, not -0.001"),
        ("policy_kwargs.optimizer_kwargs:{eps: .nan}", "optimizer_kwargs: eps: must be a finite number"),
        ("gamma:1.1", "gamma: must be in [0, 1], not 1.1"),
        ("gae_lambda:-0.1", "gae_lambda: must be in [0, 1], not -0.1"),
        ("clip_range:-0.2", "clip_range: must be greater than 0, not -0.2"),
        ("clip_range:lin_-0.2", "clip_range: must be greater than 0, not -0.2"),
        ("clip_range_vf:0", "clip_range_vf: must be greater than 0"),
        ("max_grad_norm:-1", "max_grad_norm: must be greater than 0"),
        ("normalize:{gamma: x}", "normalize: gamma: must be a number, not 'x'"),
        ("normalize:{gamma: 2}", "normalize: gamma: must be in [0, 1]"),
        ("normalize:{norm_obs: 1}", "normalize: norm_obs: must be true or false"),
        ("normalize:{clip: 1}", "normalize: unknown key 'clip'"),
        ("n_steps:010", "'010' is octal in YAML 1.1: write a decimal number"),
        ("n_steps:1:30", "'1:30' is in base 60 in YAML 1.1"),
        ("n_steps:" + "9" * 400, "n_steps"),
        ("callback:stable_baselines3.common.callbacks.CheckpointCallback", "needs 'save_freq' (an integer) and 'save_path'"),
        ("callback:stable_baselines3.common.callbacks.EvalCallback", "the team is evaluated every --eval-freq joint steps"),
        (
            "callback:{stable_baselines3.common.callbacks.CheckpointCallback: {save_freq: 0, save_path: x}}",
            "save_freq: must be",
        ),
        (
            "callback:{stable_baselines3.common.callbacks.StopTrainingOnRewardThreshold: {reward_threshold: 1}}",
            "only inside an",
        ),
        ("callback:stable_baselines3.common.callbacks.BaseCallback", "-params: callback: refuses its settings"),
        ("env_wrapper:supersuit.pad_observations_v9", "env_wrapper"),
        ("env_wrapper:supersuit.dtype_v0", "-params: env_wrapper: supersuit.dtype_v0: needs 'dtype'"),
        ("rollout_buffer_class:stable_baselines3.common.buffers.ReplayBuffer", "is not a subclass of"),
        ("batch_size:3", "batch_size"),
        ("a:!!python/object/apply:os.mkdir [made]", "could not determine a constructor for the tag"),
        ("a:&a [*a]", "stands for more than 100,000 values"),
    ],
)
def test_settings_that_sb3_refuses_late_or_never(pair, message, tmp_path, monkeypatch, capsys):
    if pair == "batch_size:3":
        pair = "history_length:0"
        message = "-params: belief_ppo cannot be set up on traffic-junction-easy: history_length is 0"
    assert message in refused(["train", "--env", JUNCTION, "-params", pair], tmp_path, monkeypatch, capsys)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["-n", "inf"], "-n/--n-timesteps: must be a whole number from 1"),
        (["-n", "nan"], "-n/--n-timesteps: must be a whole number from 1"),
        (["-n", "x"], "not 'x'"),
        (["--seed", "-1"], "--seed: must be a whole number from 0 to 2,147,483,647, not '-1'"),
        (["--seed", "0", "1", "2"], "for seed in 0 1 2; do sb3-belief train --seed $seed"),
        (["--jobs", "1e9"], "--jobs: must be a whole number from 1 to 1,024"),
        (["-f", "/etc/hostname"], "-f: cannot write in the folder '/etc/hostname"),
        (["-f", "/proc/runs"], "-f: cannot write in the folder '/proc/runs"),
        (["-f", "a" * 300], "-f: cannot write in the folder 'aaa"),
        (["-tb", "/proc/tb"], "-tb: cannot write in the folder '/proc/tb"),
        (["--device", "gpu"], "--device: 'gpu' is not available here (torch knows no such device). Allowed: auto, cpu"),
        (["--device", "meta"], "--device: 'meta' is not available here"),
        (["--n-eval-envs", "1e14"], "--n-eval-envs: 100,000,000,000,000 copies of the environment need at least"),
        (["-params", "n_envs:1e14"], "-params: 100,000,000,000,000 copies of the environment need"),
        (["-params", "n_steps:1e13"], "-params: the models need about"),
        (["-params", "policy_kwargs.net_arch:[10000000,10000000]"], "Lower 'net_arch', of which car_0 alone needs"),
        (["-params", "history_length:1e13"], "Lower 'history_length'"),
        (["--algo", "maskable_ppo", "--env", "convention-swap"], "maskable_ppo needs action masks, and convention-swap gives"),
        (["--algo", "dqn", "-params", "train_freq:[1, episode]"], "counts episodes, which needs n_envs: 1, not 8"),
        (["--algo", "sac", "-params", "policy:MlpPolicy", "policy_kwargs.net_arch:{pi: [8], vf: [8]}"], "network 'vf'"),
        (["--algo", "dqn", "-params", "train_freq:[1, epoch]"], "'step' or 'episode' not 'epoch'"),
        (["--algo", "dqn", "-params", "train_freq:[1, 2]"], "train_freq: must be an integer or a list (an integer, a string)"),
        (["--algo", "dqn", "-params", "train_freq:[0, step]"], "train_freq: must be at least 1, not 0"),
        (["--allow-package", "nowhere", "--env", "x"], "--allow-package: there is no module 'nowhere'"),
        (["--unknown"], "unrecognized arguments: --unknown"),
    ],
)
def test_flags_and_sizes_that_are_refused(words, message, tmp_path, monkeypatch, capsys):
    assert message in refused(["train", "--env", JUNCTION, *words], tmp_path, monkeypatch, capsys)


@pytest.mark.parametrize(
    "words",
    [
        *(["train", flag] for flag in ("--env", "--algo", "-f", "-tb", "-i", "-conf", "--device", "--allow-package")),
        *([command, "x", flag] for command in ("enjoy", "watch") for flag in ("--env", "--output", "--device")),
        *([command] for command in ("enjoy", "watch", "export")),
        *(["export", "x:y", "--output"], ["envs", "list"], ["envs", "check"], ["demo", "-f"]),
    ],
)
def test_values_that_are_empty_are_refused(words, tmp_path, monkeypatch, capsys):
    for empty in ("", " "):
        assert "must not be empty" in refused([*words, empty], tmp_path, monkeypatch, capsys)


@pytest.mark.parametrize(
    "words", [["train", "-f"], ["train", "-tb"], ["enjoy", "x", "--output"], ["watch", "x", "--output"], ["demo", "-f"]]
)
def test_a_home_that_the_shell_has_not_replaced_is_refused(words, tmp_path, monkeypatch, capsys):
    for path in ("~nouser/x", "~/x.gif"):
        assert f"'{path}' begins with '~'" in refused([*words, path], tmp_path, monkeypatch, capsys)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGPIPE")
def test_a_closed_pipe_ends_the_command_quietly():
    command = f"{sys.executable} -m sb3_belief envs"
    # Nobody reads; the shell's exit status is that of the command
    script = f"set -o pipefail; {command} | true"
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (141, "")


def test_a_closed_pipe_of_another_program_is_no_end_of_the_output(monkeypatch):
    def fail(*_):
        raise BrokenPipeError("of a worker")

    monkeypatch.setattr(COMMANDS["envs"], "run", fail)
    with pytest.raises(BrokenPipeError, match="of a worker"):
        main(["envs"])


def test_a_gpu_that_is_not_there_is_refused(tmp_path, monkeypatch, capsys):
    def no_driver(*_, device):
        raise RuntimeError("Found no NVIDIA driver")

    monkeypatch.setattr(preflight.th, "zeros", no_driver)
    monkeypatch.setattr(preflight.th.cuda, "is_available", lambda: False)
    said = refused(["train", "--env", JUNCTION, "--device", "cuda"], tmp_path, monkeypatch, capsys)
    assert "'cuda' is not available here (Found no NVIDIA driver). Allowed: auto, cpu." in said


def test_a_buffer_counts_only_as_far_as_the_run_fills_it(monkeypatch, tmp_path):
    # A million rows of DQN's default do not fit, and eight do
    monkeypatch.setattr(preflight, "total_memory", lambda: 10e6)
    monkeypatch.chdir(tmp_path)
    words = ["train", "--algo", "dqn", "--env", "convention-swap", "--eval-freq", "-1", "--verbose", "0", "-params"]
    assert main([*words, "n_envs:1", "buffer_size:1000000", "-n", "8"]) == 0
    assert main([*words, "n_envs:1", "buffer_size:1000000", "-n", "1e6"]) == 2


def test_a_refusal_names_where_the_value_comes_from(tmp_path, monkeypatch, capsys):
    (tmp_path / "mine.yml").write_text(
        "default: {n_timesteps: 8, policy: BeliefPolicy, keep_ratio: 0.1, env_kwargs: {vision: 1}}\n"
    )
    words = ["train", "--env", JUNCTION, "--conf-file", "mine.yml"]
    for more, origin in (
        (["-params", "keep_ratio:7"], "-params"),
        (["-params", "history_length:4", "--env-kwargs", "vision:-1"], "--env-kwargs"),
    ):
        said = refused([*words, *more], tmp_path, monkeypatch, capsys)
        assert said.startswith(f"Refused: {origin}: ") and "mine.yml" not in said
    (tmp_path / "mine.yml").write_text("default: {n_timesteps: 8, policy: BeliefPolicy, keep_ratio: 7}\n")
    said = refused([*words, "-params", "history_length:4"], tmp_path, monkeypatch, capsys)
    assert said.startswith("Refused: mine.yml, section default: ")


def test_long_spaces_are_shortened():
    bounds = "[" + " ".join(["-1.5e+00"] * 500) + "]"
    text = shorten(f"Box({bounds}, [[0. 0.]\n [1. 1.]], (500,), float32) differs from Discrete(2)")
    assert (
        text == "Box([-1.5e+00 -1.5e+00 ... -1.5e+00 -1.5e+00], [[0. 0.]\n [1. 1.]], (500,), float32) differs from Discrete(2)"
    )


def test_the_cause_of_an_error_tells_where_it_was_raised():
    try:
        json.loads("{}")["missing"]
    except KeyError as error:
        assert re.fullmatch(r"KeyError: 'missing'\. \(test_command_line\.py, line \d+\)", cause(error))
    assert cause(ValueError("n is 3; it must be 4.")) == "n is 3; it must be 4."


def test_a_failure_after_the_start_is_recorded(tmp_path, monkeypatch, capfd):
    (tmp_path / "late_failure.py").write_text(
        "from stable_baselines3.common.callbacks import BaseCallback\n"
        "class Late(BaseCallback):\n"
        "    def _on_training_start(self):\n"
        "        raise SystemExit('enough')\n"
        "    def _on_step(self):\n"
        "        return True\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    words = ["train", *TINY, "--allow-package", "late_failure", "-params", *SMALL["belief_ppo"], "callback:late_failure.Late"]
    assert main(words) == 1
    assert "Failed: The training failed after 0 joint steps: SystemExit: enough." in capfd.readouterr().err
    record = json.loads(next(tmp_path.rglob("run.json")).read_text())
    assert record["status"] == "failed" and record["error"].startswith("SystemExit: enough.")

    # After the last step the disk is full
    def full(self, file, exact=False):
        if not isinstance(file, io.BytesIO):
            raise OSError("disk full")

    monkeypatch.setattr(Team, "save", full)
    words = ["train", *TINY, "-f", "more", "--save-every", "-1", "-params", *SMALL["belief_ppo"]]
    assert main(words) == 1
    assert capfd.readouterr().err.count("could not be written (disk full)") == 3
    record = json.loads(next((tmp_path / "more").rglob("run.json")).read_text())
    assert record["status"] == "failed" and "could not be saved anywhere" in record["error"]


def test_agents_may_have_algorithms_and_settings_of_their_own(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    own = (
        "agent_kwargs:{car_1: {algo: dqn, policy: MlpPolicy, learning_starts: 4, batch_size: 4, buffer_size: 40,"
        " policy_kwargs: {net_arch: [4]}}, car_2: {gamma: 0.5}, car_3: {algo: ippo}}"
    )
    words = ["train", "--env", JUNCTION, "-n", "16", "--eval-freq", "-1", "--verbose", "0", "-f", "logs"]
    small = ["n_envs:1", "n_steps:8", "batch_size:8", "n_epochs:1", "history_length:8"]
    assert main([*words, "-params", *small, own, "agent_kwargs.car_4.gamma:0.25"][:-1]) == 0
    folder = tmp_path / "logs" / "belief_ppo" / f"{JUNCTION}_1"
    team = Team.load(folder / "team.zip")
    assert [type(model).__name__ for model in team.agents.values()] == ["BeliefPPO", "DQN", *["BeliefPPO"] * 3]
    values = {agent: vars(model) for agent, model in team.agents.items()}
    assert values["car_1"]["policy_kwargs"] == {"net_arch": [4]} and values["car_1"]["buffer_size"] == 40
    assert (values["car_2"]["gamma"], values["car_0"]["gamma"], values["car_2"]["n_steps"]) == (0.5, 0.97, 8)
    assert (values["car_3"]["belief"], values["car_0"]["belief"]) == ("none", "dynamic")
    assert "car_1" in yaml.safe_load((folder / "config.yml").read_text())[JUNCTION]["agent_kwargs"]
    # The run's own file makes the same team, which goes on learning
    assert main(["train", "-i", str(folder), "-n", "8", "-f", "more", "--eval-freq", "-1", "--verbose", "0"]) == 0
    capsys.readouterr()
    for pair, message in (
        ("agent_kwargs:{cat_1: {gamma: 0.5}}", "-params: agent_kwargs: unknown agent 'cat_1'. Did you mean 'car_1'"),
        (
            "agent_kwargs:{car_1: {algo: dqm}}",
            "-params: agent_kwargs: car_1: algo: unknown algorithm 'dqm'. Did you mean 'dqn'",
        ),
        ("agent_kwargs:{car_1: {algo: dqn}}", "-params: agent_kwargs: car_1: dqn has no 'BeliefPolicy'"),
        ("agent_kwargs:{car_1: {algo: dqn, n_epochs: 1}}", "-params: agent_kwargs: car_1: unknown key 'n_epochs'"),
        ("agent_kwargs:{car_1: {n_envs: 1}}", "'n_envs' is the same for all agents"),
        ("agent_kwargs:{car_1: {gamma: 2}}", "-params: agent_kwargs: car_1: gamma: must be in [0, 1]"),
        ("agent_kwargs:{car_1: 3}", "agent_kwargs: car_1: must be a mapping"),
        ("algo:dqn", "'algo' cannot be set here: use the flag --algo, or for single agents agent_kwargs"),
    ):
        assert main([*words, "-f", "none", "-params", pair]) == 2
        assert message in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


def test_evaluations_may_have_another_environment(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ["train", "--env", "convention-swap", "-n", "8", "--eval-freq", "4", "--eval-episodes", "1", "--n-eval-envs", "1"]
    words += ["--verbose", "0", "--env-kwargs", "rollout_steps:4", "-params", *SMALL["ppo"], "--algo", "ppo"]
    lengths = {}
    for name, more in (("flag", ["--eval-env-kwargs", "rollout_steps:2"]), ("none", [])):
        assert main([*words, *more, "-f", name]) == 0
        with np.load(next((tmp_path / name).rglob("evaluations.npz"))) as data:
            lengths[name] = set(data["ep_lengths"].ravel().tolist())
    assert lengths == {"flag": {2}, "none": {4}}
    config = load_config("ppo", "convention-swap", params=["eval_env_kwargs.rollout_steps:2"])
    assert config.eval_env_kwargs == {"rollout_steps": 2} and "rollout_steps" not in config.env_kwargs
    with pytest.raises(ConfigError, match="--eval-env-kwargs: eval_env_kwargs: unknown key 'x'"):
        load_config("ppo", "convention-swap", eval_env_kwargs=["x:1"])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["mpe/simple_spread_v3", "--eval-env-kwargs", "N:4"],
            "--eval-env-kwargs: eval_env_kwargs: the agents ['agent_0', 'agent_1', 'agent_2'] learn, and evaluations have"
            " ['agent_0', 'agent_1', 'agent_2', 'agent_3']",
        ),
        (["convention-swap", "--eval-env-kwargs", "m:5"], "--eval-env-kwargs: eval_env_kwargs: the observation space of"),
        (["convention-swap", "-params", "eval_env_kwargs.m:5"], "-params: eval_env_kwargs: the observation space of"),
        (["convention-swap", "--conf-file", "mine.yml"], "mine.yml, section default: eval_env_kwargs: the observation space"),
    ],
)
def test_evaluations_have_the_agents_and_spaces_of_the_training(words, message, tmp_path, monkeypatch, capsys):
    (tmp_path / "mine.yml").write_text("default: {n_timesteps: 8, policy: MlpPolicy, eval_env_kwargs: {m: 5}}\n")
    said = refused(["train", "--algo", "ppo", "--env", *words], tmp_path, monkeypatch, capsys)
    assert message in said and "evaluations" in said


GAMES = """
from sb3_belief.envs import register
from tests.team.toy_envs import ToyEnv

@register("{name}/walk")
class Walk(ToyEnv):
    def __init__(self, **config):
        super().__init__(2, config.get("limit", 7))
        unknown = set(config) - {{"limit"}}
        if unknown:
            raise KeyError(f"no setting {{unknown}}")
"""


def test_registered_ids_and_open_constructors(tmp_path, monkeypatch, capsys):
    (tmp_path / "walking_games.py").write_text(GAMES.format(name="walking-games"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    # What is registered here is forgotten afterwards
    monkeypatch.setattr(registry, "_SPECS", dict(registry._SPECS))
    words = [
        "train",
        "--env",
        "walking-games/walk",
        "-n",
        "8",
        "--eval-freq",
        "-1",
        "--verbose",
        "0",
        "-params",
        *SMALL["ppo"],
    ]
    words += ["--algo", "ppo", "-f", "logs"]
    assert main([*words, "--env-kwargs", "limit:3"]) == 2
    assert "walking-games/walk" in capsys.readouterr().err
    allow = ["--allow-package", "walking_games"]
    assert main([*words, *allow, "--env-kwargs", "limit:3"]) == 0
    assert ",3," in (next(tmp_path.rglob("monitor.csv")).read_text())
    assert main(["envs", "check", "walking-games/walk", "-n", "20", *allow]) == 0
    capsys.readouterr()
    assert main([*words, *allow, "--env-kwargs", "limmit:3"]) == 2
    said = capsys.readouterr().err
    assert "--env-kwargs: walking-games/walk refuses its settings: KeyError: \"no setting {'limmit'}\"." in said
    assert "(walking_games.py, line 11)" in said


def test_help_needs_no_torch():
    program = (
        "import sys\nfrom sb3_belief.cli.main import main\n"
        "for words in ('--help', 'train --help', 'demo --help', '--version', 'train -n inf', 'train --seed 1 2'):\n"
        "    try:\n        main(words.split())\n    except SystemExit:\n        pass\n"
        "print([name for name in ('torch', 'stable_baselines3', 'pettingzoo', 'numpy') if name in sys.modules])\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_the_package_runs_as_a_module():
    done = subprocess.run([sys.executable, "-m", "sb3_belief", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout == f"sb3-belief {__version__}\n"


@pytest.mark.parametrize("words", [[], *([name] for name in COMMANDS), ["envs", "check"], ["envs", "list"]])
def test_help_says_no_default_where_there_is_none(words, capsys):
    with pytest.raises(SystemExit):
        main([*words, "--help"])
    said = capsys.readouterr().out
    assert "None" not in said and "[]" not in said and "SUPPRESS" not in said
    with pytest.raises(SystemExit):
        train_main(["--help"])
