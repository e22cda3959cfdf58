"""SMAClite, https://github.com/uoe-agents/smaclite, SMAC's battles in pure Python, with the ids ``smaclite/<map>``."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_belief.envs.adapters.gym_tuple import GymTupleEnv, make_registered

# Step limits of SMAC's maps of the same name, since the package has none
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
    Battle of a team of units against the built-in opponent. See ``docs/environments/smaclite.md``.

    The battle terminates when one side is dead, and a win is a success. At ``max_episode_steps`` it is truncated. Dead units
    stay in ``agents`` until then and are inactive: they observe zeros, have only the action 0 and still get the team's reward.
    """

    def state(self) -> np.ndarray:
        """
        Return the package's state of the battle, which knows all units.

        :return: float32 [width]
        """
        return np.array(self.game.get_state(), dtype=np.float32)

    def _visible(self, observations: Sequence[np.ndarray]) -> np.ndarray:
        """Return the teammates that the observation shows. Each has a block of its own, which begins with 1 if it is seen."""
        first = 4 + self.game.n_enemies * self.game.enemy_feat_size
        width, n_others = self.game.ally_feat_size, self.game.n_agents - 1
        return np.array([obs[first : first + n_others * width : width] for obs in observations]) > 0

    def _masks(self) -> Sequence[np.ndarray]:
        # Each row is as wide as the widest action space of any unit
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
                # The only action of a dead unit, whatever the learner chose
                joint[i] = 0
            elif not possible[joint[i]]:
                raise ValueError(
                    f"{agent!r} cannot do action {joint[i]} now, possible are {np.flatnonzero(possible).tolist()}. SMAClite"
                    " accepts no others, so it needs a learner that heeds action masks: MaskableBeliefPPO or MaskablePPO."
                )
        return joint


def make(name: str, max_episode_steps: int | None = None, **env_kwargs: Any) -> Battle:
    """
    Make a battle.

    :param name: Name of the map, for instance ``"3s5z"``, or ``"custom"`` together with the argument ``map_file``, the path of
        a map of the user's own
    :param max_episode_steps: Step limit, >= 1. None for the limit of SMAC's map of the same name
    :param env_kwargs: Arguments of the package's environment: ``use_cpp_rvo2``, ``render_mode`` ("human" or "rgb_array"),
        ``map_file``
    :return: The environment
    :raises ValueError: For an unknown map, or if no limit is known for the map
    """
    known = [*names(), "custom"]
    limit = EPISODE_LIMITS.get(name) if max_episode_steps is None else max_episode_steps
    if limit is None and name in known:
        raise ValueError(f"The map {name!r} has no known episode limit: give max_episode_steps.")
    # By default the package would open a window
    env_kwargs = {"render_mode": None, **env_kwargs}
    env = make_registered("smaclite", f"{_PREFIX}{name}{_SUFFIX}", [f"{_PREFIX}{map}{_SUFFIX}" for map in known], **env_kwargs)
    return Battle(env, limit, name)


def names() -> list[str]:
    """
    Return the maps of the package.

    :return: Names of maps
    """
    import smaclite  # noqa: F401 (registers the maps)

    ids = [id for id in gym.registry if id.startswith(_PREFIX) and id.endswith(_SUFFIX)]
    return [map for map in (id.removeprefix(_PREFIX).removesuffix(_SUFFIX) for id in ids) if map != "custom"]
