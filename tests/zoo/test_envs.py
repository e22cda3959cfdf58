"""Environments by name on the command line: suites, a user's own, the list of them and the check."""

import sys
import warnings

import pytest
import yaml

from sb3_belief.cli.main import main, train_main
from sb3_belief.envs import suites
from sb3_belief.envs.suites import SUITES
from sb3_belief.team import Team
from sb3_belief.zoo import envs
from sb3_belief.zoo.config import load_config
from sb3_belief.zoo.errors import ConfigError
from sb3_belief.zoo.run_folder import run_of

SPREAD = "mpe/simple_spread_v3"
TINY = ["n_envs:2", "n_steps:10", "batch_size:20", "n_epochs:1"]
MODULE = """
from tests.team.toy_envs import MaskedEnv, ToyEnv

def make(n_agents: int = 2):
    return ToyEnv(n_agents)

def broken():
    env = ToyEnv()
    env.observation_space = lambda agent: None
    return env

not_code = 3
"""


@pytest.fixture
def own_module(tmp_path, monkeypatch):
    """A module beside which the user stands; nothing but --allow-package makes it importable."""
    (tmp_path / "my_toys.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield tmp_path
    sys.modules.pop("my_toys", None)


def train(env_id, folder, *words):
    flags = ["--algo", "belief_ppo", "--env", env_id, "-f", str(folder), "-n", "40", "--seed", "1", "--verbose", "0"]
    return train_main([*flags, "--eval-freq", "-1", "-params", *TINY, "history_length:20", *words])


def test_an_environment_of_a_suite_is_trained_and_replayed(tmp_path, capsys):
    words = ["--env-kwargs", "radius:0.8", "max_cycles:5", "-tb", str(tmp_path / "tb")]
    assert train(SPREAD, tmp_path / "logs", *words) == 0
    folder = tmp_path / "logs" / "belief_ppo" / "mpe-simple_spread_v3_1"
    assert yaml.safe_load((folder / "config.yml").read_text())[SPREAD]["env_kwargs"] == {"radius": 0.8, "max_cycles": 5}
    assert run_of(folder / "team.zip") == ("belief_ppo", SPREAD, folder / "config.yml")
    assert (tmp_path / "tb" / "belief_ppo" / "mpe-simple_spread_v3").is_dir()
    output = tmp_path / "episode.gif"
    assert main(["enjoy", str(folder), "--output", str(output)]) == 0
    assert "5 steps" in capsys.readouterr().out and output.stat().st_size > 0
    # and it goes on from where it was
    assert (
        main(["train", "-i", str(folder), "-f", str(tmp_path / "logs"), "-n", "20", "--verbose", "0", "--eval-freq", "-1"])
        == 0
    )
    assert Team.load(folder.parent / "mpe-simple_spread_v3_2" / "team.zip").num_timesteps == 60


def test_ones_own_environment_is_trained_and_replayed(own_module, capsys):
    allow = ["--allow-package", "my_toys", "tests"]
    assert train("my_toys:make", own_module / "logs", "--env-kwargs", "n_agents:3", *allow) == 0
    folder = own_module / "logs" / "belief_ppo" / "my_toys-make_1"
    assert list(Team.load(folder / "team.zip").agents) == ["agent_0", "agent_1", "agent_2"]
    capsys.readouterr()
    # it has images, but the callable that makes it takes no render_mode
    assert main(["enjoy", str(folder), *allow]) == 0
    assert "7 steps" in capsys.readouterr().out
    # a run's folder is data as well
    assert main(["enjoy", str(folder)]) == 2
    assert "'my_toys.make' is not of an allowed package" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("env_id", "message"),
    [
        ("os:system", "--env: 'os.system' is not of an allowed package"),
        ("my_toys:make", "--env: 'my_toys.make' is not of an allowed package"),
        ("torch:load", "is not of an allowed package"),
        ("pettingzoo.utils.env:gymnasium", "is not a class or function that its package defines itself"),
        ("smax/3m", "--env: 'smax/3m' needs 'jaxmarl', which is not installed: pip install jaxmarl"),
        ("smx/3m", "--env: Unknown environment id 'smx/3m'. Did you mean "),
        ("mpe", "--env: 'mpe' lacks the environment's name"),
        ("mpe/simple_spred_v3", "no 'simple_spred_v3'. Did you mean 'simple_spread_v3'"),
        ("trafic-junction-easy", "--env: unknown environment 'trafic-junction-easy'. Did you mean 'traffic-junction-easy'"),
    ],
)
def test_environments_that_are_refused(env_id, message, own_module, monkeypatch, capsys):
    missing = {"jaxmarl"}
    is_installed = suites.is_installed
    monkeypatch.setattr(suites, "is_installed", lambda module: module not in missing and is_installed(module))
    assert train(env_id, own_module / "logs") == 2
    assert message in capsys.readouterr().err
    assert "my_toys" not in sys.modules and not (own_module / "logs").exists()


def test_what_is_no_code_is_refused(own_module, capsys):
    assert train("my_toys:not_code", own_module / "logs", "--allow-package", "my_toys") == 2
    assert "is not a class or function" in capsys.readouterr().err


def test_sections_are_looked_up_by_the_whole_id(tmp_path):
    path = tmp_path / "mine.yml"
    path.write_text(
        "default: {n_timesteps: 10, policy: MlpPolicy}\n"
        f"{SPREAD}: {{n_timesteps: 20, env_kwargs: {{radius: 0.5}}}}\n"
        "mpe/simple_tag_v3: {n_timesteps: 30}\n"
        "smac/3m: {n_timesteps: 40}\n"  # a section needs nothing to be installed
        "my_toys:make: {n_timesteps: 50}\n"
    )
    config = load_config("ppo", SPREAD, str(path))
    assert (config.n_timesteps, config.env_kwargs) == (20, {"radius": 0.5})
    assert load_config("ppo", "mpe/simple_tag_v3", str(path)).n_timesteps == 30
    assert load_config("ppo", "mpe/simple_line_v1", str(path)).n_timesteps == 10
    again = tmp_path / "again.yml"
    again.write_text(config.to_yaml())
    assert load_config("ppo", SPREAD, str(again)).settings == config.settings
    path.write_text("mep/simple_tag_v3: {n_timesteps: 30}\n")
    with pytest.raises(ConfigError, match=r"mine\.yml: Unknown environment id 'mep/simple_tag_v3'. Did you mean 'mpe/'"):
        load_config("ppo", SPREAD, str(path))


def test_arguments_of_a_suite_are_checked(capsys):
    assert train(SPREAD, "nowhere", "--env-kwargs", "radius:wide") == 2
    assert "radius: must be a number or null, not 'wide'" in capsys.readouterr().err
    # these are known to the environment only
    assert train(SPREAD, "nowhere", "--env-kwargs", "max_cycels:5") == 2
    assert "refuses its settings" in capsys.readouterr().err


def test_the_list_says_what_is_there_and_how_to_get_the_rest(monkeypatch, capsys):
    is_installed = suites.is_installed
    monkeypatch.setattr(suites, "is_installed", lambda module: not module.startswith("smac") and is_installed(module))
    assert main(["envs"]) == 0
    said = capsys.readouterr().out
    assert all(f"{name}/<name>: " in said for name in SUITES)
    for line in ("  traffic-junction-medium", f"  {SPREAD}", "mpe/<name>: installed", "smac/<name>: not installed"):
        assert f"{line}\n" in said
    assert f"  {SUITES['smac'].install}\n  Not 'pip install smac', which installs another project" in said
    assert "  ... and " in said and "sb3-belief envs list lbf" in said
    assert main(["envs", "list", "pettingzoo"]) == 0
    said = capsys.readouterr().out
    assert "pettingzoo/sisl.pursuit" in said and "..." not in said
    assert main(["envs", "list", "smack"]) == 2
    assert "unknown suite 'smack'. Did you mean 'smac'" in capsys.readouterr().err


def test_the_list_tells_what_single_environments_lack(monkeypatch, capsys):
    is_installed = suites.is_installed
    there = {"multi_agent_ale_py": False, "Box2D": True, "pygame": True, "scipy": True}
    monkeypatch.setattr(suites, "is_installed", lambda module: there.get(module, is_installed(module)))
    assert main(["envs", "list", "pettingzoo"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "pettingzoo/<name>: partly installed"
    assert any(line.startswith("  pettingzoo/sisl.multiwalker") for line in lines)
    assert not any(line.startswith("  pettingzoo/atari") for line in lines)
    atari = next(line for line in lines if "multi_agent_ale_py" in line)
    assert "not installed: pettingzoo/atari." in atari and atari.endswith("'pettingzoo[atari]' && AutoROM --accept-license")


def test_the_check_says_what_to_change(own_module, capsys):
    words = ["-n", "40", "--allow-package", "my_toys", "tests"]
    assert main(["envs", "check", "my_toys:make", "--env-kwargs", "n_agents:3", *words]) == 0
    said = capsys.readouterr().out
    assert "ok    spaces: 3 agents" in said and said.endswith("No failures.\n")
    assert main(["envs", "check", "my_toys:broken", *words]) == 1
    assert "FAIL  spaces: " in capsys.readouterr().out
    assert main(["envs", "check", SPREAD, "-n", "30"]) == 0
    capsys.readouterr()
    for env_id in ("my_toys:make", "zzz", "my_toys:nothing"):
        assert main(["envs", "check", env_id]) == 2
        assert capsys.readouterr().err.startswith("Refused: envs check: ")


def test_a_suite_that_is_asked_for_is_listed_in_full(monkeypatch):
    monkeypatch.setattr(envs, "_SHORT", 3)
    assert "... and 9 more: sb3-belief envs list mpe" in envs.list_envs()
    assert "..." not in envs.list_envs("mpe")


@pytest.mark.parametrize(
    ("n_steps", "env_kwargs", "warns"),
    [(16, [], False), (8, [], True), (8, ["rollout_steps:8"], False), (8, ["redraw_unit:episodes", "per_copy:true"], False)],
)
def test_rollouts_that_the_environment_counts_otherwise_are_named(tmp_path, n_steps, env_kwargs, warns):
    words = ["-f", str(tmp_path), *"--algo ippo --env convention-redraw --verbose 0 --eval-freq -1 -n 32".split()]
    words += ["--env-kwargs", *env_kwargs] if env_kwargs else []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert train_main([*words, "-params", "n_envs:2", f"n_steps:{n_steps}", "batch_size:8", "n_epochs:1"]) == 0
    said = [str(each.message) for each in caught if "counts rollouts" in str(each.message)]
    assert len(said) == warns
    if warns:
        assert "rollout_steps=16 steps" in said[0] and "--env-kwargs rollout_steps:8" in said[0]
