"""SMAClite, https://github.com/uoe-agents/smaclite, StarCraft II's micromanagement in Python: ids ``smaclite/<map>``."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_belief.envs.adapters.gym_tuple import GymTupleEnv, make_registered

# The package has no limit of its own; these are those of SMAC's maps of the same name
EPISODE_LIMITS = {
    "10m_vs_11m": 150,
    "27m_vs_30m": 180,
    "2c_vs_64zg": 400,
    "2s3z": 120,
    "2s_vs_1sc": 300,
    "3s5z": 150,
    "3s5z_vs_3s6z": 170,
    "3s_vs_5z": 250,
    "MMM": 150,
    "MMM2": 180,
    "bane_vs_bane": 200,
    "corridor": 400,
}
_PREFIX, _SUFFIX = "smaclite/", "-v0"


class Battle(GymTupleEnv):
    """
    A team of units against the built-in opponent. See ``docs/environments/smaclite.md``.

    The battle ends when one side is dead; a win is a success. At ``max_episode_steps`` it is truncated. Units that die stay
    listed until then, inactive: they see zeros, may only send 0 and go on getting the team's reward.
    """

    def _visible(self, observations: Sequence[np.ndarray]) -> np.ndarray:
        """Those who are in the observation: each other has a block of its own in it, which begins with a 1 for who is seen."""
        first = 4 + self.game.n_enemies * self.game.enemy_feat_size
        width, n_others = self.game.ally_feat_size, self.game.n_agents - 1
        return np.array([obs[first : first + n_others * width : width] for obs in observations]) > 0

    def _masks(self) -> Sequence[np.ndarray]:
        # The rows are as wide as the widest action space of any unit
        available = zip(self.game.get_avail_actions(), self._n_actions.values(), strict=True)
        self._possible = [np.array(row[:n_actions], dtype=bool) for row, n_actions in available]
        return self._possible

    def _active(self) -> np.ndarray:
        return np.array([i in self.game.agents for i in range(self.game.n_agents)])

    def _is_success(self) -> bool:
        return bool(self.info["battle_won"])

    def _joint_action(self, actions: dict[str, Any]) -> list[Any]:
        joint = super()._joint_action(actions)
        for i, (agent, possible) in enumerate(zip(self.possible_agents, self._possible, strict=True)):
            if not self._in_play[i]:
                joint[i] = 0
            elif not possible[joint[i]]:
                raise ValueError(
                    f"{agent!r} cannot do action {joint[i]} now, possible are {np.flatnonzero(possible).tolist()}. SMAClite"
                    " takes no others, so it needs a learner that heeds action masks: MaskableBeliefPPO or MaskablePPO."
                )
        return joint


def make(name: str, max_episode_steps: int | None = None, **env_kwargs: Any) -> Battle:
    """
    :param name: of the map, e.g. ``"3s5z"``; ``"custom"`` with the argument ``map_file``, the path of a map of one's own
    :param max_episode_steps: >= 1. None: the limit of SMAC's map of the same name
    :param env_kwargs: arguments of the package's environment: ``use_cpp_rvo2``, ``render_mode`` ("human" or "rgb_array"),
        ``map_file``
    :return: the environment
    :raises ValueError: for an unknown map, or if a custom one has no limit
    """
    known = [*names(), "custom"]
    limit = EPISODE_LIMITS.get(name) if max_episode_steps is None else max_episode_steps
    if limit is None and name in known:
        raise ValueError(f"The map {name!r} has no known episode limit: give max_episode_steps.")
    # The package would open windows by default
    env_kwargs = {"render_mode": None, **env_kwargs}
    env = make_registered("smaclite", f"{_PREFIX}{name}{_SUFFIX}", [f"{_PREFIX}{map}{_SUFFIX}" for map in known], **env_kwargs)
    return Battle(env, limit, name)


def names() -> list[str]:
    """
    :return: the package's maps
    """
    import smaclite  # noqa: F401 (registers them)

    ids = [id for id in gym.registry if id.startswith(_PREFIX) and id.endswith(_SUFFIX)]
    return [map for map in (id.removeprefix(_PREFIX).removesuffix(_SUFFIX) for id in ids) if map != "custom"]
