"""What is checked before a study writes anything: every cell's settings, every environment, what it needs installed."""

import warnings
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from sb3_belief.envs.suites import SUITES
from sb3_belief.study.specification import Study
from sb3_belief.team import TeamVecEnv
from sb3_belief.team.agent_models import env_seed
from sb3_belief.zoo.config import RunConfig, find_config_file, load_config
from sb3_belief.zoo.errors import ConfigError, cause
from sb3_belief.zoo.preflight import (
    agent_without_masks,
    check_copies,
    check_device,
    check_eval_env,
    check_folder,
    check_memory,
    check_optimizers,
    check_step,
)
from sb3_belief.zoo.train import make_env, make_team
from sb3_belief.zoo.train_options import TrainOptions
from sb3_belief.zoo.yaml_data import read_file

# In place of an environment that is not installed. No configuration file has a section for it
_STAND_IN = "sb3_belief.study.stand_in:StandIn"
# Settings of which an environment is made, and those that only it can check
_MADE_OF = ("env_kwargs", "env_wrapper", "observe_last", "observe_window", "memory_span", "partners")
_OF_ENV = (*_MADE_OF, "eval_env_kwargs", "agent_kwargs")
# Settings of which a team's environment is made
_OBSERVED = (*_MADE_OF, "visibility", "adapter_kwargs")
# A team of agents with rollouts of one step needs two copies
_COPIES = 2


@dataclass(frozen=True)
class CheckedStudy:
    """
    A study whose cells have been checked.

    :param study: The study
    :param configs: Configuration of each pair of a label and an environment
    :param missing: Why environments could not be checked, by id
    """

    study: Study
    configs: dict[tuple[str, str], RunConfig]
    missing: dict[str, str]

    def describe(self) -> str:
        """Return the matrix of runs, a line for each pair, under a line for the study."""
        study, evaluation = self.study, self.study.evaluation
        seeds = len(study.seeds)
        steps = sum(config.n_timesteps for config in self.configs.values()) * seeds
        lines = [
            f"Study {study.name}: {_count(len(study.arms), 'algorithm')}, {_count(len(study.places), 'environment')},"
            f" {_count(seeds, 'seed')}: {_count(len(self.configs) * seeds, 'run')} of {steps:,} joint steps together."
        ]
        width = max(map(len, study.arms))
        for env_id in study.places:
            lines.append(f"{env_id}")
            for arm in study.arms:
                if (arm, env_id) in self.configs:
                    config = self.configs[arm, env_id]
                    played = (
                        f"{config.n_timesteps // evaluation.every} x {evaluation.episodes} episodes while training,"
                        f" 4 x {evaluation.final_episodes} at the end"
                    )
                    if evaluation.online:
                        played = f"whose own episodes count, the last {evaluation.final_episodes} at the end"
                    runs = f"{_count(seeds, 'run')} of {config.n_timesteps:,} joint steps"
                    note = f" ({config.note})" if config.note else ""
                    lines.append(f"  {arm:<{width}}  {config.algo}{note}: {runs}, {played}")
        return "\n".join(lines)


def _count(number: int, what: str) -> str:
    return f"{number:,} {what}{'' if number == 1 else 's'}"


def check_study(
    study: Study, folder: Path, extra_packages: tuple[str, ...] = (), engine: str = "local", dry_run: bool = False
) -> CheckedStudy:
    """
    Check that all runs of a study can start: what is wrong in the last of them is said before the first.

    :param study: The study
    :param folder: Its folder, in which must be room to write
    :param extra_packages: See ``names.resolve``
    :param engine: ``"local"`` or ``"ray"``
    :param dry_run: Whether environments may be missing, whose settings are then checked as far as possible
    :return: The study with the configurations of its runs
    :raises ConfigError: If anything does not fit. Nothing has been written then
    """
    check_extras(engine)
    check_folder(folder, "-f")
    if engine == "local":
        try:
            check_device(study.train.get("device", "auto"))
        except ConfigError as error:
            raise ConfigError(f"{study.source}: train: {str(error).removeprefix('--device: ')}") from None
    missing = {env_id: why for env_id in study.places if (why := _why_missing(env_id)) is not None} if dry_run else {}
    configs = {}
    for arm, env_id in study.pairs():
        load = _config_without_env if env_id in missing else Study.config
        configs[arm, env_id] = _check_length(study, arm, load(study, arm, env_id, extra_packages))
    for env_id in study.places:
        if env_id not in missing:
            _check_environment(study, {arm: each for (arm, place), each in configs.items() if place == env_id})
    return CheckedStudy(study, configs, missing)


def check_extras(engine: str = "local") -> None:
    """
    Check that the packages are installed that a study needs beyond a training.

    :param engine: ``"local"`` or ``"ray"``
    :raises ConfigError: If one is not
    """
    if find_spec("pyarrow") is None:
        raise ConfigError("A study's tables of episodes need pyarrow: pip install 'sb3-belief[study]'.")
    if engine == "ray" and find_spec("ray") is None:
        raise ConfigError("--engine ray needs ray: pip install 'sb3-belief[ray]'.")


def _why_missing(env_id: str) -> str | None:
    """Return what must be installed for an environment of a suite, or None if nothing is."""
    suite, _, name = env_id.partition("/")
    if suite not in SUITES:
        return None
    lacking, install = SUITES[suite].missing(), SUITES[suite].install
    if not lacking:
        lacking, install = SUITES[suite].missing_for(name)
    return f"{env_id} needs {' and '.join(lacking)}, which is not installed: {install}" if lacking else None


def _config_without_env(study: Study, arm: str, env_id: str, extra_packages: tuple[str, ...]) -> RunConfig:
    """Check the settings of a pair whose environment is not installed, without those that are the environment's."""
    algo = study.arms[arm].algo
    path = find_config_file(algo)
    layers = [(f"{path}, section {env_id}", read_file(path).get(env_id) or {}), *study.overrides(arm, env_id)]
    kept = [(where, {key: value for key, value in layer.items() if key not in _OF_ENV}) for where, layer in layers]
    config = load_config(algo, _STAND_IN, extra_packages=extra_packages, overrides=kept)
    with closing(make_env(replace(config, env_kwargs={}, wrapper=None), _COPIES, 0)) as env:
        _try_team(config, env)
    return replace(config, env_id=env_id)


def _check_length(study: Study, arm: str, config: RunConfig) -> RunConfig:
    every = study.evaluation.every
    if every > config.n_timesteps:
        raise ConfigError(
            f"{study.source}: evaluation: every: {every:,} joint steps are more than the {config.n_timesteps:,} of {arm!r} in"
            f" {config.env_id!r}, which would never be evaluated: use fewer."
        )
    return config


def _check_environment(study: Study, configs: dict[str, RunConfig]) -> None:
    """Make the environments of some runs, once for each kind that there is, and try whether their teams can be in them."""
    tried: list[tuple[Any, TeamVecEnv]] = []
    seed = env_seed(study.seeds[0])
    with ExitStack() as stack:
        for arm, unseeded in configs.items():
            config, where = study.seeded(unseeded, study.seeds[0]), study.arms[arm].where
            check_copies(config.n_envs, study.train.get("vec_env", "dummy"), config.origin("n_envs"))
            check_copies(study.evaluation.copies, "dummy", f"{study.source}: evaluation: copies")
            check_optimizers(config, "cpu")
            # A central learner's is another one, whatever it observes
            adapter = getattr(config.adapter, "func", None)
            kind = adapter, {name: config.settings.get(name) for name in _OBSERVED}
            found = [env for other, env in tried if other == kind]
            env = found[0] if found else _made_environment(config, seed, stack)
            if not found:
                tried.append((kind, env))
            config.check_agents(env.possible_agents)
            check_memory(config, env)
            _check_masks(config, env, where)
            if config.eval_env_kwargs:
                evaluated = replace(config, env_kwargs={**config.env_kwargs, **config.eval_env_kwargs})
                check_eval_env(config, env, _made_environment(evaluated, seed, stack))
            _try_team(config, env)


def _try_team(config: RunConfig, env: TeamVecEnv) -> None:
    with warnings.catch_warnings():
        # SB3 warns of sizes that only fit the run's own number of copies
        warnings.simplefilter("ignore")
        make_team(config, TrainOptions(verbose=0, device="cpu"), env, 0)


def _made_environment(config: RunConfig, seed: int, stack: ExitStack) -> TeamVecEnv:
    env = make_env(config, _COPIES, seed)
    stack.callback(env.close)
    if config.wrapper is not None:
        check_step(config, env)
    try:
        env.reset()
    except Exception as error:
        raise ConfigError(f"{config.origin()}: {config.env_id} cannot be reset: {cause(error)}") from error
    return env


def _check_masks(config: RunConfig, env: TeamVecEnv, where: str) -> None:
    agent = agent_without_masks(config, env)
    if agent is not None:
        name = config.agent(agent).algo
        raise ConfigError(
            f"{where}: {name} needs action masks, and {config.env_id} gives {agent!r} none: use"
            f" {name.replace('maskable_', '')}."
        )
