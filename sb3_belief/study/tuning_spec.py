"""What a tuning is: the checked content of its YAML file."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from sb3_belief.study.tuning_space import SearchSpace, parse_space
from sb3_belief.zoo.config import RunConfig, load_config
from sb3_belief.zoo.errors import ConfigError, short, unknown_setting
from sb3_belief.zoo.train_options import TrainOptions
from sb3_belief.zoo.yaml_data import merge, read_file

#: Seed of the first run of a trial, far from those of studies: what is reported must not be what settings were chosen on
FIRST_SEED = 1000
_OBJECTIVES = ("return", "success")
_SAMPLERS, _PRUNERS = ("tpe", "random"), ("median", "none")
_EVALUATION = {"every": 25_000, "episodes": 32, "copies": 32}
_SAMPLER = {"name": "tpe", "seed": 0, "startup_trials": 10}
_PRUNER = {"name": "median", "startup_trials": 5, "warmup_evaluations": 1}
# Options of ``TrainOptions`` that a tuning may set, and their defaults in it
_TRAIN = TrainOptions.defaults(("device", "num_threads", "jobs", "on_nan", "vec_env", "step_timeout", "restart_workers"))


@dataclass(frozen=True)
class TuningSpec:
    """
    Checked specification of a tuning.

    :param name: Its name, which is that of its folder
    :param algo: Name of the algorithm
    :param env: Id of the environment
    :param search: The searched settings as plain data
    :param params: Settings that are the same in all trials, nested
    :param conf_file: YAML file instead of ``zoo_configs/<algo>.yml``
    :param n_timesteps: Joint steps of a run; None for those of the YAML file
    :param n_trials: Number of trials
    :param seeds: Seeds of the runs of each trial
    :param objective: ``"return"`` or ``"success"``, the mean of which over the last evaluations is maximised
    :param last_evaluations: Number of evaluations, the last ones of a run, whose mean counts
    :param evaluation: ``every`` so many joint steps, number of ``episodes`` and of environment ``copies``
    :param sampler: ``name``, ``seed``, and number of ``startup_trials``, which are drawn at random
    :param pruner: ``name``, number of ``startup_trials``, which are not pruned, and of ``warmup_evaluations``, at
        which none is
    :param train: Options of the runs
    """

    name: str
    algo: str
    env: str
    search: dict[str, Any]
    params: dict[str, Any] = field(default_factory=dict)
    conf_file: str | None = None
    n_timesteps: int | None = None
    n_trials: int = 50
    seeds: tuple[int, ...] = (FIRST_SEED,)
    objective: str = "return"
    last_evaluations: int = 1
    evaluation: dict[str, int] = field(default_factory=lambda: dict(_EVALUATION))
    sampler: dict[str, Any] = field(default_factory=lambda: dict(_SAMPLER))
    pruner: dict[str, Any] = field(default_factory=lambda: dict(_PRUNER))
    train: dict[str, Any] = field(default_factory=lambda: dict(_TRAIN))
    source: str = field(default="", compare=False)

    @property
    def space(self) -> SearchSpace:
        """The search space."""
        return parse_space(self.search, f"{self.source}: search")

    def to_yaml(self) -> str:
        """Return the specification as a file that reads as the same one."""
        data = {key: value for key, value in dataclasses.asdict(self).items() if key != "source" and value is not None}
        return yaml.safe_dump({**data, "seeds": list(self.seeds)}, sort_keys=False)

    def config(
        self, drawn: Mapping[str, Any], extra_packages: tuple[str, ...] = (), with_n_timesteps: bool = True
    ) -> RunConfig:
        """
        Return the configuration of a trial's runs.

        :param drawn: What Optuna drew, by the dotted names of the searched settings
        :param extra_packages: See ``names.resolve``
        :param with_n_timesteps: Whether it has the length of this tuning's runs. Otherwise that of the YAML file
        :return: The configuration
        :raises ConfigError: For settings that do not fit
        """
        space = self.space
        return self._load(
            {name: space[name].setting(value) for name, value in drawn.items()}, extra_packages, with_n_timesteps
        )

    def check(self, extra_packages: tuple[str, ...] = ()) -> None:
        """
        Check that all that can be drawn is allowed, each setting by itself, and that runs are long enough.

        :param extra_packages: See ``names.resolve``
        :raises ConfigError: If not. The message says what was given, and what is allowed
        """
        space = self.space
        first = {name: each.extremes()[0] for name, each in space.items()}
        fixed = self._load({}, extra_packages, True)
        for name, each in space.items():
            for value in each.extremes():
                self._load({**first, name: value}, extra_packages, True)
        n_timesteps = self.n_timesteps or fixed.n_timesteps
        if self.evaluation["every"] > n_timesteps:
            raise ConfigError(
                f"{self.source}: evaluation: every: {self.evaluation['every']} joint steps is more than a run has"
                f" ({n_timesteps}), so that no trial would be evaluated: name fewer."
            )
        n_evaluations = n_timesteps // self.evaluation["every"]
        if self.last_evaluations > n_evaluations:
            raise ConfigError(
                f"{self.source}: last_evaluations: a run of {n_timesteps} joint steps has {n_evaluations} evaluations, not"
                f" {self.last_evaluations}: name at most so many, or a smaller evaluation: {{every: ...}}."
            )

    def _load(self, searched: Mapping[str, Any], extra_packages: tuple[str, ...], with_n_timesteps: bool) -> RunConfig:
        settings = self.params
        for name, value in searched.items():
            for key in reversed(name.split(".")):
                value = {key: value}
            settings = merge(settings, value)
        try:
            return load_config(
                self.algo,
                self.env,
                self.conf_file,
                params=[f"{name}:{json.dumps(value)}" for name, value in settings.items()],
                n_timesteps=self.n_timesteps if with_n_timesteps else None,
                extra_packages=extra_packages,
            )
        except ConfigError as error:
            # The settings that were given here reach the configuration as if by the flags of a training
            keys = {"-params": "search" if searched else "params", "--env": "env", "--algo": "algo"}
            keys |= {"--conf-file": "conf_file", "--n-timesteps": "n_timesteps"}
            flag, colon, rest = str(error).partition(": ")
            if flag in keys and colon:
                raise ConfigError(f"{self.source}: {keys[flag]}: {rest}") from None
            raise


def load_tuning(path: str | Path) -> TuningSpec:
    """
    Read the specification of a tuning.

    :param path: YAML file
    :return: The specification, of which ``check`` has not yet been called
    :raises ConfigError: For what is no specification. The message names the file and the key
    """
    file = Path(path)
    data = read_file(file)
    names = [each.name for each in dataclasses.fields(TuningSpec) if each.name != "source"]
    for key in data:
        if key not in names:
            raise unknown_setting(str(file), "key", key, names)
    _check_names(data, file)
    name = data.get("name", file.stem)
    if name != Path(name).name or name.startswith("."):
        raise ConfigError(
            f"{file}: name: {short(name)} is to be the name of a folder: no separators, and no dot at its start."
        )
    for key in ("n_timesteps", "n_trials", "last_evaluations"):
        if key in data:
            data[key] = _count(data[key], f"{file}: {key}")
    if data.get("objective", "return") not in _OBJECTIVES:
        raise unknown_setting(f"{file}: objective", "objective", data["objective"], _OBJECTIVES)
    _check_settings(data, file)
    groups = {
        key: _group(data.get(key, {}), defaults, f"{file}: {key}")
        for key, defaults in (("evaluation", _EVALUATION), ("sampler", _SAMPLER), ("pruner", _PRUNER), ("train", _TRAIN))
    }
    for key, allowed in (("sampler", _SAMPLERS), ("pruner", _PRUNERS)):
        if groups[key]["name"] not in allowed:
            raise unknown_setting(f"{file}: {key}: name", key, groups[key]["name"], allowed)
    for key, value in groups["evaluation"].items():
        _count(value, f"{file}: evaluation: {key}")
    seeds = _seeds(data.get("seeds", [FIRST_SEED]), f"{file}: seeds")
    return TuningSpec(**{**data, **groups, "name": name, "seeds": seeds, "source": str(file)})


def _check_names(data: dict[str, Any], file: Path) -> None:
    for key, example in (("algo", "belief_ppo"), ("env", "traffic-junction-medium"), ("search", "{learning_rate: ...}")):
        if key not in data:
            raise ConfigError(f"{file}: has no {key!r}: add it, as in {key}: {example}.")
    for key in ("name", "algo", "env", "conf_file"):
        if key in data and not (isinstance(data[key], str) and data[key].strip()):
            raise ConfigError(f"{file}: {key}: must be a name, not {short(data[key])}.")


def _check_settings(data: dict[str, Any], file: Path) -> None:
    params = data.get("params", {})
    if not isinstance(params, dict):
        raise ConfigError(f"{file}: params: must be a mapping of settings, not {short(params)}.")
    try:
        json.dumps(params)
    except TypeError as error:
        raise ConfigError(f"{file}: params: only numbers, texts, lists and mappings are settings: {error}.") from None
    parse_space(data["search"], f"{file}: search")
    for searched in data["search"]:
        if _has(params, searched.split(".")):
            raise ConfigError(f"{file}: {searched!r} is searched, and set in params as well: keep one of them.")


def _group(given: Any, defaults: Mapping[str, Any], where: str) -> dict[str, Any]:
    if not isinstance(given, dict):
        raise ConfigError(f"{where}: must be a mapping with some of {', '.join(defaults)}, not {short(given)}.")
    for key, value in given.items():
        if key not in defaults:
            raise unknown_setting(where, "key", key, defaults)
        default = defaults[key]
        allowed = int | float if isinstance(default, float) else type(default)
        if not isinstance(value, allowed) or isinstance(value, bool):
            kind = "a text" if isinstance(default, str) else "a number" if isinstance(default, float) else "an integer"
            raise ConfigError(f"{where}: {key}: must be {kind}, not {short(value)}.")
        if isinstance(default, int) and default >= 0 and value < 0:
            raise ConfigError(f"{where}: {key}: must not be negative, as {value} is.")
    return {**defaults, **given}


def _count(value: Any, where: str) -> int:
    if not isinstance(value, int | float) or isinstance(value, bool) or value % 1 != 0 or value < 1:
        raise ConfigError(f"{where}: must be an integer of at least 1, not {short(value)}.")
    return int(value)


def _seeds(given: Any, where: str) -> tuple[int, ...]:
    if isinstance(given, int) and not isinstance(given, bool) and given >= 1:
        return tuple(range(FIRST_SEED, FIRST_SEED + given))
    allowed: Sequence[Any] = given if isinstance(given, list) else []
    fits = all(isinstance(each, int) and not isinstance(each, bool) and 0 <= each < 2**31 for each in allowed)
    if not allowed or not fits or len(set(allowed)) != len(allowed):
        raise ConfigError(
            f"{where}: must be a list of different seeds from 0 to 2**31 - 1, or how many of them ({FIRST_SEED},"
            f" {FIRST_SEED + 1}, ...), not {short(given)}."
        )
    return tuple(allowed)


def _has(settings: Any, keys: Sequence[str]) -> bool:
    """Return whether settings contain a nested one, or have no mapping where it would be."""
    for key in keys:
        if not isinstance(settings, dict):
            return True
        if key not in settings:
            return False
        settings = settings[key]
    return True
