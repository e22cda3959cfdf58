"""What the files in a run's folder may name and write, when their author may be a stranger."""

from pathlib import Path

import pytest
from pettingzoo.utils.conversions import parallel_to_aec
from stable_baselines3.common.callbacks import CheckpointCallback
from stable_baselines3.common.monitor import Monitor

from sb3_belief.zoo.checks import Location, check_paths, check_run_file
from sb3_belief.zoo.config import load_config
from sb3_belief.zoo.errors import ConfigError
from sb3_belief.zoo.names import load_env
from sb3_belief.zoo.resume import resume_config

ENV = "convention-swap"


@pytest.mark.parametrize(
    "env_id",
    [
        "sb3_belief.envs.switching_convention.parallel_env:SwitchingConvention",
        ENV,
        "traffic-junction-easy",
        "mpe/simple_spread_v3",
    ],
)
def test_environments_that_a_file_may_name(env_id):
    assert callable(load_env(env_id, "run.json: env", of_file=True))


@pytest.mark.parametrize(
    "env_id",
    [
        "stable_baselines3.common.save_util:load_from_pkl",
        "stable_baselines3.common.monitor:Monitor",
        "sb3_belief.envs.registry:make_parallel_env",
        "sb3_belief.cli.main:main",
        "torch.nn:Linear",
    ],
)
def test_a_callable_that_is_no_environment_is_for_the_command_line(env_id):
    with pytest.raises(ConfigError, match=r"run.json: env: .* is no environment of PettingZoo's kinds.*--allow-package"):
        load_env(env_id, "run.json: env", of_file=True)
    assert callable(load_env(env_id, "--env"))
    assert callable(load_env(env_id, "run.json: env", (env_id.partition(".")[0],), of_file=True))


def test_a_name_in_a_suite_imports_no_module():
    with pytest.raises(ConfigError, match="'lbf/canary:Env-v0' names a module to import"):
        load_env("lbf/canary:Env-v0", "run.json: env", of_file=True)


def test_paths_stay_in_the_folder_of_the_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    here = Location("config.yml: callback", (), Path("logs/run"))
    for inside in ("logs/run", "logs/run/checkpoints", "logs/../logs/run/x", str(tmp_path / "logs/run/x")):
        check_run_file(CheckpointCallback, {"save_path": inside, "save_freq": 3}, here)
    for outside in ("logs", "logs/run2", "../x", "logs/run/../../x", "/etc/x", "x"):
        for name in ("save_path", "log_path", "best_model_save_path", "video_folder", "log_dir", "filename"):
            with pytest.raises(ConfigError, match=rf"{name}: .* lies outside of the run's folder 'logs/run'.*--trust"):
                check_run_file(CheckpointCallback, {name: outside}, here)
        # The user's own file, and the user's own packages
        check_run_file(CheckpointCallback, {"save_path": outside}, Location("config.yml: callback"))
        check_run_file(CheckpointCallback, {"save_path": outside}, Location("x", ("stable_baselines3",), Path("logs/run")))


def test_arguments_of_environments_are_checked_too(tmp_path):
    with pytest.raises(ConfigError, match=r"env_kwargs: replay_dir: '/elsewhere' lies outside"):
        check_paths({"replay_dir": "/elsewhere"}, Location("env_kwargs", (), tmp_path))
    check_paths({"replay_dir": str(tmp_path / "x"), "map_name": "/3m", "path": 3}, Location("env_kwargs", (), tmp_path))


def test_wrappers_are_of_packages_for_teams(tmp_path):
    here = Location("config.yml: env_wrapper", (), tmp_path)
    check_run_file(parallel_to_aec, {}, here)
    with pytest.raises(ConfigError, match="Monitor is no wrapper of a team's environment"):
        check_run_file(Monitor, {}, here)
    check_run_file(Monitor, {}, Location("config.yml: env_wrapper"))


def test_a_configuration_is_checked_where_it_lies_in_a_run(tmp_path):
    (tmp_path / "run.json").write_text(f'{{"algo": "ppo", "env": "{ENV}"}}')
    (tmp_path / "team.zip").write_text("")
    callback = "{stable_baselines3.common.callbacks.CheckpointCallback: {save_freq: 4, save_path: /elsewhere}}"
    (tmp_path / "config.yml").write_text(f"{ENV}: {{policy: MlpPolicy, n_timesteps: 8, callback: {callback}}}")
    config = str(tmp_path / "config.yml")
    with pytest.raises(ConfigError, match=r"config.yml, section .*save_path: '/elsewhere' lies outside"):
        load_config("ppo", ENV, config, run_folder=tmp_path)
    with pytest.raises(ConfigError, match=r"lies outside"):
        resume_config(str(tmp_path))
    # Trusted, or given by the user
    for given in (
        resume_config(str(tmp_path), trust=True),
        load_config("ppo", ENV, config),
        resume_config(str(tmp_path), conf_file=config),
    ):
        assert given.callbacks[0][1]["save_path"] == "/elsewhere"
    # A flag is the user's, too
    (tmp_path / "config.yml").write_text(f"{ENV}: {{policy: MlpPolicy, n_timesteps: 8}}")
    assert resume_config(str(tmp_path), params=[f"callback:{callback}"]).callbacks[0][1]["save_path"] == "/elsewhere"
