"""The Multi-Robot Warehouse, https://github.com/semitable/robotic-warehouse: ids ``rware/<its Gymnasium id>``."""

from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np

from sb3_belief.envs.adapters.gym_tuple import ResumableTupleEnv, make_registered


class Warehouse(ResumableTupleEnv):
    """
    Robots bring requested shelves to the goals and others back. See ``docs/environments/rware.md``.

    Nothing ends an episode but its limits, ``max_steps`` (500) and, if set, ``max_inactivity_steps``. The package reports them
    as terminations; here they are truncations.

    The team's reward is the sum over the agents, i.e. the number of shelves delivered; with the reward type "global", which
    gives every delivery to everyone, it is their mean, for the same number.
    """

    state_names: ClassVar[tuple[str, ...]] = (
        "grid",
        "agents",
        "shelfs",
        "request_queue",
        "_cur_steps",
        "_cur_inactive_steps",
        "_np_random",
    )

    def _visible(self, observations: Sequence[np.ndarray]) -> np.ndarray:
        """Those in the window that a robot's sensors show, the cells at most ``sensor_range`` rows and columns away."""
        robots, reach = self.game.agents, self.game.sensor_range
        rows = [
            [max(abs(robot.x - viewer.x), abs(robot.y - viewer.y)) <= reach for robot in robots if robot is not viewer]
            for viewer in robots
        ]
        return np.array(rows, dtype=bool)

    def _is_time_limit(self) -> bool:
        return True

    def team_reward(self, rewards: dict[str, float]) -> float:
        """
        :param rewards: what ``step`` returned
        :return: their sum, or their mean with the reward type "global"
        """
        total = sum(rewards.values())
        return total / len(rewards) if self.game.reward_type.name == "GLOBAL" else total

    def render(self) -> Any:
        """
        :return: an image for ``render_mode="rgb_array"``; a window is opened for "human"
        """
        # The package's render() does not look at its own render_mode
        return self.game.render(mode=self.render_mode or "human")


def make(name: str, **env_kwargs: Any) -> Warehouse:
    """
    :param name: Gymnasium's id, e.g. ``"rware-tiny-2ag-v2"``
    :param env_kwargs: override the arguments that the id stands for, e.g. ``max_steps`` (500), ``sensor_range`` (1);
        ``reward_type`` may be "global", "individual" or "two_stage", ``observation_type`` "flattened" or "image"
    :return: the environment
    :raises ValueError: for an unknown name, reward type or observation type
    """
    known = names()
    from rware.warehouse import ObservationType, RewardType

    # The package wants members of its enumerations, which a settings file cannot name
    for argument, options in (("reward_type", RewardType), ("observation_type", ObservationType)):
        value = env_kwargs.get(argument)
        if isinstance(value, str):
            allowed = [option for option in options if not option.name.endswith("DICT")]
            members = {option.name.lower(): option for option in allowed}
            if value.lower() not in members:
                raise ValueError(f"{argument}={value!r} must be one of {', '.join(map(repr, members))}.")
            env_kwargs[argument] = members[value.lower()]
    return Warehouse(make_registered("rware", name, known, **env_kwargs), name=name)


def names() -> list[str]:
    """
    :return: the package's ids
    """
    import rware  # noqa: F401 (registers them)

    return [id for id in gym.registry if id.startswith("rware")]
