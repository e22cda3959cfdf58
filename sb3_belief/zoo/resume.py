"""Which settings a run has that goes on from a saved team (``-i``)."""

from collections.abc import Sequence

from sb3_belief.zoo.config import RUN_KEYS, RunConfig, load_config
from sb3_belief.zoo.errors import ConfigError, nearest
from sb3_belief.zoo.run_folder import find_team, run_of
from sb3_belief.zoo.yaml_data import parse_pairs

# What the saved models bring themselves
_SAVED = ("policy", "policy_kwargs", "normalize")


def resume_config(
    trained: str,
    algo: str | None = None,
    env_id: str | None = None,
    conf_file: str | None = None,
    params: Sequence[str] = (),
    env_kwargs: Sequence[str] = (),
    n_timesteps: int | None = None,
    extra_packages: tuple[str, ...] = (),
) -> RunConfig:
    """
    The settings of the run that saved the team, so that it goes on as it was; a team that lies in no run's folder takes those
    of the configuration file. Settings of the run (number of copies, environment, ...) may change, those of the models not:
    they are saved in them.

    :param trained: a run's folder or a team's zip
    :param algo: see ``load_config``; None: that of the saved team, which it must be
    :param env_id: see ``load_config``; None: that of the saved team's run, else one with the same agents
        and spaces
    :param conf_file: see ``load_config``
    :param params: see ``load_config``
    :param env_kwargs: see ``load_config``
    :param n_timesteps: further joint steps
    :param extra_packages: see ``load_config``
    :return: the configuration
    :raises ConfigError: for settings that do not fit the saved team, or what ``load_config`` refuses
    """
    changeable = [key for key in RUN_KEYS if key not in _SAVED]
    for key in parse_pairs(params, "-params"):
        if key not in changeable:
            raise ConfigError(
                f"-params: {key!r} cannot be set with -i, the saved models bring their settings.{nearest(key, changeable)}"
                f" Allowed: {', '.join(changeable)}."
            )
    run = run_of(find_team(trained, "--trained-agent"))
    if run is not None:
        saved_algo, saved_env, saved_conf = run
        algo, env_id = algo or saved_algo, env_id or saved_env
        if algo != saved_algo:
            raise ConfigError(f"--algo: {algo!r} does not fit the saved team, which is of {saved_algo!r}.")
        if conf_file is None and env_id == saved_env:
            conf_file = str(saved_conf)
    if algo is None or env_id is None:
        raise ConfigError(f"--trained-agent: {trained!r} lies in no run's folder: say --algo and --env.")
    return load_config(algo, env_id, conf_file, params, env_kwargs, n_timesteps, extra_packages)
