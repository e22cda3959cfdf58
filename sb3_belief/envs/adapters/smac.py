"""SMAC (Samvelyan et al. 2019, https://arxiv.org/abs/1902.04043): ids ``smac/<map>``."""

from typing import Any

from sb3_belief.envs.adapters.smac_env import StarCraft, checked


def make(name: str, render_mode: str | None = None, **env_kwargs: Any) -> StarCraft:
    """
    :param name: a map, e.g. ``"3s5z"``
    :param render_mode: None, ``"human"`` or ``"rgb_array"``
    :param env_kwargs: arguments of the package's ``StarCraft2Env`` except ``map_name``, ``seed`` and ``continuing_episode``.
        ``obs_last_action`` stays off unless asked for: what teammates do reaches a learner through ``others_actions``.
    :return: one battle
    :raises ValueError: for an unknown map or an argument that is not the user's to give
    """
    from smac.env import StarCraft2Env

    known = names()
    if name not in known:
        raise ValueError(f"Unknown SMAC map {name!r}; there are {', '.join(known)}.")
    kwargs = checked(f"smac/{name}", env_kwargs)

    def launch(seed: int | None) -> Any:
        return StarCraft2Env(map_name=name, seed=seed, **kwargs)

    # SMAC counts the time step as one of the unit's own features, and then appends it as well
    extra_width = int(bool(env_kwargs.get("obs_timestep_number", False)))
    return StarCraft(f"smac/{name}", launch, extra_width, render_mode)


def names() -> list[str]:
    """
    :return: the maps that the package knows
    """
    from smac.env.starcraft2.maps.smac_maps import get_smac_map_registry

    return list(get_smac_map_registry())
