"""
The names that a configuration may use.

Algorithms have short names. Classes, wrappers, functions and callbacks are named by dotted paths into known packages.
"""

import importlib
import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

from pettingzoo import AECEnv, ParallelEnv
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_belief.common.safe_files.trust import is_allowed
from sb3_belief.envs.registry import EnvSpec, registered_ids, spec
from sb3_belief.envs.suites import SUITES
from sb3_belief.vec_env.team_vec_env import TeamVecEnv
from sb3_belief.zoo.errors import ConfigError, cause, short, suggestion, unknown_setting

#: The packages, or parts of packages, into which a dotted path in a YAML file may point
ALLOWED_PACKAGES = (
    "sb3_belief",
    "stable_baselines3",
    "sb3_contrib",
    "pettingzoo",
    "supersuit",
    "torch.nn",
    "torch.optim",
)
# Where the classes and wrappers are that other libraries' configurations name without their modules
_WELL_KNOWN = (
    "torch.nn",
    "torch.optim",
    "supersuit",
    "stable_baselines3.common.callbacks",
    "stable_baselines3.common.buffers",
    "stable_baselines3.common.torch_layers",
)


@dataclass(frozen=True)
class Algo:
    """
    Algorithm that a short name stands for.

    :param path: ``"module:class"``, which is imported when the algorithm is used
    :param fixed: Constructor arguments that the name implies. A configuration cannot change them
    :param partner_memory: ``"module:class"`` of the same with a memory that lasts as long as a partner stays; empty if there
        is none
    :param adapter: ``"module:function"`` that makes of a team's environment the one in which the algorithm learns and acts,
        for algorithms that learn centrally; empty for the agents' own. It takes the ``TeamVecEnv`` and the settings
        ``adapter_kwargs``, and returns a ``TeamVecEnv``: of the same agents, who see more, or of a single one, which acts
        for all (``references.one_learner.OneLearnerVecEnv``). Nothing else in the zoo tells such a learner from a team
    :param note: What every place has to say that names the algorithm; empty for nothing
    """

    path: str
    fixed: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    partner_memory: str = ""
    adapter: str = ""
    note: str = ""

    def load(self) -> type[BaseAlgorithm]:
        """
        Import the algorithm.

        :return: Its class
        """
        return _import(self.path)

    def load_adapter(self) -> Callable[..., TeamVecEnv] | None:
        """
        Import the adapter.

        :return: The function; None if there is none
        """
        return _import(self.adapter) if self.adapter else None


def _import(path: str) -> Any:
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(module), name)


#: What is said of models that all agents have in common
SHARED = "shares weights: not decentralised"
_NO_BELIEF: Mapping[str, Any] = MappingProxyType({"belief": "none"})
_AMF: Mapping[str, Any] = MappingProxyType({"belief": "static", "action_loss": "cross_entropy", "detach_belief": False})
#: What is said of references that learn centrally
CENTRAL = "uses the global state in training"
_STATE = "sb3_belief.references.with_state:with_state"
_SHARED_STATE = "sb3_belief.references.adapters:shared_with_state"
_SHARED_WEIGHTS = "sb3_belief.references.adapters:shared_weights"
_JOINT = "sb3_belief.references.joint_vec_env:joint_team"


def _factorised(mixer: str) -> Algo:
    path = "sb3_belief.references.factorisation:ValueFactorisation"
    return Algo(path, MappingProxyType({"mixer": mixer}), adapter=_JOINT, note=CENTRAL)


#: The algorithms whose unmodified ``learn()`` runs in a team. ARS is not among them, because it steps its environments itself
ALGOS: Mapping[str, Algo] = MappingProxyType(
    {
        "belief_ppo": Algo("sb3_belief.belief_ppo:BeliefPPO"),
        "ippo": Algo("sb3_belief.belief_ppo:BeliefPPO", _NO_BELIEF),
        "ippo_wide": Algo("sb3_belief.belief_ppo:BeliefPPO", MappingProxyType({"belief": "wide"})),
        "amf_ppo": Algo("sb3_belief.baselines.amf:AMFPPO", _AMF),
        "maskable_amf_ppo": Algo("sb3_belief.baselines.amf:MaskableAMFPPO", _AMF),
        "iac": Algo("sb3_belief.baselines.iac:IAC"),
        "ippo_shared": Algo("sb3_belief.references.shared:SharedPPO", _NO_BELIEF, adapter=_SHARED_WEIGHTS, note=SHARED),
        "maskable_ippo_shared": Algo(
            "sb3_belief.references.shared:MaskableSharedPPO", _NO_BELIEF, adapter=_SHARED_WEIGHTS, note=SHARED
        ),
        **{
            name: Algo(f"sb3_belief.references.{path}", _NO_BELIEF, adapter=adapter, note=note)
            for name, path, adapter, note in (
                ("mappo", "mappo:MAPPO", _STATE, CENTRAL),
                ("maskable_mappo", "mappo:MaskableMAPPO", _STATE, CENTRAL),
                ("mappo_shared", "shared:SharedMAPPO", _SHARED_STATE, f"{CENTRAL}, {SHARED}"),
                ("maskable_mappo_shared", "shared:MaskableSharedMAPPO", _SHARED_STATE, f"{CENTRAL}, {SHARED}"),
            )
        },
        "iql": Algo("sb3_belief.baselines:IQL"),
        "dpiqn": Algo("sb3_belief.baselines:DPIQN"),
        "drpiqn": Algo("sb3_belief.baselines:DRPIQN"),
        "maskable_belief_ppo": Algo("sb3_belief.belief_ppo:MaskableBeliefPPO"),
        "ppo": Algo("stable_baselines3:PPO"),
        "a2c": Algo("stable_baselines3:A2C"),
        "dqn": Algo("stable_baselines3:DQN"),
        "ddpg": Algo("stable_baselines3:DDPG"),
        "td3": Algo("stable_baselines3:TD3"),
        "sac": Algo("stable_baselines3:SAC"),
        "maskable_ppo": Algo("sb3_contrib:MaskablePPO"),
        "recurrent_ppo": Algo("sb3_contrib:RecurrentPPO", partner_memory="sb3_belief.team.recurrent:PartnerRecurrentPPO"),
        "trpo": Algo("sb3_contrib:TRPO"),
        "qrdqn": Algo("sb3_contrib:QRDQN"),
        "tqc": Algo("sb3_contrib:TQC"),
        "crossq": Algo("sb3_contrib:CrossQ"),
        "rode": Algo("sb3_belief.references.rode:RODE", adapter=_JOINT, note=CENTRAL),
        "maddpg": Algo("sb3_belief.references.maddpg:MADDPG", adapter=_JOINT, note=CENTRAL),
        "coma": Algo("sb3_belief.references.coma:COMA", adapter=_JOINT, note=CENTRAL),
        **{mixer: _factorised(mixer) for mixer in ("vdn", "qmix", "qplex", "qtran")},
    }
)


def get_algo(name: str, where: str = "--algo", memory_span: Any = None) -> Algo:
    """
    Return the algorithm that a short name stands for.

    :param name: A key of ``ALGOS``
    :param where: File, section and key, or flag, for the error message
    :param memory_span: ``"partner"`` for an algorithm whose memory lasts as long as a partner stays
    :return: The algorithm
    :raises ConfigError: For another name, or one without such a memory
    """
    if not isinstance(name, str) or name not in ALGOS:
        raise unknown_setting(where, "algorithm", name, ALGOS)
    algo = ALGOS[name]
    if memory_span != "partner":
        return algo
    if not algo.partner_memory:
        able = ", ".join(each for each, other in ALGOS.items() if other.partner_memory)
        raise ConfigError(f"{where}: {name} has no memory, so memory_span: partner is not for it. Allowed: {able}.")
    return replace(algo, path=algo.partner_memory)


def resolve(path: Any, where: str, extra_packages: tuple[str, ...] = ()) -> Callable[..., Any]:
    """
    Return the class or function that a dotted path names.

    The path is looked up and never evaluated. Both the module in the path and the module in which the object was defined must
    belong to an allowed package. Without the second condition a path could reach whatever an allowed module imports, as in
    ``some.allowed.module.os.system``.

    :param path: Dotted path, e.g. ``"supersuit.frame_stack_v1"``
    :param where: File, section and key, or flag, for the error message
    :param extra_packages: Further packages that the user allows on the command line (``--allow-package``)
    :return: The class or function
    :raises ConfigError: If this is not a dotted path, is not allowed, or names nothing
    """
    packages = (*ALLOWED_PACKAGES, *extra_packages)
    module_name, _, name = path.rpartition(".") if isinstance(path, str) else ("", "", "")
    if not module_name or not all(part.isidentifier() for part in path.split(".")):
        found_in = _modules_of(path) if isinstance(path, str) and path.isidentifier() else []
        example = f": write {' or '.join(found_in)}" if found_in else " such as 'supersuit.frame_stack_v1'"
        raise ConfigError(f"{where}: {short(path)} is not a dotted path{example}.")
    allowed = f"Allowed: what {', '.join(packages)} define (more packages: the flag --allow-package NAME)."
    if not is_allowed(module_name, packages):
        root = path.split(".")[0]
        raise ConfigError(f"{where}: {path!r} is not of an allowed package.{suggestion(root, packages)} {allowed}")
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        raise ConfigError(f"{where}: no module {module_name!r} for {path!r} ({error}). {allowed}") from None
    except Exception as error:
        raise ConfigError(f"{where}: the module {module_name!r} fails when it is imported: {cause(error)}.") from error
    try:
        # supersuit raises ImportError for an old version of a wrapper. Its message names the new one
        found = getattr(module, name)
    except (AttributeError, ImportError) as error:
        public = [attr for attr in dir(module) if not attr.startswith("_")]
        raise ConfigError(f"{where}: {module_name!r} has no {name!r} ({error}).{suggestion(name, public)} {allowed}") from None
    if type(found).__module__ == "supersuit.utils.wrapper_chooser":
        # It is not a wrapper but chooses one for the kind of environment, which here is always the same
        found = found.parallel_wrapper
        if found is None:
            raise ConfigError(
                f"{where}: {path!r} takes a function, which YAML cannot hold: write a function f(env) of your own that returns"
                f" {path}(env, ...), name it instead as <module>.f, and allow its module with --allow-package."
            )
    is_code = inspect.isclass(found) or inspect.isfunction(found)
    if not is_code or not is_allowed(found.__module__, packages):
        raise ConfigError(f"{where}: {path!r} is not a class or function that its package defines itself. {allowed}")
    return found


def _modules_of(name: str) -> list[str]:
    """Return the dotted paths of what has a name, in any case, in the modules whose names are often written alone."""
    found = []
    for module_name in _WELL_KNOWN:
        module = importlib.import_module(module_name)
        found += [
            f"{module_name}.{each}" for each in dir(module) if each.lower() == name.lower() and callable(vars(module)[each])
        ]
    return found


def get_env(env_id: str, where: str, extra_packages: tuple[str, ...] = ()) -> EnvSpec:
    """
    Return the specification of an environment, without importing its package.

    :param env_id: Registered id, ``suite/name`` or ``module:callable``
    :param where: File and section, or flag, for the error message
    :param extra_packages: See ``resolve``. They are imported if the id is unknown without them, because they may register it
    :return: The specification
    :raises ConfigError: For an unknown id
    """
    try:
        return spec(env_id)
    except ValueError:
        for package in extra_packages:
            _import_extra(package)
    try:
        return spec(env_id)
    except ValueError as error:
        # The registry's own message is better here: it compares with the suites, or lists the names of the one meant
        if "/" in env_id or env_id in SUITES:
            raise ConfigError(f"{where}: {error}") from None
        kinds = [*registered_ids(), *(f"{suite}/<name>" for suite in SUITES), "<module>:<callable>"]
        raise unknown_setting(where, "environment", env_id, kinds) from None


def _import_extra(package: str) -> None:
    try:
        importlib.import_module(package)
    except ModuleNotFoundError as error:
        raise ConfigError(f"--allow-package: there is no module {package!r} to import ({error}).") from None
    except Exception as error:
        raise ConfigError(f"--allow-package: {package!r} fails when it is imported: {cause(error)}.") from error


def load_env(env_id: str, where: str, extra_packages: tuple[str, ...] = (), of_file: bool = False) -> Callable[..., Any]:
    """
    Import and return the callable that makes one copy of an environment.

    The id in a file of a run, whose author may be a stranger, names a registered environment, one of a suite, or a class of
    PettingZoo's kinds. Another callable of an allowed package could do anything with the arguments that the file has for it.

    :param env_id: See ``get_env``
    :param where: Flag or command, for the error message
    :param extra_packages: See ``resolve``. A ``module:callable`` must belong to an allowed package
    :param of_file: Whether a file of a run has the id, and not the user
    :return: The callable
    :raises ConfigError: For an id that is unknown or not allowed, or whose package is not installed
    """
    if of_file and "/" in env_id and ":" in env_id:
        # Gymnasium would import the module before the colon
        raise ConfigError(f"{where}: {short(env_id)} names a module to import. If you trust the file, give it with --env.")
    found = get_env(env_id, where, extra_packages)
    # The specification of a "module:callable" holds the id itself. This kind can name any code, so the allow-list applies
    if found.parallel == env_id:
        make = resolve(env_id.replace(":", "."), where, extra_packages)
        if of_file and not is_allowed(make.__module__, extra_packages) and not _makes_env(make):
            raise ConfigError(
                f"{where}: {env_id!r} is no environment of PettingZoo's kinds, and a file may name no other callable. If you"
                f" trust the file: --allow-package {make.__module__.partition('.')[0]}, or give it with --env."
            )
        return make
    try:
        return found.load()
    except ImportError as error:
        raise ConfigError(f"{where}: {error}") from error
    except Exception as error:
        raise ConfigError(f"{where}: {env_id} cannot be imported: {cause(error)}.") from error


def _makes_env(make: Callable[..., Any]) -> bool:
    if inspect.isclass(make):
        return issubclass(make, (ParallelEnv, AECEnv))
    return is_allowed(make.__module__, ("pettingzoo",)) and make.__name__ in ("parallel_env", "env", "raw_env")
