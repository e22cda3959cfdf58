"""
Loading and checking the configuration of a run, from ``zoo_configs/<algo>.yml`` and the command line.

A file maps environment ids to settings. The settings of its section ``default`` hold for all environments, and the other
sections override them. Each source of settings is checked before they are merged, so that an error message can name the file,
the section and the key. Nothing is created before all of them have been checked.
"""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import yaml
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from sb3_belief.zoo.checks import Location, accepted_arguments, check_call, check_value
from sb3_belief.zoo.errors import ConfigError, unknown_setting
from sb3_belief.zoo.names import Algo, get_algo, get_env, load_env, resolve
from sb3_belief.zoo.yaml_data import merge, parse_pairs, read_file

DEFAULT = "default"
REPO_CONFIGS = Path(__file__).resolve().parents[2] / "zoo_configs"

#: The settings of the run itself. Every other key is an argument of the algorithm's constructor
RUN_KEYS: dict[str, Any] = {
    "n_envs": int,
    "n_timesteps": int,
    "policy": str,
    "policy_kwargs": dict[str, Any],
    "normalize": bool | dict[str, Any],
    "env_wrapper": str | list[Any] | dict[str, Any] | None,
    "visibility": str | dict[str, Any] | None,
    "env_kwargs": dict[str, Any],
    "callback": str | list[Any] | dict[str, Any] | None,
}
# Settings that override those of a lower layer as a whole. Merging them as mappings would add a second wrapper to the first
_REPLACED = ("env_wrapper", "visibility", "callback")

_FLAGS = {
    "env": "use the flag --env",
    "seed": "use the flag --seed",
    "device": "use the flag --device",
    "verbose": "use the flag --verbose",
    "tensorboard_log": "use the flag --tensorboard-log",
    "_init_setup_model": "it is internal to Stable-Baselines3",
}
_POLICY_INTERNAL = dict.fromkeys(
    ("observation_space", "action_space", "lr_schedule", "others_action_spaces"), "the algorithm sets it"
)


@dataclass(frozen=True)
class RunConfig:
    """
    Checked configuration of a run.

    :param algo: Name of the algorithm
    :param env_id: Id of the environment
    :param settings: The merged settings as plain data, which are written to ``config.yml``
    :param source: Path of the file that they come from
    :param algo_class: Class of the algorithm
    :param policy: Name of its policy
    :param n_envs: Number of environment copies, at least 1
    :param n_timesteps: Number of joint steps to train for, at least 1
    :param normalize: Argument of ``Team``
    :param env_kwargs: Argument of ``make_team_env``
    :param wrapper: Argument of ``make_team_env``: a function that applies the wrappers of ``env_wrapper``, or None
    :param visibility: Argument of ``make_team_env``: the function that ``visibility`` names, or None
    :param callbacks: Callback classes and their arguments
    :param algo_kwargs: Constructor arguments of each agent's algorithm
    """

    algo: str
    env_id: str
    settings: dict[str, Any]
    source: str
    algo_class: type[BaseAlgorithm]
    policy: str
    n_envs: int
    n_timesteps: int
    normalize: bool | dict[str, Any] = False
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    wrapper: Callable[[Any], Any] | None = None
    visibility: Callable[[Any], Any] | None = None
    callbacks: tuple[tuple[type[BaseCallback], dict[str, Any]], ...] = ()
    algo_kwargs: dict[str, Any] = field(default_factory=dict)

    def to_yaml(self) -> str:
        """
        Return the settings as a configuration file, which reproduces the run with ``--conf-file``.

        :return: YAML
        """
        return yaml.safe_dump({self.env_id: self.settings}, sort_keys=False)


def load_config(
    algo: str,
    env_id: str,
    conf_file: str | None = None,
    params: Sequence[str] = (),
    env_kwargs: Sequence[str] = (),
    n_timesteps: int | None = None,
    extra_packages: tuple[str, ...] = (),
) -> RunConfig:
    """
    Load, merge and check the settings of a run.

    Later sources override earlier ones: the file's section ``default``, its section of the environment, ``params``,
    ``env_kwargs``, ``n_timesteps``.

    :param algo: Name of the algorithm, a key of ``names.ALGOS``
    :param env_id: Registered id, ``suite/name`` or ``module:callable`` of the environment
    :param conf_file: YAML file to read instead of ``zoo_configs/<algo>.yml``
    :param params: ``key:value`` pairs of settings
    :param env_kwargs: ``key:value`` pairs of arguments of the environment
    :param n_timesteps: Number of joint steps to train for, or None for the file's
    :param extra_packages: See ``names.resolve``
    :return: The configuration
    :raises ConfigError: For a setting that does not fit. The message names its location, what is allowed and the nearest match
    """
    chosen = get_algo(algo)
    make_env = load_env(env_id, "--env", extra_packages)
    path = find_config_file(algo, conf_file)
    sections = read_file(path)
    for name in sections:
        if name != DEFAULT:
            get_env(name, str(path))
    if not sections.keys() & {env_id, DEFAULT}:
        existing = ", ".join(sections) or "none"
        raise ConfigError(f"{path}: has no section {env_id!r} and no section {DEFAULT!r}; it has {existing}.")

    layers: list[tuple[Location, Any]] = [
        (Location(f"{path}, section {name}", extra_packages), sections[name]) for name in (DEFAULT, env_id) if name in sections
    ]
    layers.append((Location("-params", extra_packages), parse_pairs(params, "-params")))
    layers.append((Location("--env-kwargs", extra_packages), {"env_kwargs": parse_pairs(env_kwargs, "--env-kwargs")}))
    if n_timesteps is not None:
        layers.append((Location("--n-timesteps", extra_packages), {"n_timesteps": n_timesteps}))

    for location, layer in layers:
        if layer is not None and not isinstance(layer, dict):
            raise ConfigError(f"{location.text}: must be a mapping of settings, not {layer!r}.")
    checker = _LayerChecker(chosen, make_env, len(get_env(env_id, "--env").leading), _policy_name(layers))
    settings: dict[str, Any] = {}
    checked: dict[str, Any] = {}
    # The plain data is merged as well, because config.yml is written from it
    for location, layer in layers:
        checked = _override(checked, checker.check(layer or {}, location))
        settings = _override(settings, layer or {})
    if not settings["env_kwargs"]:
        del settings["env_kwargs"]
    for key in ("policy", "n_timesteps"):
        if key not in checked:
            raise ConfigError(f"{path}: no {key!r} for {env_id!r}: add it to the section {env_id!r} or {DEFAULT!r}.")
    return _to_run_config(algo, env_id, settings, str(path), checker.algo_class, {**checked, **chosen.fixed})


def find_config_file(algo: str, conf_file: str | None = None) -> Path:
    """
    Return the configuration file to read.

    :param algo: Name of the algorithm
    :param conf_file: File that the user gave, or None
    :return: The given file, otherwise the algorithm's file in the checkout, otherwise the one installed with the package
    :raises ConfigError: If there is none
    """
    if conf_file is not None:
        if not Path(conf_file).is_file():
            raise ConfigError(f"--conf-file: no file {conf_file!r}.")
        return Path(conf_file)
    candidates = [REPO_CONFIGS / f"{algo}.yml"]
    # Outside a checkout the files are data files of the distribution. They are installed beside the package, at a path with
    # ".." that only the distribution's metadata knows
    try:
        installed = metadata.files("sb3-belief") or []
        candidates += [
            Path(os.path.normpath(str(file.locate()))) for file in installed if file.match(f"zoo_configs/{algo}.yml")
        ]
    except metadata.PackageNotFoundError:
        pass
    for candidate in candidates:
        if candidate.is_file():
            # Relative where possible, because every error message contains the path
            return candidate.relative_to(Path.cwd()) if candidate.is_relative_to(Path.cwd()) else candidate
    raise ConfigError(f"No {algo}.yml in {REPO_CONFIGS} nor beside the installed package: name a file with --conf-file.")


def _policy_name(layers: Sequence[tuple[Location, Any]]) -> Any:
    given = [layer["policy"] for _, layer in layers if layer and "policy" in layer]
    return given[-1] if given else None


def _override(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    return merge({key: value for key, value in base.items() if not (key in _REPLACED and key in over)}, over)


class _LayerChecker:
    """
    Checker of one source of settings at a time, for a given algorithm and environment.

    :param algo: The algorithm
    :param make_env: Callable that makes the environment
    :param n_leading: Number of its leading arguments that the environment's id determines
    :param policy: Name of the policy after merging. ``policy_kwargs`` are checked against its arguments
    """

    def __init__(self, algo: Algo, make_env: Callable[..., Any], n_leading: int, policy: Any) -> None:
        self.algo_class = algo.load()
        self.make_env, self.n_leading = make_env, n_leading
        self.policies = self.algo_class.policy_aliases
        self.policy_class = self.policies.get(policy) if isinstance(policy, str) else None
        arguments, _ = accepted_arguments(self.algo_class)
        fixed = {name: f"the algorithm's name stands for {name}={value!r}" for name, value in algo.fixed.items()}
        self.reserved = {**_FLAGS, **fixed}
        self.arguments = {name: hint for name, hint in arguments.items() if name not in (*RUN_KEYS, *self.reserved)}
        # The algorithm passes some of its arguments to its policy. They can only be set as the algorithm's
        self.policy_reserved = {**_POLICY_INTERNAL, **dict.fromkeys(arguments, "set it beside policy_kwargs, not inside")}

    def check(self, layer: dict[str, Any], location: Location) -> dict[str, Any]:
        """
        Check one source of settings.

        :param layer: Settings as plain data
        :param location: Where they are given
        :return: The settings with wrappers, callbacks, classes and schedules in place of their names
        :raises ConfigError: For a setting that does not fit
        """
        checked = {}
        allowed = [*RUN_KEYS, *self.arguments]
        for key, value in layer.items():
            if key in self.reserved:
                why = f"{key!r} cannot be set here: {self.reserved[key]}"
                raise ConfigError(f"{location.text}: {why}. Allowed: {', '.join(allowed)}.")
            if key in RUN_KEYS:
                checked[key] = self._check_run_key(key, value, location.key(key))
            elif key in self.arguments:
                checked[key] = check_value(value, self.arguments[key], location.key(key))
            else:
                raise unknown_setting(location.text, "key", key, allowed)
        return checked

    def _check_run_key(self, key: str, value: Any, location: Location) -> Any:
        value = check_value(value, RUN_KEYS[key], location)
        if key in ("n_envs", "n_timesteps") and value < 1:
            raise ConfigError(f"{location.text}: must be at least 1, not {value}.")
        if key == "policy" and value not in self.policies:
            raise unknown_setting(location.text, "policy", value, self.policies)
        if key == "policy_kwargs" and self.policy_class is not None:
            return check_call(self.policy_class, value, location, reserved=self.policy_reserved)
        if key == "env_kwargs":
            return check_call(self.make_env, value, location, skip=self.n_leading)
        if key == "env_wrapper":
            return tuple(self._check_calls(value, location, skip=1))
        if key == "visibility":
            calls = self._check_calls(value, location, skip=1)
            if len(calls) > 1:
                raise ConfigError(f"{location.text}: must name one function, not {len(calls)}: there is one visibility.")
            return partial(calls[0][0], **calls[0][1]) if calls else None
        if key == "callback":
            callbacks = tuple(self._check_calls(value, location))
            for callback, _ in callbacks:
                if not (isinstance(callback, type) and issubclass(callback, BaseCallback)):
                    raise ConfigError(f"{location.text}: {callback.__name__} is not a callback of Stable-Baselines3.")
            return callbacks
        return value

    def _check_calls(self, value: Any, location: Location, skip: int = 0) -> list[tuple[Callable[..., Any], dict[str, Any]]]:
        """Read what may be a ``path``, a mapping ``{path: arguments, ...}``, or a list of these."""
        calls = []
        for item in value if isinstance(value, list) else [] if value is None else [value]:
            for path, arguments in item.items() if isinstance(item, dict) else [(item, None)]:
                function = resolve(path, location.text, location.extra_packages)
                calls.append((function, check_call(function, arguments, location.key(path), skip=skip)))
        return calls


def _wrap(env: Any, wrappers: Sequence[tuple[Callable[..., Any], dict[str, Any]]]) -> Any:
    for wrapper, kwargs in wrappers:
        env = wrapper(env, **kwargs)
    return env


def _to_run_config(
    algo: str, env_id: str, settings: dict[str, Any], source: str, algo_class: type[BaseAlgorithm], checked: dict[str, Any]
) -> RunConfig:
    wrappers = checked.get("env_wrapper", ())
    algo_kwargs = {key: value for key, value in checked.items() if key not in RUN_KEYS}
    if "policy_kwargs" in checked:
        algo_kwargs["policy_kwargs"] = checked["policy_kwargs"]
    return RunConfig(
        algo=algo,
        env_id=env_id,
        settings=settings,
        source=source,
        algo_class=algo_class,
        policy=checked["policy"],
        n_envs=checked.get("n_envs", 1),
        n_timesteps=checked["n_timesteps"],
        normalize=checked.get("normalize", False),
        env_kwargs=checked.get("env_kwargs", {}),
        wrapper=partial(_wrap, wrappers=wrappers) if wrappers else None,
        visibility=checked.get("visibility"),
        callbacks=checked.get("callback", ()),
        algo_kwargs=algo_kwargs,
    )
