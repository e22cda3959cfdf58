"""This package's algorithms in rl_zoo3: for real where it is installed, else against a fake with the same interface."""

import argparse
import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import torch as th
import yaml
from sb3_contrib.common.maskable.callbacks import MaskableEvalCallback
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import EvalCallback

from sb3_belief.belief_ppo import BeliefPPO, MaskableBeliefPPO
from sb3_belief.zoo import register_rl_zoo3
from sb3_belief.zoo.errors import ConfigError
from sb3_belief.zoo.rl_zoo3 import ALGOS, IndependentPPO
from tests.zoo import fake_rl_zoo3

ENV_ID = "ToyAmongPartners-v0"
SMALL = {"n_steps": 8, "batch_size": 8, "n_epochs": 1, "policy": "BeliefPolicy"}


def stay(obs):
    return 1


@pytest.fixture
def zoo(monkeypatch):
    """
    :return: the fake's modules, with this package's algorithms registered
    """
    modules = fake_rl_zoo3.modules()
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    kwargs = {"parallel_env": "tests.team.toy_envs:ToyEnv", "agent": "agent_0", "partners": {"agent_1": stay}}
    gym.register(ENV_ID, "sb3_belief:AgentEnv", kwargs=kwargs)
    register_rl_zoo3()
    yield modules
    del gym.registry[ENV_ID]


def manager(zoo, algo, **kwargs):
    return zoo["rl_zoo3.train"].ExperimentManager(argparse.Namespace(), algo, ENV_ID, **kwargs)


def test_all_of_the_zoo_knows_the_algorithms(zoo):
    for module in ("rl_zoo3", "rl_zoo3.utils", "rl_zoo3.train", "rl_zoo3.exp_manager"):
        algos = zoo[module].ALGOS
        assert algos == {
            "ppo": PPO,
            "belief_ppo": BeliefPPO,
            "ippo": IndependentPPO,
            "maskable_belief_ppo": MaskableBeliefPPO,
        }
    search = zoo["rl_zoo3.hyperparams_opt"]
    assert search.HYPERPARAMS_SAMPLER.keys() == search.HYPERPARAMS_CONVERTER.keys() == algos.keys()


def test_twice_is_as_once(zoo):
    register_rl_zoo3()
    assert zoo["rl_zoo3.train"].ExperimentManager.__mro__[1] is fake_rl_zoo3.ExperimentManager


@pytest.mark.parametrize("algo", ["belief_ppo", "ippo", "maskable_belief_ppo"])
def test_sampled_hyperparameters_are_those_of_the_converter_and_make_a_model(zoo, algo):
    search = zoo["rl_zoo3.hyperparams_opt"]
    trial = fake_rl_zoo3.Trial()
    sampled = search.HYPERPARAMS_SAMPLER[algo](trial, 0, 1, {})
    assert search.HYPERPARAMS_CONVERTER[algo](trial.params) == sampled
    assert sampled["gamma"] == 1 - 0.0001 and sampled["policy_kwargs"]["net_arch"] == {"pi": [64], "vf": [64]}
    model = zoo["rl_zoo3"].ALGOS[algo]("BeliefPolicy", gym.make(ENV_ID), n_steps=8, batch_size=8, **sampled)
    if algo == "ippo":
        assert model.belief == "none" and "history_length" not in sampled
    else:
        assert (model.history_length, model.keep_ratio) == (100, 0.02)
        assert sampled["policy_kwargs"]["embedding_dim"] == sampled["policy_kwargs"]["latent_dim"] == 16


def test_our_own_files_are_the_default(zoo):
    model, saved = manager(zoo, "belief_ppo").setup_experiment()
    assert type(model) is BeliefPPO and model.n_envs == saved["n_envs"] == 8 and model.n_steps == 128
    assert saved["learning_rate"] == "lin_3e-4"
    assert list(model.others_action_spaces) == ["agent_1"]
    ippo, _ = manager(zoo, "ippo").setup_experiment()
    assert ippo.belief == "none" and ippo.n_steps == 128


def test_files_are_read_as_by_our_own_command_line(zoo, tmp_path, capsys):
    path = tmp_path / "mine.yml"
    own: dict[str, Any] = {"n_timesteps": 16, "action_coef": "lin_0.5"}
    own["policy_kwargs"] = {"latent_dim": 4, "activation_fn": "torch.nn.ReLU"}
    default = {**SMALL, "n_timesteps": 100, "policy_kwargs": {"net_arch": [8], "latent_dim": 9}}
    text = yaml.safe_dump({"default": default, ENV_ID: own}) + "  learning_rate: 1e-3\n"
    path.write_text(text)
    experiment = manager(zoo, "belief_ppo", config=str(path))
    model, saved = experiment.setup_experiment()
    assert experiment.config == str(path) and str(path) in capsys.readouterr().out
    assert model.n_steps == 8 and model.learning_rate == 1e-3
    assert model.policy.latent_dim == 4 and model.policy.net_arch == [8]
    assert isinstance(model.policy.activation_fn(), th.nn.ReLU)
    assert model.action_coef(0.5) == 0.25
    # what is saved is what was read, so that it can be read again
    assert saved["action_coef"] == "lin_0.5" and saved["policy_kwargs"]["activation_fn"] == "torch.nn.ReLU"
    model.learn(experiment.n_timesteps)
    assert model.num_timesteps == 16


def test_objects_from_the_command_line_stay_what_they_are(zoo):
    given = {"n_envs": 1, "policy_kwargs": {"activation_fn": th.nn.ELU}, "kl_coef": 0.01}
    model, _ = manager(zoo, "belief_ppo", hyperparams=given).setup_experiment()
    assert model.policy.activation_fn is th.nn.ELU and model.kl_coef(1.0) == 0.01


def test_masks_hold_in_evaluations_of_the_masked_algorithm_alone(zoo):
    made = zoo["rl_zoo3.exp_manager"]
    manager(zoo, "maskable_belief_ppo")
    assert made.EvalCallback is MaskableEvalCallback
    assert made.TrialEvalCallback.__mro__[1:3] == (fake_rl_zoo3.TrialEvalCallback, MaskableEvalCallback)
    manager(zoo, "belief_ppo")
    assert made.EvalCallback is EvalCallback and made.TrialEvalCallback is fake_rl_zoo3.TrialEvalCallback


def test_mistakes_are_named(zoo, tmp_path):
    path = tmp_path / "mine.yml"
    path.write_text(yaml.safe_dump({"default": {**SMALL, "n_timesteps": 8, "history_length": "long"}}))
    with pytest.raises(ConfigError, match=r"mine.yml: history_length: must be an integer, not 'long'"):
        manager(zoo, "belief_ppo", config=str(path)).setup_experiment()


def test_the_zoos_own_algorithms_are_left_alone(zoo, tmp_path):
    path = tmp_path / "ppo.yml"
    sections = {"default": {"n_steps": 4}, ENV_ID: {"policy": "MlpPolicy", "n_timesteps": 8}}
    path.write_text(yaml.safe_dump(sections))
    model, saved = manager(zoo, "ppo", config=str(path)).setup_experiment()
    assert type(model) is PPO and model.n_steps == 2048 and "n_steps" not in saved


def test_without_it_there_is_a_line_that_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "rl_zoo3", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'sb3-belief\[rl-zoo3\]'"):
        register_rl_zoo3()


SCRIPT = """
import gymnasium as gym
from rl_zoo3.train import train
from sb3_belief.zoo import register_rl_zoo3

def stay(obs):
    return 0

partners = {f"car_{i}": stay for i in range(1, 5)}
gym.register("Car-v0", "sb3_belief:AgentEnv", kwargs={
    "parallel_env": "traffic-junction-easy", "agent": "car_0", "partners": partners})
register_rl_zoo3()
if __name__ == "__main__":
    train()
"""


REAL = pytest.mark.skipif(importlib.util.find_spec("rl_zoo3") is None, reason="rl_zoo3 is not installed (make test-rl-zoo3)")
EVALUATE = "--eval-freq 128 --eval-episodes 1"
SEARCH = "-optimize --n-trials 1 --n-evaluations 1"


# What is drawn may be ten passes in small minibatches over thousands of steps
SHORT_TRIALS = """
from rl_zoo3.hyperparams_opt import HYPERPARAMS_SAMPLER

def shortened(sample):
    return lambda *args: {**sample(*args), "n_steps": 64, "batch_size": 64, "n_epochs": 1}

HYPERPARAMS_SAMPLER.update({name: shortened(sample) for name, sample in HYPERPARAMS_SAMPLER.items()})
"""


def run_real(folder, script, command):
    (folder / "train_zoo.py").write_text(script.replace("register_rl_zoo3()\n", f"register_rl_zoo3()\n{SHORT_TRIALS}"))
    words = [sys.executable, "train_zoo.py", *command.split(), *"-n 256 --seed 0 --device cpu --no-optim-plots".split()]
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    result = subprocess.run([*words, "-params", "n_envs:2", "n_steps:64"], cwd=folder, env=env, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return result.stdout


@REAL
@pytest.mark.parametrize("algo", ["belief_ppo", "ippo", "maskable_belief_ppo"])
@pytest.mark.parametrize("flags", [EVALUATE, SEARCH])
def test_the_real_one_trains_and_searches(tmp_path, algo, flags):
    printed = run_real(tmp_path, SCRIPT, f"--algo {algo} --env Car-v0 {flags}")
    if flags == SEARCH:
        assert "Number of finished trials:  1" in printed and "Best trial" in printed
        return
    folder = tmp_path / "logs" / algo / "Car-v0_1"
    model = ALGOS[algo].load(folder / "Car-v0.zip")
    assert model.num_timesteps >= 256
    # Of SB3, not of rl_zoo3: the file is plain data, and loads where rl_zoo3 is not
    assert repr(model.learning_rate) == "LinearSchedule(start=0.0003, end=0.0, end_fraction=1.0)"
    assert (folder / "best_model.zip").exists() and (folder / "Car-v0" / "config.yml").exists()


MASKED_SCRIPT = """
import gymnasium as gym
from rl_zoo3.train import train
from sb3_belief.zoo import register_rl_zoo3

def stay(obs):
    return 0

# Refuses every action but one at each step, in evaluations too
gym.register("Masked-v0", "sb3_belief:AgentEnv", kwargs={
    "parallel_env": "tests.team.toy_envs:MaskedEnv", "agent": "agent_0", "partners": {"agent_1": stay}})
register_rl_zoo3()
if __name__ == "__main__":
    train()
"""


@REAL
def test_the_real_one_evaluates_with_masks(tmp_path):
    run_real(tmp_path, MASKED_SCRIPT, f"--algo maskable_belief_ppo --env Masked-v0 {EVALUATE}")
    folder = tmp_path / "logs" / "maskable_belief_ppo" / "Masked-v0_1"
    assert (folder / "best_model.zip").exists() and (folder / "evaluations.npz").exists()
    printed = run_real(tmp_path, MASKED_SCRIPT, f"--algo maskable_belief_ppo --env Masked-v0 {SEARCH}")
    assert "Number of finished trials:  1" in printed and "Value: None" not in printed and "Best trial" in printed
