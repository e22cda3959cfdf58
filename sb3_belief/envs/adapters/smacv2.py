"""SMACv2 (Ellis et al. 2022, https://arxiv.org/abs/2212.07489), with the ids ``smacv2/<race>_<allies>_vs_<enemies>``."""

import random
import re
from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from typing import Any

import numpy as np

from sb3_belief.envs.adapters.smac_env import StarCraft, starcraft_kwargs
from sb3_belief.envs.base import ResetResult, StepResult

# Arguments that all published configurations of the package share
_PUBLISHED: dict[str, Any] = {"obs_own_pos": True, "use_unit_ranges": True, "min_attack_range": 2}
_SIZES = ("5_vs_5", "10_vs_10", "20_vs_20", "10_vs_11", "20_vs_23")
_TEAMS: dict[str, dict[str, Any]] = {
    "protoss": {"unit_types": ["stalker", "zealot", "colossus"], "weights": [0.45, 0.45, 0.1]},
    "terran": {
        "unit_types": ["marine", "marauder", "medivac"],
        "weights": [0.45, 0.45, 0.1],
        "exception_unit_types": ["medivac"],
    },
    "zerg": {
        "unit_types": ["zergling", "baneling", "hydralisk"],
        "weights": [0.45, 0.1, 0.45],
        "exception_unit_types": ["baneling"],
    },
}
_SCENARIO = re.compile(r"(protoss|terran|zerg)_([1-9]\d*)_vs_([1-9]\d*)")


class StarCraftV2(StarCraft):
    """
    Battle of SMACv2, a :class:`~sb3_belief.envs.adapters.smac_env.StarCraft` with random generators of its own.

    SMACv2 draws from the global generators of ``random`` and ``numpy.random``. Their states are replaced during each reset and
    step, so that a seed determines the result and the caller's generators are unaffected. The draws of the package's
    ``attack`` capability, which no published scenario has, are not seeded.
    """

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> ResetResult:
        """
        Start a battle, as the base class does.

        :param seed: Seed of the random generators, with which StarCraft II is also launched again. With None both continue
        :param options: Not used
        :return: Observations and infos, by agent
        """
        if seed is not None or not hasattr(self, "_python"):
            source = np.random.SeedSequence(seed)
            self._python = random.Random(int(source.generate_state(1)[0])).getstate()
            self._numpy = np.random.RandomState(np.random.MT19937(source)).get_state()
        with self._own_generators():
            return super().reset(seed, options)

    def step(self, actions: dict[str, int]) -> StepResult:
        """Advance the battle by one step, as the base class does."""
        with self._own_generators():
            return super().step(actions)

    @contextmanager
    def _own_generators(self) -> Iterator[None]:
        callers = random.getstate(), np.random.get_state()
        random.setstate(self._python)
        np.random.set_state(self._numpy)
        try:
            yield
        finally:
            self._python, self._numpy = random.getstate(), np.random.get_state()
            random.setstate(callers[0])
            np.random.set_state(callers[1])


def make(name: str, render_mode: str | None = None, **env_kwargs: Any) -> StarCraftV2:
    """
    Make a battle.

    :param name: A scenario such as ``"terran_5_vs_5"`` (with any numbers of units, ``names()`` lists the published ones), or a
        map of the package such as ``"10gen_terran"`` together with ``capability_config``
    :param render_mode: None, ``"human"`` or ``"rgb_array"``
    :param env_kwargs: Arguments of the package's ``StarCraftCapabilityEnvWrapper`` except ``map_name``, ``seed`` and
        ``continuing_episode``. They override those of the scenario
    :return: The environment
    :raises ValueError: For an unknown name or an argument that is not allowed
    """
    from smacv2.env.starcraft2.wrapper import StarCraftCapabilityEnvWrapper

    kwargs = {**scenario(name), **env_kwargs} if _SCENARIO.fullmatch(name) else {"map_name": name, **env_kwargs}
    if "capability_config" not in kwargs:
        raise ValueError(
            f"Unknown SMACv2 scenario {name!r}; there are {', '.join(names())}, or a map of the package together with a"
            " capability_config."
        )
    if kwargs.get("obs_starcraft") is False:
        raise ValueError("obs_starcraft=False removes the battle from the observations, and with it which allies are in view.")
    kwargs = starcraft_kwargs(f"smacv2/{name}", kwargs)

    def launch(seed: int | None) -> Any:
        # A copy, because the package writes into the configuration
        game = StarCraftCapabilityEnvWrapper(seed=seed, **deepcopy(kwargs))
        if seed is not None:
            _seed_distributions(game.env_key_to_distribution_map, np.random.SeedSequence(seed))
        return game

    return StarCraftV2(f"smacv2/{name}", launch, render_mode=render_mode)


def scenario(name: str) -> dict[str, Any]:
    """
    Return the arguments of the package's environment for a scenario, as in the published configurations.

    :param name: Name of the scenario, for instance ``"zerg_10_vs_11"``
    :return: Keyword arguments
    :raises ValueError: For any other name
    """
    match = _SCENARIO.fullmatch(name)
    if match is None:
        raise ValueError(f"Unknown SMACv2 scenario {name!r}; there are {', '.join(names())}.")
    race, n_units, n_enemies = match[1], int(match[2]), int(match[3])
    return {
        **_PUBLISHED,
        "map_name": f"10gen_{race}",
        "capability_config": {
            "n_units": n_units,
            "n_enemies": n_enemies,
            "team_gen": {"dist_type": "weighted_teams", "observe": True, **deepcopy(_TEAMS[race])},
            "start_positions": {"dist_type": "surrounded_and_reflect", "p": 0.5, "map_x": 32, "map_y": 32},
        },
    }


def names() -> list[str]:
    """
    Return the published scenarios.

    :return: Names of scenarios
    """
    return [f"{race}_{size}" for size in _SIZES for race in _TEAMS]


def _seed_distributions(distributions: dict[str, Any], source: np.random.SeedSequence) -> None:
    """
    Seed the generators of teams and positions, which the package seeds from the operating system.

    :param distributions: The package's distributions by name. Some contain further ones
    :param source: Source of the seeds
    """
    for name in sorted(distributions):
        distribution = distributions[name]
        if hasattr(distribution, "rng"):
            distribution.rng = np.random.default_rng(source.spawn(1)[0])
        inside = {key: value for key, value in vars(distribution).items() if hasattr(value, "generate")}
        _seed_distributions(inside, source)
