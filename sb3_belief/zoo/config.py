"""
Loading and checking the configuration of a run, from ``zoo_configs/<algo>.yml`` and the command line.

A file maps environment ids to settings. The settings of its section ``default`` hold for all environments, and the other
sections override them. Each source of settings is checked before they are merged, so that an error message can name the file,
the section and the key. Nothing is created before all of them have been checked.
"""

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import yaml
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from sb3_belief.vec_env.team_vec_env import TeamVecEnv
from sb3_belief.zoo.checks import Location
from sb3_belief.zoo.errors import ConfigError, short, unknown_setting
from sb3_belief.zoo.names import Algo, get_algo, get_env, load_env
from sb3_belief.zoo.partners import PartnersConfig, partners_config, without_replaced
from sb3_belief.zoo.settings import RUN_KEYS, SettingsChecker, observation_arguments
from sb3_belief.zoo.yaml_data import merge, parse_pairs, read_file

DEFAULT = "default"
# Settings that override those of a lower layer as a whole. Merging them as mappings would add a second wrapper to the first
_REPLACED = ("env_wrapper", "visibility", "callback")
REPO_CONFIGS = Path(__file__).resolve().parents[2] / "zoo_configs"


@dataclass(frozen=True)
class AgentConfig:
    """
    An agent's algorithm and its settings.

    :param algo: Name of the algorithm
    :param algo_class: Class of the algorithm
    :param policy: Name of its policy
    :param algo_kwargs: Constructor arguments of the algorithm
    """

    algo: str
    algo_class: type[BaseAlgorithm]
    policy: str
    algo_kwargs: dict[str, Any]


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
    :param observation: Arguments of ``make_team_env`` that say what agents observe besides: ``observe_last`` and
        ``partner_starts``
    :param callbacks: Callback classes and their arguments
    :param algo_kwargs: Constructor arguments of each agent's algorithm
    :param eval_env_kwargs: Arguments of the environment of evaluations, which override ``env_kwargs``
    :param agents: The agents with settings of their own
    :param partners: The agents that act and do not learn; None if all learn
    :param adapter: Makes of the agents' environment the one in which a central learner learns and acts; None for the agents'
    :param note: What every place has to say that names the algorithm; empty for nothing
    :param origins: Where each setting comes from: the file and its section, or the flag
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
    observation: dict[str, Any] = field(default_factory=dict)
    callbacks: tuple[tuple[type[BaseCallback], dict[str, Any]], ...] = ()
    algo_kwargs: dict[str, Any] = field(default_factory=dict)
    eval_env_kwargs: dict[str, Any] = field(default_factory=dict)
    agents: dict[str, AgentConfig] = field(default_factory=dict)
    partners: PartnersConfig | None = None
    adapter: Callable[[TeamVecEnv], TeamVecEnv] | None = None
    note: str = ""
    origins: dict[str, str] = field(default_factory=dict)

    def origin(self, message: str = "") -> str:
        """
        Return where the settings come from that an error message speaks of.

        :param message: The message
        :return: The flags, or file and sections, of the settings that it names, by their names or by the classes that are
            their values. If it names none: the flags that were given, or else the file
        """
        for agent, own in self.settings.get("agent_kwargs", {}).items():
            if repr(agent) in message and any(_speaks_of(message, *setting) for setting in _with_nested(own)):
                return f"{self.origins['agent_kwargs']}: agent_kwargs: {agent}"
        settings = _with_nested(self.settings)
        named = [self.origins[name] for name, value in settings if name in self.origins and _speaks_of(message, name, value)]
        # What is new is more likely to fail than a file that has worked; the number of steps is no setting of what is made
        flags = [text for text in self.origins.values() if text.startswith("-") and text != "--n-timesteps"]
        return ", ".join(dict.fromkeys(named or flags or [self.source]))

    def agent(self, name: str) -> AgentConfig:
        """
        Return the algorithm of an agent with its settings.

        :param name: Name of the agent
        :return: Its own, or those of all agents
        """
        return self.agents.get(name, AgentConfig(self.algo, self.algo_class, self.policy, self.algo_kwargs))

    def check_agents(self, possible_agents: Sequence[str]) -> None:
        """
        Check that the agents with settings of their own exist.

        :param possible_agents: Names of the agents of the environment
        :raises ConfigError: If one does not
        """
        for name in self.agents:
            if name not in possible_agents:
                raise unknown_setting(f"{self.origins['agent_kwargs']}: agent_kwargs", "agent", name, possible_agents)

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
    eval_env_kwargs: Sequence[str] = (),
    run_folder: Path | None = None,
    overrides: Sequence[tuple[str, dict[str, Any]]] = (),
) -> RunConfig:
    """
    Load, merge and check the settings of a run.

    Later sources override earlier ones: the file's section ``default``, its section of the environment, ``overrides``,
    ``params``, ``env_kwargs``, ``n_timesteps``.

    :param algo: Name of the algorithm, a key of ``names.ALGOS``
    :param env_id: Registered id, ``suite/name`` or ``module:callable`` of the environment
    :param conf_file: YAML file to read instead of ``zoo_configs/<algo>.yml``
    :param params: ``key:value`` pairs of settings
    :param env_kwargs: ``key:value`` pairs of arguments of the environment
    :param n_timesteps: Number of joint steps to train for, or None for the file's
    :param extra_packages: See ``names.resolve``
    :param eval_env_kwargs: ``key:value`` pairs of arguments of the environment of evaluations, which override ``env_kwargs``
    :param run_folder: Folder of the run whose file ``conf_file`` is, if its author may be a stranger, who may write there only
    :param overrides: Further settings as data, each with the place that they come from, for the error message
    :return: The configuration
    :raises ConfigError: For a setting that does not fit. The message names its location, what is allowed and the nearest match
    """
    get_algo(algo)
    make_env = load_env(env_id, "--env", extra_packages)
    path = find_config_file(algo, conf_file)
    sections = read_file(path)
    for name in sections:
        if name != DEFAULT:
            get_env(name, str(path), extra_packages)
    if not sections.keys() & {env_id, DEFAULT}:
        existing = ", ".join(sections) or "none"
        raise ConfigError(f"{path}: has no section {env_id!r} and no section {DEFAULT!r}; it has {existing}.")

    in_file = [
        (Location(f"{path}, section {name}", extra_packages, run_folder), sections[name] or {})
        for name in (DEFAULT, env_id)
        if name in sections
    ]
    given: list[tuple[str, Any]] = [*overrides, ("-params", parse_pairs(params, "-params"))]
    for flag, pairs in (("--env-kwargs", env_kwargs), ("--eval-env-kwargs", eval_env_kwargs)):
        if pairs:
            given.append((flag, {flag[2:].replace("-", "_"): parse_pairs(pairs, flag)}))
    if n_timesteps is not None:
        given.append(("--n-timesteps", {"n_timesteps": n_timesteps}))
    layers = in_file + [(Location(text, extra_packages), layer or {}) for text, layer in given]
    for location, layer in layers:
        if not isinstance(layer, dict):
            raise ConfigError(f"{location.text}: must be a mapping of settings, not {short(layer)}.")
    layers = without_replaced(layers)

    n_leading, policy = len(get_env(env_id, "--env").leading), _last(layers, "policy")[1]
    span_source, span = _last(layers, "memory_span")
    chosen = get_algo(algo, f"{span_source}: memory_span", span)
    agents = {}
    for agent, own in _agent_settings(layers).items():
        own_algo = _beside(own.get("algo", algo), algo, f"{_last(layers, 'agent_kwargs')[0]}: agent_kwargs: {agent}", span)
        agents[agent] = SettingsChecker(own_algo, make_env, n_leading, own.get("policy", policy))
    checker = SettingsChecker(chosen, make_env, n_leading, policy, agents)
    settings: dict[str, Any] = {}
    checked: dict[str, Any] = {}
    origins: dict[str, str] = {}
    # The plain data is merged as well, because config.yml is written from it
    for location, layer in layers:
        checked = _override(checked, checker.check(layer, location))
        settings = _override(settings, layer)
        for name, value in layer.items():
            origins.update(dict.fromkeys([name, *(map(str, value) if isinstance(value, dict) else ())], location.text))
    for key in ("policy", "n_timesteps"):
        if key not in checked:
            raise ConfigError(f"{path}: no {key!r} for {env_id!r}: add it to the section {env_id!r} or {DEFAULT!r}.")
    if checked.get("partners") is not None:
        # As plain data with all paths, so that config.yml does not depend on the working folder nor on what runs there are
        settings["partners"] = checked["partners"]
        location = Location(f"{origins['partners']}: partners", extra_packages)
        checked["partners"] = partners_config(checked["partners"], location)
    config = _to_run_config(algo, env_id, settings, str(path), checker.algo_class, {**checked, **chosen.fixed}, origins)
    adapter = checker.adapter and partial(checker.adapter, **checked.get("adapter_kwargs", {}))
    config = replace(config, adapter=adapter, note=chosen.note)
    _check_episodic(config)
    return config


def find_config_file(algo: str, conf_file: str | None = None) -> Path:
    """
    Return the configuration file to read.

    :param algo: Name of the algorithm
    :param conf_file: File that the user gave, or None
    :return: The given file, otherwise the algorithm's file in the checkout, otherwise the one installed with the package
    :raises ConfigError: If there is none
    """
    if conf_file is not None:
        if not os.path.isfile(conf_file):
            what = f"{conf_file!r} is a folder: name a file in it" if os.path.isdir(conf_file) else f"no file {conf_file!r}"
            raise ConfigError(f"--conf-file: {what}.")
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


def _with_nested(settings: dict[str, Any]) -> list[tuple[str, Any]]:
    """Return settings, and those in the mappings among them, with their values."""
    nested = [pair for value in settings.values() if isinstance(value, dict) for pair in value.items()]
    return [*settings.items(), *nested]


def _speaks_of(message: str, name: str, value: Any) -> bool:
    # Some names of settings are words of every message ("policy"): these must be quoted, or stand before a value
    if re.search(rf"\b{re.escape(name)}\b" + ("" if "_" in name else r"(['`\"=:]| is\b)"), message):
        return True
    # A class that fails names itself, and not the setting that named it
    module, _, last = value.rpartition(".") if isinstance(value, str) else ("", "", "")
    return bool(module) and re.search(rf"\b{re.escape(last)}\b", message) is not None


def _last(layers: Sequence[tuple[Location, dict[str, Any]]], key: str) -> tuple[str, Any]:
    """Return the source that decides a setting, and its value there. An empty text and None if no source has it."""
    found = [(location.text, layer[key]) for location, layer in layers if key in layer]
    return found[-1] if found else ("", None)


def _beside(name: Any, common: str, where: str, span: Any) -> Algo:
    """Return the algorithm of an agent beside those of the algorithm ``common``."""
    algo = get_algo(name, f"{where}: algo", span)
    if algo.adapter != get_algo(common).adapter:
        raise ConfigError(
            f"{where}: {name} and {common} do not learn side by side: one sees more than an agent of its own does."
        )
    return algo


def _agent_settings(layers: Sequence[tuple[Location, dict[str, Any]]]) -> dict[str, dict[str, Any]]:
    """Return the merged settings of single agents, as far as they have the form of settings at all."""
    merged: dict[str, Any] = {}
    for _, layer in layers:
        own = layer.get("agent_kwargs")
        if isinstance(own, dict):
            merged = merge(merged, {agent: each for agent, each in own.items() if isinstance(each, dict)})
    return merged


def _check_episodic(config: RunConfig) -> None:
    # SB3 checks this by an assertion in the first rollout
    for kwargs in (config.algo_kwargs, *(agent.algo_kwargs for agent in config.agents.values())):
        train_freq = kwargs.get("train_freq")
        if isinstance(train_freq, tuple) and train_freq[1] == "episode" and config.n_envs > 1:
            raise ConfigError(
                f"{config.origin('train_freq')}: train_freq: {list(train_freq)} counts episodes, which needs n_envs: 1, not"
                f" {config.n_envs}. Count steps: train_freq: 4."
            )


def _override(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    merged = merge({key: value for key, value in base.items() if not (key in _REPLACED and key in over)}, over)
    if isinstance(over.get("partners"), dict):
        # Other members take the place of those of a lower layer, and do not join them
        merged["partners"] = {**(base.get("partners") or {}), **over["partners"]}
    return merged


def _wrap(env: Any, wrappers: Sequence[tuple[Callable[..., Any], dict[str, Any]]]) -> Any:
    for wrapper, kwargs in wrappers:
        env = wrapper(env, **kwargs)
    return env


def _to_run_config(
    algo: str,
    env_id: str,
    settings: dict[str, Any],
    source: str,
    algo_class: type[BaseAlgorithm],
    checked: dict[str, Any],
    origins: dict[str, str],
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
        observation=observation_arguments(checked),
        callbacks=checked.get("callback", ()),
        algo_kwargs=algo_kwargs,
        eval_env_kwargs=checked.get("eval_env_kwargs", {}),
        agents={
            agent: _agent_config(
                agent, own, AgentConfig(algo, algo_class, checked["policy"], algo_kwargs), origins, checked.get("memory_span")
            )
            for agent, own in checked.get("agent_kwargs", {}).items()
        },
        partners=checked.get("partners"),
        origins=origins,
    )


def _agent_config(
    agent: str, own: dict[str, Any], common: AgentConfig, origins: dict[str, str], memory_span: str | None
) -> AgentConfig:
    name = own.get("algo", common.algo)
    algo = get_algo(name, memory_span=memory_span)
    algo_class, policy = algo.load(), own.get("policy", common.policy)
    if policy not in algo_class.policy_aliases:
        raise ConfigError(
            f"{origins['agent_kwargs']}: agent_kwargs: {agent}: {name} has no {policy!r}: give this agent a policy of its own."
            f" Allowed: {', '.join(algo_class.policy_aliases)}."
        )
    kwargs = {key: value for key, value in own.items() if key not in ("algo", "policy")}
    # The settings of all agents are arguments of another class, where even the same name may mean something else (n_steps)
    if algo_class is common.algo_class:
        shared = {key: value for key, value in common.algo_kwargs.items() if key not in get_algo(common.algo).fixed}
        kwargs = merge(shared, kwargs)
    return AgentConfig(name, algo_class, policy, {**kwargs, **algo.fixed})
