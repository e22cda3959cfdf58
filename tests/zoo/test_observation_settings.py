"""What agents observe besides is set in YAML, and is the same in training, evaluations, replays and resumed runs."""

import re

import pytest
from gymnasium import spaces

from sb3_belief.cli.main import main, train_main
from sb3_belief.team import Team
from sb3_belief.team.recurrent import PartnerRecurrentPPO
from sb3_belief.zoo.config import load_config
from sb3_belief.zoo.errors import ConfigError
from sb3_belief.zoo.settings import observation_arguments
from sb3_belief.zoo.train import make_env
from tests.zoo.runs import check_same_run, run_folder

GUEST = "tests.team.guest_env:GuestEnv"
ALLOWED = ("tests",)
SMALL = ("n_envs:2", "n_steps:16", "batch_size:16", "n_epochs:1")


def words(folder, algo, env_id, total, *params):
    return [
        *("--algo", algo, "--env", env_id, "--seed", "1", "-n", str(total), "--verbose", "0", "-f", str(folder)),
        *("--eval-freq", "32", "--eval-episodes", "2", "--n-eval-envs", "2", "--save-freq", "32", "--allow-package", "tests"),
        *("-params", *SMALL, *params),
    ]


def test_a_run_trains_evaluates_resumes_and_is_shown(tmp_path, capsys):
    params = ("observe_last:true", "memory_span:partner", "policy_kwargs.lstm_hidden_size:8", "learning_rate:1e-3")
    for folder, total in (("whole", 96), ("parts", 64)):
        assert train_main(words(tmp_path / folder, "recurrent_ppo", GUEST, total, *params)) == 0
    whole, parts = run_folder(tmp_path / "whole"), run_folder(tmp_path / "parts")
    assert train_main(["--resume", str(parts), "--until", "96", "--verbose", "0", "--allow-package", "tests"]) == 0
    check_same_run(parts, whole)
    model = Team.load(whole / "team.zip").agents["guest"]
    assert isinstance(model.observation_space, spaces.Dict) and type(model) is PartnerRecurrentPPO
    assert set(model.observation_space.spaces) == {"observation", "memory_start"}
    capsys.readouterr()
    assert main(["enjoy", str(whole), "--episodes", "3", "--allow-package", "tests"]) == 0
    assert "Episode 3: return" in capsys.readouterr().out


def test_a_run_with_windows_trains_evaluates_resumes_and_is_shown(tmp_path, capsys):
    # Epsilon is constant, since it falls by the share of the whole training
    small = [
        *("n_envs:2", "buffer_size:200", "batch_size:8", "learning_starts:16", "observe_window:3"),
        *("policy_kwargs.net_arch:[8]", "exploration_initial_eps:0.3", "exploration_final_eps:0.3"),
    ]

    def given(folder, total):
        return [
            *("--algo", "drpiqn", "--env", "convention-swap", "--seed", "1", "-n", str(total), "--verbose", "0"),
            *("-f", str(tmp_path / folder), "--eval-freq", "32", "--eval-episodes", "2", "--n-eval-envs", "2"),
            *("--save-freq", "32", "-params", *small),
        ]

    for folder, total in (("whole", 96), ("parts", 64)):
        assert train_main(given(folder, total)) == 0
    whole, parts = (tmp_path / folder / "drpiqn" / "convention-swap_1" for folder in ("whole", "parts"))
    assert train_main(["--resume", str(parts), "--until", "96", "--verbose", "0"]) == 0
    check_same_run(parts, whole)
    assert Team.load(whole / "team.zip").agents["follower"].observation_space.shape == (3, 4)
    capsys.readouterr()
    assert main(["enjoy", str(whole), "--episodes", "2"]) == 0
    assert "Episode 2: return" in capsys.readouterr().out


def test_enjoy_observes_where_someone_can(tmp_path, capsys):
    for algo in ("belief_ppo", "ippo"):
        assert train_main(words(tmp_path, algo, "convention-swap", 32, "policy_kwargs.net_arch:[8]")) == 0
    run, blind = (tmp_path / algo / "convention-swap_1" for algo in ("belief_ppo", "ippo"))
    capsys.readouterr()
    assert main(["enjoy", str(run), "--episodes", "2", "--observe"]) == 0
    assert "Observed steps: follower 32" in capsys.readouterr().out
    assert main(["enjoy", str(blind), "--observe"]) == 2
    assert "--observe: Nobody here has a belief" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("algo", "given", "named"),
    [
        ("ppo", "memory_span:partner", "memory_span: ppo has no memory.*recurrent_ppo"),
        ("recurrent_ppo", "memory_span:life", "memory_span: unknown memory span 'life'"),
        ("ppo", "observe_last:3", "observe_last"),
    ],
)
def test_what_does_not_fit_is_refused(algo, given, named):
    with pytest.raises(ConfigError, match=named):
        load_config(algo, GUEST, params=[given], extra_packages=ALLOWED)


def test_every_agent_needs_the_memory():
    params = ["memory_span:partner", "agent_kwargs.guest.algo:ppo", "agent_kwargs.guest.policy:MlpPolicy"]
    with pytest.raises(ConfigError, match="agent_kwargs: guest: algo: ppo has no memory"):
        load_config("recurrent_ppo", GUEST, params=params, extra_packages=ALLOWED)


def test_an_environment_without_partners_and_an_unknown_agent_are_refused():
    config = load_config("recurrent_ppo", "convention-swap", params=["memory_span:partner"])
    with pytest.raises(ConfigError, match=re.escape("says which partner is there")):
        make_env(config, 2, 0)
    config = load_config("ppo", "convention-swap", params=["observe_last:[nobody]"])
    with pytest.raises(ConfigError, match="observe_last has the unknown agents"):
        make_env(config, 2, 0)


def test_arguments_of_the_environment():
    assert observation_arguments({}) == observation_arguments({"memory_span": "episode", "observe_last": False}) == {}
    assert observation_arguments({"memory_span": "partner"}) == {"partner_starts": True}
    both = {"observe_last": ["guest"], "memory_span": "partner"}
    assert observation_arguments(both) == {"observe_last": ["guest"], "partner_starts": ["guest"]}
