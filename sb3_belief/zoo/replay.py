"""A saved team in the environment of its run, for the commands that replay it."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from stable_baselines3.common.utils import set_random_seed

from sb3_belief.common.safe_files.trust import Trust
from sb3_belief.envs.registry import make_parallel_env, spec
from sb3_belief.team import Team, TeamVecEnv, make_team_env
from sb3_belief.team.checkpoint import read_team
from sb3_belief.vec_env.observe_last import with_last_step
from sb3_belief.zoo.checks import Location, accepted_arguments, check_call
from sb3_belief.zoo.config import load_config
from sb3_belief.zoo.errors import ConfigError, cause
from sb3_belief.zoo.names import get_env, load_env
from sb3_belief.zoo.partners import PartnersConfig, check_partners, partners_config, partners_of_flag
from sb3_belief.zoo.run_folder import CONFIG, RECORD, check_record, run_of
from sb3_belief.zoo.yaml_data import parse_pairs


@dataclass(frozen=True)
class ShownTeam:
    """
    A saved team, and how it is loaded.

    :param run: Folder of a run, or zip of a team
    :param env: Id of the environment, for the zip of a team that is not in the folder of a run. None for that of the run
    :param env_kwargs: ``key:value`` pairs of arguments of the environment, which override those of the run
    :param extra_packages: See ``names.resolve`` and ``Team.load`` (``allow_packages``)
    :param trust: Whether to load the team, and what its run's folder names, even if that could run any code
    :param device: Device of all models: ``"auto"``, ``"cpu"``, ``"cuda"``, ...
    :param partners: Folder of a run, zip or YAML file of the partners beside whom the team plays (see ``partners_of_flag``);
        None for those of its run
    """

    run: str
    env: str | None = None
    env_kwargs: tuple[str, ...] = ()
    extra_packages: tuple[str, ...] = ()
    trust: bool = False
    device: str = "auto"
    partners: str | None = None


@dataclass(frozen=True)
class ShownEnvironment:
    """
    The environment of a replay.

    :param env_id: Its id
    :param env_kwargs: Its arguments
    :param wrapper: Argument of ``make_team_env``
    :param frame_rate: Frames per second
    :param observation: Further arguments of it: what agents observe besides
    :param partners: The agents that are not of the team; None if all are
    :param visibility: Argument of ``make_team_env``: what agents see of the others is what they observe, and remember
    :param adapter: Makes of the agents' environment that of a central learner; None for a team of agents
    """

    env_id: str
    env_kwargs: dict[str, Any]
    wrapper: Callable[[Any], Any] | None
    frame_rate: int = 10
    observation: dict[str, Any] = field(default_factory=dict)
    partners: PartnersConfig | None = None
    visibility: Callable[[Any], Any] | None = None
    adapter: Callable[[TeamVecEnv], TeamVecEnv] | None = None


def environment_of(path: Path, saved: ShownTeam, command: str, with_partners: bool = True) -> ShownEnvironment:
    """
    Return the environment that a team was trained in, or that the options name.

    :param path: Zip of the team
    :param saved: The options
    :param command: Name of the command, for error messages
    :param with_partners: Whether partners are in it, those of its run or of the options. They need not be there otherwise
    :return: The environment, without a render mode
    :raises ConfigError: If it is unknown, or its settings are refused
    """
    packages = saved.extra_packages
    if saved.env is not None:
        make_env = load_env(saved.env, "--env", packages)
        given, n_leading = parse_pairs(saved.env_kwargs, "--env-kwargs"), len(get_env(saved.env, "--env").leading)
        kwargs = check_call(make_env, given, Location("--env-kwargs", packages), skip=n_leading, of_env=True)
        return ShownEnvironment(saved.env, kwargs, None, partners=_given_partners(path, saved) if with_partners else None)
    run = run_of(path)
    if run is None:
        raise ConfigError(
            f"{command}: {str(path)!r} is not in the folder of a run (no {CONFIG} and {RECORD}), so its environment is"
            " unknown: name it with --env, and its arguments with --env-kwargs."
        )
    algo, env_id, conf_file = run
    check_record(run, packages, trust=saved.trust)
    folder = None if saved.trust else conf_file.parent
    keeps_its_own = with_partners and saved.partners is None
    config = load_config(
        algo,
        env_id,
        str(conf_file),
        env_kwargs=saved.env_kwargs,
        extra_packages=packages,
        run_folder=folder,
        overrides=[] if keeps_its_own else [(command, {"partners": None})],
    )
    partners = _given_partners(path, saved) if with_partners and not keeps_its_own else config.partners
    return ShownEnvironment(
        config.env_id,
        config.env_kwargs,
        config.wrapper,
        observation=config.observation,
        partners=partners,
        visibility=config.visibility,
        adapter=config.adapter,
    )


def _given_partners(path: Path, saved: ShownTeam) -> PartnersConfig | None:
    """Return the partners that a flag names, beside the agents of the saved team."""
    if saved.partners is None:
        return None
    # The agents of the team are those that have learned, whatever a file says
    learners = {"learners": list(read_team(path, Trust.of(saved.trust, saved.extra_packages)).models)}
    location = Location("--partners", saved.extra_packages)
    given = check_partners(partners_of_flag(saved.partners), location)
    return partners_config({**(given or {}), **learners}, location)


def render_modes_of(shown: ShownEnvironment, command: str) -> tuple[ShownEnvironment, list[str]]:
    """
    Find out how an environment can be shown.

    :param shown: The environment
    :param command: Name of the command, for error messages
    :return: The environment with its own frame rate, and the render modes with which it can be made
    :raises ConfigError: If it refuses its settings
    """
    # SB3's vectorised environments do not pass on the metadata, so it is read from a single copy
    with _refusals_as_config_errors(shown, command):
        env = make_parallel_env(shown.env_id, **shown.env_kwargs)
    arguments, open_ended = accepted_arguments(spec(shown.env_id).load())
    # An environment may render and still be made by a callable that does not take a render mode
    takes_mode = open_ended or "render_mode" in arguments
    modes = list(env.metadata.get("render_modes", [])) if takes_mode else []
    shown = replace(shown, frame_rate=int(env.metadata.get("render_fps", 10)))
    env.close()
    return shown, modes


def with_mode(shown: ShownEnvironment, mode: str) -> ShownEnvironment:
    """
    Return an environment with a render mode.

    :param shown: The environment
    :param mode: One of its render modes
    """
    return replace(shown, env_kwargs={**shown.env_kwargs, "render_mode": mode})


def make_shown_env(shown: ShownEnvironment, saved: ShownTeam, n_envs: int, seed: int, command: str) -> TeamVecEnv:
    """
    Make the environment of a replay, with its partners in it.

    :param shown: The environment
    :param saved: The options
    :param n_envs: Number of copies
    :param seed: Its seed
    :param command: Name of the command, for error messages
    :return: The environment, seeded and not reset yet
    :raises ConfigError: If it refuses its settings
    """
    with _refusals_as_config_errors(shown, command):
        env = make_team_env(
            shown.env_id,
            n_envs=n_envs,
            seed=seed,
            env_kwargs=shown.env_kwargs,
            wrapper=shown.wrapper,
            visibility=shown.visibility,
        )
        if shown.partners is not None:
            env = shown.partners.put_into(env, seed, evaluation=True, trust_pickle=saved.trust)
        env = with_last_step(env, **shown.observation)
        return env if shown.adapter is None else shown.adapter(env)


def load_into(path: Path, env: TeamVecEnv, saved: ShownTeam, command: str) -> Team:
    """
    Load a team into an environment, which is then seeded as in the training.

    :param path: Zip of the team
    :param env: The environment
    :param saved: The options
    :param command: Name of the command, for error messages
    :return: The team
    :raises ConfigError: If it cannot be loaded, or the environment does not fit
    """
    try:
        trust = Trust.of(saved.trust, saved.extra_packages)
        return Team.load(path, env=env, device=saved.device, **trust._asdict())
    # A damaged file makes zipfile, pickle and torch raise whatever they raise
    except Exception as error:
        raise ConfigError(f"{command}: {str(path)!r} cannot be loaded: {cause(error)}") from error


@contextmanager
def team_in_its_environment(
    path: Path, shown: ShownEnvironment, saved: ShownTeam, seed: int, command: str
) -> Iterator[tuple[Team, TeamVecEnv]]:
    """
    Load a team into one copy of an environment, which is closed in the end.

    :param path: Zip of the team
    :param shown: The environment
    :param saved: The options
    :param seed: Seed of the environment, and of what the agents sample
    :param command: Name of the command, for error messages
    :return: The team and the environment, seeded and not reset yet
    :raises ConfigError: If the environment refuses its settings, or the team cannot be loaded
    """
    env = make_shown_env(shown, saved, 1, seed, command)
    try:
        team = load_into(path, env, saved, command)
        # This comes after loading, which seeds the environment as in the training
        env.seed(seed)
        # What the agents sample, and what an environment draws from the global generators, is then the same again
        set_random_seed(seed)
        yield team, env
    finally:
        env.close()


@contextmanager
def _refusals_as_config_errors(shown: ShownEnvironment, command: str) -> Iterator[None]:
    try:
        yield
    # An environment of the user's own may raise anything
    except Exception as error:
        raise ConfigError(f"{command}: {shown.env_id} refuses its settings: {cause(error)}") from error
