"""SMAC (Samvelyan et al. 2019, https://arxiv.org/abs/1902.04043), with the ids ``smac/<map>``."""

from typing import Any

from sb3_belief.envs.adapters.smac_env import StarCraft, starcraft_kwargs


def make(name: str, render_mode: str | None = None, **env_kwargs: Any) -> StarCraft:
    """
    Make a battle.

    :param name: Name of a map, for instance ``"3s5z"``
    :param render_mode: None, ``"human"`` or ``"rgb_array"``
    :param env_kwargs: Arguments of the package's ``StarCraft2Env`` except ``map_name``, ``seed`` and ``continuing_episode``.
        ``obs_last_action`` is off by default, because a learner gets the actions of others through ``others_actions``
    :return: The environment
    :raises ValueError: For an unknown map or an argument that the adapter sets itself
    """
    from smac.env import StarCraft2Env

    known = names()
    if name not in known:
        raise ValueError(f"Unknown SMAC map {name!r}; there are {', '.join(known)}.")
    kwargs = starcraft_kwargs(f"smac/{name}", env_kwargs)

    def launch(seed: int | None) -> Any:
        return StarCraft2Env(map_name=name, seed=seed, **kwargs)

    # SMAC counts the time step among the unit's own features and then appends it once more without counting it
    extra_width = int(bool(env_kwargs.get("obs_timestep_number", False)))
    return StarCraft(f"smac/{name}", launch, extra_width, render_mode)


def names() -> list[str]:
    """
    Return the maps of the package.

    :return: Names of maps
    """
    from smac.env.starcraft2.maps.smac_maps import get_smac_map_registry

    return list(get_smac_map_registry())
