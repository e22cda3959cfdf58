"""
The description of a study: a YAML file that says which algorithms are compared in which environments, with which seeds.

It is data like every configuration here. What each key means is in docs/studies.md.
"""

import itertools
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from sb3_belief.study.yaml_rows import Section, read_sections
from sb3_belief.zoo.config import RunConfig, load_config
from sb3_belief.zoo.durations import DURATION, seconds_of
from sb3_belief.zoo.errors import ConfigError, short
from sb3_belief.zoo.names import ALGOS, load_env
from sb3_belief.zoo.run_folder import folder_name

_MOST, _MOST_SEED, _MOST_SEEDS, _MOST_JOBS = 10**15, 2**31 - 1, 10_000, 1024
_KEYS = (
    *("name", "environments", "algorithms", "seeds", "n_timesteps", "evaluation"),
    *("baseline", "ablations", "exclude", "train", "seed_env_kwarg"),
)
_EVALUATION = ("every", "episodes", "copies", "final_episodes", "online")
#: The options of ``train`` that a study may set, without those that it sets itself
TRAIN_KEYS = (
    *("save_every", "save_freq", "device", "num_threads", "jobs", "on_nan"),
    *("vec_env", "step_timeout", "restart_workers"),
)
_NAME = re.compile(r"\w[\w.+-]{0,99}")


@dataclass(frozen=True)
class Arm:
    """
    An algorithm with its settings, as a study compares it.

    :param name: Its label
    :param algo: Name of the algorithm
    :param params: Settings that override those of the configuration file
    :param where: File, line and key of the settings
    """

    name: str
    algo: str
    params: dict[str, Any]
    where: str


@dataclass(frozen=True)
class StudyEnvironment:
    """
    An environment of a study.

    :param env_id: Its id
    :param overrides: Settings of all algorithms in this environment, which override those of the configuration file
    :param where: File, line and key of the settings
    """

    env_id: str
    overrides: dict[str, Any]
    where: str


@dataclass(frozen=True)
class EvaluationPlan:
    """
    When and how long teams are evaluated.

    :param every: Joint steps between evaluations during the training
    :param episodes: Episodes of each of them
    :param copies: Environment copies in which evaluations are played
    :param final_episodes: Episodes of each of the final evaluations
    :param online: Whether the episodes of the training count instead, as they were played, the last ones as final ones. It is
        for games in which others change while one learns, so that an evaluation apart would not meet those of the moment
    """

    every: int = 25_000
    episodes: int = 32
    copies: int = 32
    final_episodes: int = 320
    online: bool = False


@dataclass(frozen=True)
class Study:
    """
    Description of a study, whose form has been checked.

    :param name: Its name, that of its folder
    :param source: The file
    :param places: The environments by id
    :param arms: The algorithms with their settings by label
    :param seeds: Seeds of the runs
    :param n_timesteps: Joint steps of every run, or None for those of each configuration
    :param evaluation: When and how long teams are evaluated
    :param baseline: Label of what the others are compared with, or None
    :param ablations: Labels by title of a panel
    :param excluded: Pairs of a label and an environment that are left out
    :param train: Options of ``train``
    :param seed_env_kwarg: Argument of the environments that gets the seed of the run, or None. An environment that draws
        others of its own from a seed that is an argument would otherwise draw the same ones in all runs
    """

    name: str
    source: str
    places: dict[str, StudyEnvironment]
    arms: dict[str, Arm]
    seeds: tuple[int, ...]
    n_timesteps: int | None = None
    evaluation: EvaluationPlan = field(default_factory=EvaluationPlan)
    baseline: str | None = None
    ablations: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    excluded: frozenset[tuple[str, str]] = frozenset()
    train: Mapping[str, Any] = field(default_factory=dict)
    seed_env_kwarg: str | None = None

    def pairs(self) -> list[tuple[str, str]]:
        """Return the pairs of a label and an environment that are trained, each with every seed."""
        return [(arm, env_id) for env_id in self.places for arm in self.arms if (arm, env_id) not in self.excluded]

    def overrides(self, arm: str, env_id: str) -> list[tuple[str, dict[str, Any]]]:
        """
        Return what overrides the settings of the configuration file, as ``load_config`` takes it.

        :param arm: Label of the algorithm
        :param env_id: Id of the environment
        :return: The number of joint steps, then what the environment and then what the algorithm has of its own
        """
        steps = [] if self.n_timesteps is None else [(f"{self.source}: n_timesteps", {"n_timesteps": self.n_timesteps})]
        place, chosen = self.places[env_id], self.arms[arm]
        return [*steps, (place.where, place.overrides), (f"{chosen.where}: params", chosen.params)]

    def config(self, arm: str, env_id: str, extra_packages: tuple[str, ...] = ()) -> RunConfig:
        """
        Return the checked configuration of the runs of a pair.

        :param arm: Label of the algorithm
        :param env_id: Id of the environment
        :param extra_packages: See ``names.resolve``
        :return: The configuration
        :raises ConfigError: For a setting that does not fit
        """
        place = self.places[env_id]
        load_env(env_id, place.where.removesuffix(f": {env_id}"), extra_packages)
        config = load_config(self.arms[arm].algo, env_id, extra_packages=extra_packages, overrides=self.overrides(arm, env_id))
        taken = config.env_kwargs.keys() | config.eval_env_kwargs.keys()
        if self.seed_env_kwarg in taken:
            raise ConfigError(
                f"{self.source}: seed_env_kwarg: {self.seed_env_kwarg!r} is set by env_kwargs of {arm!r} in {env_id!r}"
                " already: leave one of them out."
            )
        return config

    def seeded(self, config: RunConfig, seed: int) -> RunConfig:
        """
        Return the configuration of the run with a seed.

        :param config: That of its pair
        :param seed: Seed of the run
        :return: The configuration, in which the environment gets the seed too if the study says so
        """
        if self.seed_env_kwarg is None:
            return config
        env_kwargs = {**config.env_kwargs, self.seed_env_kwarg: seed}
        return replace(
            config,
            env_kwargs=env_kwargs,
            settings={**config.settings, "env_kwargs": env_kwargs},
            origins={**config.origins, self.seed_env_kwarg: f"{self.source}: seed_env_kwarg"},
        )

    def to_data(self) -> dict[str, Any]:
        """
        Return the description as plain data, which reads as a study file again.

        :return: The keys of the file with what was left out there
        """
        unused = ("episodes", "copies") if self.evaluation.online else ("online",)
        evaluation = {name: getattr(self.evaluation, name) for name in _EVALUATION if name not in unused}
        data: dict[str, Any] = {
            "name": self.name,
            "environments": {env_id: place.overrides for env_id, place in self.places.items()},
            "algorithms": {name: {"algo": arm.algo, "params": arm.params} for name, arm in self.arms.items()},
            "seeds": list(self.seeds),
            "n_timesteps": self.n_timesteps,
            "evaluation": evaluation,
            "baseline": self.baseline,
            "ablations": {title: list(arms) for title, arms in self.ablations.items()},
            "exclude": [{"arm": arm, "environment": env_id} for arm, env_id in sorted(self.excluded)],
            "train": dict(self.train),
            "seed_env_kwarg": self.seed_env_kwarg,
        }
        return {key: value for key, value in data.items() if value not in (None, {}, [])}


def load_study(path: Path) -> Study:
    """
    Read the file of a study and check its form. The settings of its runs are checked by ``Study.config``.

    :param path: The file
    :return: The study
    :raises ConfigError: If anything does not fit. The message has file and line, what is allowed and the nearest match
    """
    top = read_sections(path).mapping("a study", _KEYS, required=("environments", "algorithms", "seeds"))
    name = top["name"].value if "name" in top else path.stem
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        place = top["name"] if "name" in top else top
        raise place.error(f"name: {short(name)} cannot be the name of a folder: letters, digits and any of . _ + - only.")
    arms = _arms(top["algorithms"])
    places = _places(top["environments"])
    study = Study(
        name=name,
        source=str(path),
        places=places,
        arms=arms,
        seeds=_seeds(top["seeds"]),
        n_timesteps=top["n_timesteps"].number(1, _MOST, "joint steps") if "n_timesteps" in top else None,
        evaluation=_evaluation(top["evaluation"]) if "evaluation" in top else EvaluationPlan(),
        baseline=top["baseline"].chosen("algorithm of this study", arms) if "baseline" in top else None,
        ablations=_ablations(top["ablations"], arms) if "ablations" in top else {},
        excluded=_excluded(top["exclude"], arms, places) if "exclude" in top else frozenset(),
        train=_train_options(top["train"]) if "train" in top else {},
        seed_env_kwarg=_argument(top["seed_env_kwarg"]) if "seed_env_kwarg" in top else None,
    )
    if not study.pairs():
        raise top.error("exclude leaves nothing to train.")
    return study


def _arms(section: Section) -> dict[str, Arm]:
    arms: dict[str, Arm] = {}
    for name in section.mapping("a mapping of labels to {algo: <name>, params: {...}}").value:
        own = section[name].or_empty()
        if not _NAME.fullmatch(name):
            raise own.error("a label names a folder: letters, digits and any of . _ + - only.")
        own.mapping("{algo: <name>, params: {...}}", ("algo", "params"))
        if "algo" not in own and name not in ALGOS:
            raise own.error(f"has no key 'algo', and {name!r} is no algorithm: write algo: <one of {', '.join(ALGOS)}>.")
        algo = own["algo"].chosen("algorithm", ALGOS) if "algo" in own else name
        params = own["params"].mapping("a mapping of settings").value if "params" in own else {}
        arms[name] = Arm(name, algo, params, own.where)
    if not arms:
        raise section.error("must have at least one algorithm.")
    return arms


def _places(section: Section) -> dict[str, StudyEnvironment]:
    places: dict[str, StudyEnvironment] = {}
    pairs: list[tuple[Any, Section, Any]]
    if isinstance(section.value, list):
        pairs = [(each.value, each, {}) for each in section.items("ids of environments")]
    else:
        section.mapping("a list of ids, or a mapping of ids to settings")
        pairs = [(env_id, section[env_id], section.value[env_id] or {}) for env_id in section.value]
    folders: dict[str, str] = {}
    for env_id, own, overrides in pairs:
        if not isinstance(env_id, str) or not env_id.strip():
            raise own.error(f"must be the id of an environment, not {short(env_id)}.")
        if not isinstance(overrides, dict):
            raise own.error(f"must be a mapping of settings such as env_kwargs, not {short(overrides)}.")
        if env_id in places:
            raise own.error(f"{env_id!r} is there twice.")
        # Each environment has a folder, whose name cannot tell these apart
        same = folders.setdefault(folder_name(env_id).lower(), env_id)
        if same != env_id:
            raise own.error(f"{env_id!r} and {same!r} would have the same folder: make them two studies.")
        where = own.where if env_id in own.keys else f"{own.where}: {env_id}"
        places[env_id] = StudyEnvironment(env_id, overrides, where)
    if not places:
        raise section.error("must have at least one environment.")
    return places


def _evaluation(section: Section) -> EvaluationPlan:
    chosen: dict[str, Any] = {}
    for key in section.mapping("settings of evaluations", _EVALUATION).value:
        own = section[key]
        if key == "online":
            if not isinstance(own.value, bool):
                raise own.error(f"must be true or false, not {short(own.value)}.")
            chosen[key] = own.value
        else:
            chosen[key] = own.number(1, _MOST, key)
    if chosen.get("online") and (unused := chosen.keys() & {"episodes", "copies"}):
        name = sorted(unused)[0]
        raise section[name].error(
            "has no use with online: true, with which nothing is played beside the training: leave it out."
        )
    return EvaluationPlan(**chosen)


def _seeds(section: Section) -> tuple[int, ...]:
    if not isinstance(section.value, list):
        return tuple(range(section.number(1, _MOST_SEEDS, "seeds (or a list of them)")))
    seeds = [each.number(0, _MOST_SEED, "a seed") for each in section.items("seeds")]
    if not seeds or len(set(seeds)) < len(seeds):
        raise section.error("must have at least one seed." if not seeds else f"has a seed twice: {short(section.value)}.")
    return tuple(seeds)


def _ablations(section: Section, arms: Mapping[str, Arm]) -> dict[str, tuple[str, ...]]:
    panels = section.mapping("a mapping of titles to lists of labels").value
    return {
        title: tuple(each.chosen("algorithm of this study", arms) for each in section[title].items("labels"))
        for title in panels
    }


def _excluded(section: Section, arms: Mapping[str, Arm], places: Mapping[str, StudyEnvironment]) -> frozenset[tuple[str, str]]:
    pairs = set()
    for each in section.items("{arm: <label>, environment: <id>}"):
        keys = ("arm", "environment")
        each.mapping("{arm: <label>, environment: <id>}", keys, keys)
        labels = _one_or_more(each["arm"], "algorithm of this study", arms)
        pairs |= set(itertools.product(labels, _one_or_more(each["environment"], "environment of this study", places)))
    return frozenset(pairs)


def _one_or_more(section: Section, what: str, known: Mapping[str, Any]) -> list[str]:
    """Return the names that stand alone or in a list."""
    return [each.chosen(what, known) for each in (section.items("names") if isinstance(section.value, list) else [section])]


def _train_options(section: Section) -> dict[str, Any]:
    section.mapping("options of train", TRAIN_KEYS)
    options: dict[str, Any] = {}
    for key in section.value:
        own = section[key]
        if key in ("save_every", "step_timeout"):
            options[key] = _duration(own)
        elif key in ("save_freq", "num_threads"):
            most = _MOST if key == "save_freq" else _MOST_JOBS
            options[key] = -1 if own.value == -1 else own.number(1, most, key)
        elif key in ("jobs", "restart_workers"):
            options[key] = own.number(int(key == "jobs"), _MOST_JOBS, key)
        elif key == "device":
            if not isinstance(own.value, str) or not own.value.strip():
                raise own.error(f"must be auto, cpu, cuda, ..., not {short(own.value)}.")
            options[key] = own.value
        else:
            options[key] = own.chosen("value", {"on_nan": ("raise", "skip"), "vec_env": ("dummy", "subproc")}[key])
    if options.get("step_timeout", -1) > 0 and options.get("vec_env") != "subproc":
        raise section["step_timeout"].error(
            "an environment in the run's process cannot be ended while it hangs: vec_env: subproc."
        )
    return options


def _argument(section: Section) -> str:
    if not isinstance(section.value, str) or not section.value.isidentifier():
        raise section.error(f"must be the name of an argument of the environments, not {short(section.value)}.")
    return section.value


def _duration(section: Section) -> float:
    """Return a number of seconds, which may be written with a unit; -1 for never."""
    try:
        if isinstance(section.value, int | float | str) and not isinstance(section.value, bool):
            return seconds_of(str(section.value))
    except ValueError:
        pass
    raise section.error(f"must be {DURATION}, not {short(section.value)}.")
