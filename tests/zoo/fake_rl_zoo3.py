"""
A stand-in for rl_zoo3 with the parts of its interface that ``register_rl_zoo3`` builds on: the dictionaries of algorithms,
samplers and converters, and an ``ExperimentManager`` that reads hyper-parameters and makes a model of them.
"""

import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import yaml
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env


class TrialEvalCallback(EvalCallback):
    """As rl_zoo3's, less what concerns a trial."""


class ExperimentManager:
    """As rl_zoo3's, less files, callbacks, wrappers and what has to do with other algorithms."""

    def __init__(self, args, algo, env_id, n_timesteps=0, hyperparams=None, config=None):
        self.args, self.algo, self.env_id, self.n_timesteps = args, algo, env_id, n_timesteps
        self.custom_hyperparams = hyperparams
        self.config = config or f"hyperparams/{algo}.yml"

    def setup_experiment(self):
        hyperparams, saved = self.read_hyperparameters()
        n_envs = hyperparams.get("n_envs", 1)
        hyperparams, *_ = self._preprocess_hyperparams(hyperparams)
        env = make_vec_env(self.env_id, n_envs, seed=0)
        return sys.modules["rl_zoo3.utils"].ALGOS[self.algo](env=env, device="cpu", seed=0, **hyperparams), saved

    def read_hyperparameters(self):
        sections = yaml.safe_load(Path(self.config).read_text())
        hyperparams = sections[self.env_id] if self.env_id in sections else sections["default"]
        hyperparams.update(self.custom_hyperparams or {})
        return hyperparams, dict(sorted(hyperparams.items()))

    def _preprocess_hyperparams(self, hyperparams):
        for key in ("learning_rate", "clip_range", "clip_range_vf"):
            if isinstance(hyperparams.get(key), str):
                _, initial_value = hyperparams[key].split("_")
                hyperparams[key] = float(initial_value)
        self.n_timesteps = self.n_timesteps or int(hyperparams.pop("n_timesteps"))
        hyperparams.pop("n_timesteps", None)
        hyperparams.pop("n_envs", None)
        return hyperparams, None, [], None


def convert_onpolicy_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    hyperparams = dict(sampled_params)
    hyperparams["gamma"] = 1 - hyperparams.pop("one_minus_gamma")
    return {"policy_kwargs": {"net_arch": {"tiny": dict(pi=[64], vf=[64])}[hyperparams.pop("net_arch")]}, **hyperparams}


def sample_ppo_params(trial, n_actions, n_envs, additional_args):
    one_minus_gamma = trial.suggest_float("one_minus_gamma", 0.0001, 0.03, log=True)
    net_arch = trial.suggest_categorical("net_arch", ["tiny"])
    return convert_onpolicy_params({"one_minus_gamma": one_minus_gamma, "net_arch": net_arch})


class Trial:
    """As an ``optuna.Trial``: takes the first of the possible values and notes it under its name."""

    def __init__(self):
        self.params: dict[str, Any] = {}

    def suggest_float(self, name, low, high, log=False):
        return self.params.setdefault(name, low)

    def suggest_categorical(self, name, choices):
        return self.params.setdefault(name, choices[0])


def modules() -> dict[str, ModuleType]:
    """
    :return: what goes into ``sys.modules``; new dictionaries each time
    """
    algos = {"ppo": PPO}
    contents: dict[str, dict[str, Any]] = {
        "rl_zoo3": {"ALGOS": algos, "__path__": []},
        "rl_zoo3.utils": {"ALGOS": algos},
        "rl_zoo3.exp_manager": {
            "ALGOS": algos,
            "ExperimentManager": ExperimentManager,
            "EvalCallback": EvalCallback,
            "TrialEvalCallback": TrialEvalCallback,
        },
        "rl_zoo3.callbacks": {"TrialEvalCallback": TrialEvalCallback},
        "rl_zoo3.train": {"ALGOS": algos, "ExperimentManager": ExperimentManager},
        "rl_zoo3.hyperparams_opt": {
            "convert_onpolicy_params": convert_onpolicy_params,
            "sample_ppo_params": sample_ppo_params,
            "HYPERPARAMS_SAMPLER": {"ppo": sample_ppo_params},
            "HYPERPARAMS_CONVERTER": {"ppo": convert_onpolicy_params},
        },
    }
    made = {}
    for name, content in contents.items():
        made[name] = ModuleType(name)
        vars(made[name]).update(content)
    return made
