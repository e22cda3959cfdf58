"""
From ``zoo_configs/<algo>.yml`` and the command line to one checked configuration.

A file maps environment ids to settings; its section ``default`` lies under every other one. Each source of settings is checked
by itself, before anything is made, so that a refusal can name the file, the section and the key.
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

from sb3_belief.zoo.checks import Place, check_call, check_value, parameters
from sb3_belief.zoo.errors import ConfigError, unknown
from sb3_belief.zoo.names import Algo, get_algo, get_env, load_env, resolve
from sb3_belief.zoo.yaml_data import merge, parse_pairs, read_file

DEFAULT = "default"
REPO_CONFIGS = Path(__file__).resolve().parents[2] / "zoo_configs"

#: Settings of the run itself; every other key is an argument of the algorithm's constructor
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
# Naming these anew replaces what a lower layer named, instead of adding to it
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
    All that a run needs to know, checked.

    :param algo: name of the algorithm
    :param env_id: id of the environment
    :param settings: the merged settings as plain data, what ``config.yml`` says
    :param source: the file they come from
    :param algo_class: the algorithm's class
    :param policy: name of its policy
    :param n_envs: number of environment copies
    :param n_timesteps: joint steps to train for
    :param normalize: for ``Team(normalize=...)``
    :param env_kwargs: for ``make_team_env``
    :param wrapper: for ``make_team_env``: the wrappers named by ``env_wrapper``, or None
    :param visibility: for ``make_team_env``: the function named by ``visibility``, or None
    :param callbacks: callback classes and their arguments
    :param algo_kwargs: constructor arguments of each agent's algorithm
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
        :return: a configuration file that reproduces the run with ``--conf-file``
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
    :param algo: name of the algorithm (``names.ALGOS``)
    :param env_id: id of the environment: a registered one, ``family/name`` or ``module:callable``
    :param conf_file: YAML file to read instead of ``zoo_configs/<algo>.yml``
    :param params: ``key:value`` pairs that win over the file
    :param env_kwargs: ``key:value`` pairs for the environment
    :param n_timesteps: joint steps, instead of the file's
    :param extra_packages: see ``names.resolve``
    :return: the merged and checked configuration
    :raises ConfigError: for whatever does not fit, naming its place, what is allowed and the nearest match
    """
    chosen = get_algo(algo)
    make_env = load_env(env_id, "--env", extra_packages)
    path = find_config_file(algo, conf_file)
    sections = read_file(path)
    for name in sections:
        if name != DEFAULT:
            get_env(name, str(path))
    if not sections.keys() & {env_id, DEFAULT}:
        there = ", ".join(sections) or "none"
        raise ConfigError(f"{path}: has no section {env_id!r} and no section {DEFAULT!r}; it has {there}.")

    layers: list[tuple[Place, Any]] = [
        (Place(f"{path}, section {name}", extra_packages), sections[name]) for name in (DEFAULT, env_id) if name in sections
    ]
    layers.append((Place("-params", extra_packages), parse_pairs(params, "-params")))
    layers.append((Place("--env-kwargs", extra_packages), {"env_kwargs": parse_pairs(env_kwargs, "--env-kwargs")}))
    if n_timesteps is not None:
        layers.append((Place("--n-timesteps", extra_packages), {"n_timesteps": n_timesteps}))

    for place, layer in layers:
        if layer is not None and not isinstance(layer, dict):
            raise ConfigError(f"{place.text}: must be a mapping of settings, not {layer!r}.")
    checker = _LayerChecker(chosen, make_env, len(get_env(env_id, "--env").leading), _policy_name(layers))
    settings: dict[str, Any] = {}
    checked: dict[str, Any] = {}
    for place, layer in layers:
        checked = _put_over(checked, checker.check(layer or {}, place))
        settings = _put_over(settings, layer or {})
    if not settings["env_kwargs"]:
        del settings["env_kwargs"]
    for key in ("policy", "n_timesteps"):
        if key not in checked:
            raise ConfigError(f"{path}: no {key!r} for {env_id!r}: add it to the section {env_id!r} or {DEFAULT!r}.")
    return _to_run_config(algo, env_id, settings, str(path), checker.algo_class, {**checked, **chosen.fixed})


def find_config_file(algo: str, conf_file: str | None = None) -> Path:
    """
    :param algo: name of the algorithm
    :param conf_file: what the user gave, if anything
    :return: that file; else the one of the checkout; else the one that was installed with the package
    :raises ConfigError: if there is none
    """
    if conf_file is not None:
        if not Path(conf_file).is_file():
            raise ConfigError(f"--conf-file: no file {conf_file!r}.")
        return Path(conf_file)
    candidates = [REPO_CONFIGS / f"{algo}.yml"]
    try:
        installed = metadata.files("sb3-belief") or []
        candidates += [
            Path(os.path.normpath(str(file.locate()))) for file in installed if file.match(f"zoo_configs/{algo}.yml")
        ]
    except metadata.PackageNotFoundError:
        pass
    for candidate in candidates:
        if candidate.is_file():
            # short where possible: it stands in every message
            return candidate.relative_to(Path.cwd()) if candidate.is_relative_to(Path.cwd()) else candidate
    raise ConfigError(f"No {algo}.yml in {REPO_CONFIGS} nor beside the installed package: name a file with --conf-file.")


def _policy_name(layers: Sequence[tuple[Place, Any]]) -> Any:
    given = [layer["policy"] for _, layer in layers if layer and "policy" in layer]
    return given[-1] if given else None


def _put_over(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    return merge({key: value for key, value in base.items() if not (key in _REPLACED and key in over)}, over)


class _LayerChecker:
    """
    Checks one source of settings after the other against one algorithm and one environment.

    :param algo: the algorithm
    :param make_env: what makes the environment
    :param n_leading: how many of its arguments the environment's id stands for
    :param policy: the policy's name after merging, whose arguments ``policy_kwargs`` are
    """

    def __init__(self, algo: Algo, make_env: Callable[..., Any], n_leading: int, policy: Any) -> None:
        self.algo_class = algo.load()
        self.make_env, self.n_leading = make_env, n_leading
        self.policies = self.algo_class.policy_aliases
        self.policy_class = self.policies.get(policy) if isinstance(policy, str) else None
        arguments, _ = parameters(self.algo_class)
        fixed = {name: f"the algorithm's name stands for {name}={value!r}" for name, value in algo.fixed.items()}
        self.reserved = {**_FLAGS, **fixed}
        self.arguments = {name: hint for name, hint in arguments.items() if name not in (*RUN_KEYS, *self.reserved)}
        # what the algorithm hands on to its policy is set in one place only
        self.policy_reserved = {**_POLICY_INTERNAL, **dict.fromkeys(arguments, "set it beside policy_kwargs, not inside")}

    def check(self, layer: dict[str, Any], place: Place) -> dict[str, Any]:
        """
        :param layer: settings as plain data
        :param place: where they stand
        :return: the settings with wrappers, callbacks, classes and schedules made
        """
        checked = {}
        allowed = [*RUN_KEYS, *self.arguments]
        for key, value in layer.items():
            if key in self.reserved:
                why = f"{key!r} cannot be set here: {self.reserved[key]}"
                raise ConfigError(f"{place.text}: {why}. Allowed: {', '.join(allowed)}.")
            if key in RUN_KEYS:
                checked[key] = self._check_run_key(key, check_value(value, RUN_KEYS[key], place.key(key)), place.key(key))
            elif key in self.arguments:
                checked[key] = check_value(value, self.arguments[key], place.key(key))
            else:
                raise unknown(place.text, "key", key, allowed)
        return checked

    def _check_run_key(self, key: str, value: Any, place: Place) -> Any:
        if key in ("n_envs", "n_timesteps") and value < 1:
            raise ConfigError(f"{place.text}: must be at least 1, not {value}.")
        if key == "policy" and value not in self.policies:
            raise unknown(place.text, "policy", value, self.policies)
        if key == "policy_kwargs" and self.policy_class is not None:
            return check_call(self.policy_class, value, place, reserved=self.policy_reserved)
        if key == "env_kwargs":
            return check_call(self.make_env, value, place, skip=self.n_leading)
        if key == "env_wrapper":
            return tuple(self._check_calls(value, place, skip=1))
        if key == "visibility":
            calls = self._check_calls(value, place, skip=1)
            if len(calls) > 1:
                raise ConfigError(f"{place.text}: must name one function, not {len(calls)}: there is one visibility.")
            return partial(calls[0][0], **calls[0][1]) if calls else None
        if key == "callback":
            callbacks = tuple(self._check_calls(value, place))
            for callback, _ in callbacks:
                if not (isinstance(callback, type) and issubclass(callback, BaseCallback)):
                    raise ConfigError(f"{place.text}: {callback.__name__} is not a callback of Stable-Baselines3.")
            return callbacks
        return value

    def _check_calls(self, value: Any, place: Place, skip: int = 0) -> list[tuple[Callable[..., Any], dict[str, Any]]]:
        """``path``, ``{path: arguments, ...}``, or a list of these."""
        calls = []
        for item in value if isinstance(value, list) else [] if value is None else [value]:
            for path, arguments in item.items() if isinstance(item, dict) else [(item, None)]:
                function = resolve(path, place.text, place.extra_packages)
                calls.append((function, check_call(function, arguments, place.key(path), skip=skip)))
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
