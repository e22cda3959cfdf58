"""Registration of this package's algorithms in RL Baselines3 Zoo (``rl_zoo3``), which then trains them by our YAML files."""

import importlib
from collections.abc import Callable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import yaml
from sb3_contrib.common.maskable.callbacks import MaskableEvalCallback
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.utils import LinearSchedule

from sb3_belief.belief_ppo import BeliefPPO, MaskableBeliefPPO
from sb3_belief.zoo.checks import Location, accepted_arguments, check_value
from sb3_belief.zoo.config import DEFAULT, find_config_file
from sb3_belief.zoo.yaml_data import merge, read_file

# rl_zoo3 reads these settings itself, schedules included
_READ_BY_ZOO = ("policy", "policy_kwargs", "learning_rate", "clip_range", "clip_range_vf")
_SIZES = ("embedding_dim", "latent_dim")


class IndependentPPO(BeliefPPO):
    """``BeliefPPO`` with ``belief="none"``. rl_zoo3 needs one class for each of its algorithms."""

    def __init__(self, policy: Any, env: Any, **kwargs: Any) -> None:
        super().__init__(policy, env, belief="none", **kwargs)


ALGOS: Mapping[str, type[BaseAlgorithm]] = {
    "belief_ppo": BeliefPPO,
    "ippo": IndependentPPO,
    "maskable_belief_ppo": MaskableBeliefPPO,
}


def register_rl_zoo3() -> None:
    """
    Register ``belief_ppo``, ``ippo`` and ``maskable_belief_ppo`` in rl_zoo3.

    They are then available to its ``train``, its ``enjoy`` and, with a sampler and a converter each, to its search for
    hyper-parameters. Call this before ``rl_zoo3.train.train()``::

        import gymnasium as gym
        from rl_zoo3.train import train
        from sb3_belief.zoo import register_rl_zoo3

        gym.register("Car-v0", "sb3_belief:AgentEnv", kwargs={"parallel_env": ..., "agent": ..., "partners": ...})
        register_rl_zoo3()
        train()

    For these algorithms ``--conf-file`` (default: ``zoo_configs/<algo>.yml``) is read as by ``sb3-belief``: the settings of
    the section ``default`` hold for all environments, ``3e-4`` is a number, and dotted paths and ``lin_x`` are possible
    wherever the algorithm takes a class or a schedule. ``maskable_belief_ppo`` is evaluated with the environment's masks, in
    training and in a search. Everything else is as rl_zoo3 does it: its ``env_wrapper`` wraps the learner's environment, and
    its ``enjoy`` acts without masks.

    :raises ModuleNotFoundError: If rl_zoo3 is not installed. The message has the line that installs it
    """
    try:
        train, utils, exp_manager, search = (
            importlib.import_module(f"rl_zoo3.{name}") for name in ("train", "utils", "exp_manager", "hyperparams_opt")
        )
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "rl_zoo3":
            raise
        raise ModuleNotFoundError(
            "register_rl_zoo3() needs RL Baselines3 Zoo, which is not installed: pip install 'sb3-belief[rl-zoo3]'",
            name="rl_zoo3",
        ) from error
    utils.ALGOS.update(ALGOS)
    sample, convert = _with_belief(search.sample_ppo_params, search.convert_onpolicy_params)
    for algo in ALGOS:
        searched = (search.sample_ppo_params, search.convert_onpolicy_params) if algo == "ippo" else (sample, convert)
        search.HYPERPARAMS_SAMPLER[algo], search.HYPERPARAMS_CONVERTER[algo] = searched
    # rl_zoo3.train has imported the class by name, so it is replaced there. mypy knows no attributes of such a module, hence
    # vars()
    vars(train)["ExperimentManager"] = _reading_our_files(exp_manager)


def _with_belief(sample_ppo: Callable[..., Any], convert_ppo: Callable[..., Any]) -> tuple[Callable, Callable]:
    """
    Return the sampler and the converter of hyper-parameters for an algorithm with a belief.

    :param sample_ppo: rl_zoo3's sampler for PPO
    :param convert_ppo: rl_zoo3's converter for PPO, which turns sampled parameters into arguments of the algorithm
    :return: Sampler and converter
    """

    def convert(sampled: dict[str, Any]) -> dict[str, Any]:
        sizes = {name: sampled[name] for name in _SIZES}
        hyperparams = convert_ppo({name: value for name, value in sampled.items() if name not in sizes})
        hyperparams["policy_kwargs"] = {**hyperparams["policy_kwargs"], **sizes}
        return hyperparams

    def sample(trial: Any, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
        hyperparams = sample_ppo(trial, n_actions, n_envs, additional_args)
        hyperparams["history_length"] = trial.suggest_categorical("history_length", [100, 200, 400, 800, 1600])
        hyperparams["keep_ratio"] = trial.suggest_categorical("keep_ratio", [0.02, 0.05, 0.1, 0.2])
        hyperparams["action_coef"] = trial.suggest_float("action_coef", 0.05, 2.0, log=True)
        hyperparams["kl_coef"] = trial.suggest_float("kl_coef", 1e-4, 0.05, log=True)
        sizes = {name: trial.suggest_categorical(name, [16, 32, 64]) for name in _SIZES}
        hyperparams["policy_kwargs"] = {**hyperparams["policy_kwargs"], **sizes}
        return hyperparams

    return sample, convert


def _reading_our_files(exp_manager: Any) -> Any:
    """
    Return a subclass of rl_zoo3's ``ExperimentManager`` that reads our YAML files for our algorithms and evaluates with masks.

    It is made by a function because rl_zoo3 is an optional package.

    :param exp_manager: rl_zoo3's module ``exp_manager``
    :return: The subclass
    """
    manager_class: Any = exp_manager.ExperimentManager
    # Not exp_manager's, which may have been replaced below
    trial_callback: Any = importlib.import_module("rl_zoo3.callbacks").TrialEvalCallback

    class MaskableTrialEvalCallback(trial_callback, MaskableEvalCallback):
        """rl_zoo3's ``TrialEvalCallback``, evaluating with masks."""

    class ExperimentManager(manager_class):
        """``ExperimentManager`` of rl_zoo3 that reads our YAML files for our algorithms."""

        config: str

        def __init__(self, args: Any, algo: str, *others: Any, config: str | None = None, **kwargs: Any) -> None:
            if algo in ALGOS and config is None:
                config = str(find_config_file(algo))
            # rl_zoo3 makes them by these names, which are global there
            masked = algo == "maskable_belief_ppo"
            vars(exp_manager).update(
                EvalCallback=MaskableEvalCallback if masked else EvalCallback,
                TrialEvalCallback=MaskableTrialEvalCallback if masked else trial_callback,
            )
            super().__init__(args, algo, *others, config=config, **kwargs)

        def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
            given = self.config
            if self.algo not in ALGOS or Path(given).suffix not in (".yml", ".yaml"):
                return super().read_hyperparameters()
            print(f"Reading for rl_zoo3: {given}")
            sections = {name: section or {} for name, section in read_file(Path(given)).items()}
            default = sections.get(DEFAULT, {})
            with TemporaryDirectory() as folder:
                path = Path(folder) / Path(given).name
                # rl_zoo3 reads the file by PyYAML, for which 3e-4 is a string. Here it is a number, and is written as 0.0003
                path.write_text(yaml.safe_dump({name: merge(default, section) for name, section in sections.items()}))
                self.config = str(path)
                try:
                    return super().read_hyperparameters()
                finally:
                    self.config = given

        def _preprocess_hyperparams(self, hyperparams: dict[str, Any]) -> Any:
            if self.algo in ALGOS:
                hyperparams = self._read_strings(hyperparams)
            return super()._preprocess_hyperparams(hyperparams)

        def _preprocess_schedules(self, hyperparams: dict[str, Any]) -> Any:
            made = super()._preprocess_schedules(hyperparams)
            if self.algo not in ALGOS:
                return made
            # A saved model then names no class of rl_zoo3, so that it loads without it, and as plain data
            simple = exp_manager.SimpleLinearSchedule
            return {
                key: LinearSchedule(value.initial_value, 0.0, 1.0) if isinstance(value, simple) else value
                for key, value in made.items()
            }

        def _read_strings(self, hyperparams: dict[str, Any]) -> dict[str, Any]:
            """
            Return the hyper-parameters with schedules and classes in place of the strings that describe them.

            Values that are not strings stay as they are, because rl_zoo3's command line may have made objects of them.
            """
            algo_class, location = ALGOS[self.algo], Location(self.config)
            arguments, _ = accepted_arguments(algo_class)
            read = {
                key: check_value(value, arguments[key], location.key(key))
                if isinstance(value, str) and key in arguments and key not in _READ_BY_ZOO
                else value
                for key, value in hyperparams.items()
            }
            policy_class = algo_class.policy_aliases.get(read.get("policy", ""))
            if isinstance(read.get("policy_kwargs"), dict) and policy_class is not None:
                arguments, _ = accepted_arguments(policy_class)
                read["policy_kwargs"] = {
                    key: check_value(value, arguments.get(key, Any), location.key("policy_kwargs").key(key))
                    if isinstance(value, str)
                    else value
                    for key, value in read["policy_kwargs"].items()
                }
            return read

    return ExperimentManager
