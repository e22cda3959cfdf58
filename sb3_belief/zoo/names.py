"""What a configuration may name: algorithms by a short name, classes and wrappers by a dotted path from known packages."""

import importlib
import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_belief.envs.registry import EnvSpec, registered_ids, spec
from sb3_belief.envs.suites import SUITES
from sb3_belief.zoo.errors import ConfigError, nearest, unknown

#: Packages (or parts of them) that a dotted path in a YAML file may point into
ALLOWED_PACKAGES = (
    "sb3_belief",
    "stable_baselines3",
    "sb3_contrib",
    "pettingzoo",
    "supersuit",
    "torch.nn",
    "torch.optim",
)


@dataclass(frozen=True)
class Algo:
    """
    :param path: ``"module:class"``, imported when the algorithm is asked for
    :param fixed: constructor arguments that the name stands for; a configuration cannot change them
    """

    path: str
    fixed: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))

    def load(self) -> type[BaseAlgorithm]:
        module, _, name = self.path.partition(":")
        return getattr(importlib.import_module(module), name)


#: The algorithms whose unmodified ``learn()`` runs inside a team (not ARS, which drives its environments by itself)
ALGOS: Mapping[str, Algo] = MappingProxyType(
    {
        "belief_ppo": Algo("sb3_belief.belief_ppo:BeliefPPO"),
        "ippo": Algo("sb3_belief.belief_ppo:BeliefPPO", MappingProxyType({"belief": "none"})),
        "maskable_belief_ppo": Algo("sb3_belief.belief_ppo:MaskableBeliefPPO"),
        "ppo": Algo("stable_baselines3:PPO"),
        "a2c": Algo("stable_baselines3:A2C"),
        "dqn": Algo("stable_baselines3:DQN"),
        "ddpg": Algo("stable_baselines3:DDPG"),
        "td3": Algo("stable_baselines3:TD3"),
        "sac": Algo("stable_baselines3:SAC"),
        "maskable_ppo": Algo("sb3_contrib:MaskablePPO"),
        "recurrent_ppo": Algo("sb3_contrib:RecurrentPPO"),
        "trpo": Algo("sb3_contrib:TRPO"),
        "qrdqn": Algo("sb3_contrib:QRDQN"),
        "tqc": Algo("sb3_contrib:TQC"),
        "crossq": Algo("sb3_contrib:CrossQ"),
    }
)


def get_algo(name: str) -> Algo:
    """
    :param name: a key of ``ALGOS``
    :return: the algorithm
    :raises ConfigError: for another name
    """
    if name not in ALGOS:
        raise unknown("--algo", "algorithm", name, ALGOS)
    return ALGOS[name]


def _is_allowed(module: str, packages: tuple[str, ...]) -> bool:
    return any(module == package or module.startswith(package + ".") for package in packages)


def resolve(path: Any, where: str, extra_packages: tuple[str, ...] = ()) -> Callable[..., Any]:
    """
    Find the class or function that a dotted path names, without evaluating anything.

    Both the module that the path names and the one that the object was defined in must be of an allowed package: otherwise
    ``some.allowed.module.os.system`` would be a way out, through what a module happens to import.

    :param path: e.g. ``"supersuit.frame_stack_v1"``
    :param where: file, section and key, for the error message
    :param extra_packages: packages allowed by whoever typed the command (``--allow-package``)
    :return: the class or function
    :raises ConfigError: if the path is none, is not allowed, or names nothing
    """
    packages = (*ALLOWED_PACKAGES, *extra_packages)
    module_name, _, name = path.rpartition(".") if isinstance(path, str) else ("", "", "")
    if not module_name or not all(part.isidentifier() for part in path.split(".")):
        raise ConfigError(f"{where}: {path!r} is not a dotted path such as 'supersuit.frame_stack_v1'.")
    allowed = f"Allowed: what {', '.join(packages)} define (more packages: the flag --allow-package NAME)."
    if not _is_allowed(module_name, packages):
        root = path.split(".")[0]
        raise ConfigError(f"{where}: {path!r} is not of an allowed package.{nearest(root, packages)} {allowed}")
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        raise ConfigError(f"{where}: no module {module_name!r} for {path!r} ({error}). {allowed}") from None
    try:
        # supersuit raises ImportError for a wrapper's old version, and says the new one
        found = getattr(module, name)
    except (AttributeError, ImportError) as error:
        public = [attr for attr in dir(module) if not attr.startswith("_")]
        raise ConfigError(f"{where}: {module_name!r} has no {name!r} ({error}).{nearest(name, public)} {allowed}") from None
    is_code = inspect.isclass(found) or inspect.isfunction(found)
    if not is_code or not _is_allowed(found.__module__, packages):
        raise ConfigError(f"{where}: {path!r} is not a class or function that its package defines itself. {allowed}")
    return found


def get_env(env_id: str, where: str) -> EnvSpec:
    """
    :param env_id: a registered id, ``family/name`` or ``module:callable``
    :param where: file and section, or flag, for the error message
    :return: its specification; nothing is imported for it
    :raises ConfigError: for another id
    """
    try:
        return spec(env_id)
    except ValueError as error:
        if "/" in env_id or env_id in SUITES:
            raise ConfigError(f"{where}: {error}") from None
        kinds = [*registered_ids(), *(f"{family}/<name>" for family in SUITES), "<module>:<callable>"]
        raise unknown(where, "environment", env_id, kinds) from None


def load_env(env_id: str, where: str, extra_packages: tuple[str, ...] = ()) -> Callable[..., Any]:
    """
    :param env_id: see ``get_env``
    :param where: flag, for the error message
    :param extra_packages: see ``resolve``; a ``module:callable`` must be of an allowed package
    :return: what makes one copy of the environment
    :raises ConfigError: for an id that is none or is not allowed, or whose package is not installed
    """
    found = get_env(env_id, where)
    if found.parallel == env_id:
        return resolve(env_id.replace(":", "."), where, extra_packages)
    try:
        return found.load()
    except ImportError as error:
        raise ConfigError(f"{where}: {error}") from error
