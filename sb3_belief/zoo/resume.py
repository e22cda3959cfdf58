"""Settings of a run that continues training a saved team (``-i``)."""

from collections.abc import Sequence
from typing import Any

from sb3_belief.zoo.config import RunConfig, load_config
from sb3_belief.zoo.errors import ConfigError, suggestion
from sb3_belief.zoo.run_folder import check_record, find_team, run_of
from sb3_belief.zoo.settings import RUN_KEYS
from sb3_belief.zoo.yaml_data import parse_pairs

# Settings of the models, which are saved in the team
_SAVED = ("policy", "policy_kwargs", "normalize", "agent_kwargs")


def resume_config(
    trained: str,
    algo: str | None = None,
    env_id: str | None = None,
    conf_file: str | None = None,
    params: Sequence[str] = (),
    trust: bool = False,
    **further: Any,
) -> RunConfig:
    """
    Return the configuration of a run that continues training a saved team.

    Unless given anew, the settings are those of the run that saved the team. For a team outside the folder of a run they come
    from the configuration file. Settings of the run (number of copies, environment, ...) may change, but those of the models
    may not, because they are saved in the models.

    :param trained: Folder of a run, or zip of a team
    :param algo: See ``load_config``. It must be the algorithm of the saved team, which is also the default
    :param env_id: See ``load_config``. The environment must have the same agents and spaces as the saved team's, which is the
        default
    :param conf_file: See ``load_config``
    :param params: See ``load_config``
    :param trust: Whether the files in the run's folder may name anything, and write anywhere
    :param further: Further arguments of ``load_config``; ``n_timesteps`` is the number of further joint steps
    :return: The configuration
    :raises ConfigError: For settings that do not fit the saved team, or that ``load_config`` refuses
    """
    changeable = [key for key in RUN_KEYS if key not in _SAVED]
    for key in parse_pairs(params, "-params"):
        if key not in changeable:
            raise ConfigError(
                f"-params: {key!r} cannot be set with -i, the saved models keep their settings.{suggestion(key, changeable)}"
                f" Allowed: {', '.join(changeable)}."
            )
    run = run_of(find_team(trained, "--trained-agent", tells=False))
    if run is not None:
        saved_algo, saved_env, saved_conf = run
        check_record(run, further.get("extra_packages", ()), of_env=env_id is None, trust=trust)
        algo, env_id = algo or saved_algo, env_id or saved_env
        if algo != saved_algo:
            raise ConfigError(f"--algo: {algo!r} does not fit the saved team, which is of {saved_algo!r}.")
        # The run's own file has a section for its own environment only
        if conf_file is None and env_id == saved_env:
            conf_file = str(saved_conf)
            further["run_folder"] = None if trust else saved_conf.parent
    if algo is None or env_id is None:
        raise ConfigError(f"--trained-agent: {trained!r} is not in the folder of a run: give --algo and --env.")
    return load_config(algo, env_id, conf_file, params, **further)
