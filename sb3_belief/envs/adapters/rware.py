"""The Multi-Robot Warehouse, https://github.com/semitable/robotic-warehouse, with the ids ``rware/<Gymnasium id>``."""

from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np

from sb3_belief.envs.adapters.gym_tuple import DrawnTupleEnv, make_registered
from sb3_belief.envs.pictures import AGENT_COLOURS, GridPicture, cell_position

_GOAL, _SHELF, _REQUESTED = (60, 60, 60), (160, 150, 200), (32, 140, 130)
# Steps (rows, columns) to which a robot looks
_HEADINGS = {"UP": (-1, 0), "DOWN": (1, 0), "LEFT": (0, -1), "RIGHT": (0, 1)}


class Warehouse(DrawnTupleEnv):
    """
    Multi-Robot Warehouse: robots carry requested shelves to the goals and return them. See ``docs/environments/rware.md``.

    An episode ends only at its limits, ``max_steps`` (500) and, if set, ``max_inactivity_steps``. The package reports them as
    terminations. Here they are truncations.

    The team's reward is the sum over the agents. With the reward type "global", which rewards every agent for each delivery,
    it is their mean. Either way it counts the delivered shelves.
    """

    action_names: ClassVar[tuple[str, ...]] = ("noop", "forward", "left", "right", "toggle load")
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
        """Return the robots that a robot's sensors show, those at most ``sensor_range`` rows and columns away."""
        robots, reach = self.game.agents, self.game.sensor_range
        rows = [
            [max(abs(robot.x - viewer.x), abs(robot.y - viewer.y)) <= reach for robot in robots if robot is not viewer]
            for viewer in robots
        ]
        return np.array(rows, dtype=bool)

    def _draw(self) -> np.ndarray:
        game = self.game
        picture = GridPicture(*game.grid_size)
        for x, y in game.goals:
            picture.square(y, x, _GOAL, "goal")
        for shelf in game.shelfs:
            picture.square(shelf.y, shelf.x, _REQUESTED if shelf in game.request_queue else _SHELF, size=0.9)
        for index, robot in enumerate(game.agents):
            colour = AGENT_COLOURS[index % len(AGENT_COLOURS)]
            picture.disc(robot.y, robot.x, colour, "*" if robot.carrying_shelf else "", _HEADINGS[robot.dir.name])
        return picture.image()

    def picture_positions(self) -> dict[str, tuple[float, float]]:
        """
        Return where the robots are in the picture.

        :return: {agent: (x, y)} as fractions of its width and height, from the upper left corner
        """
        robots = zip(self.possible_agents, self.game.agents, strict=True)
        return {agent: cell_position(robot.y, robot.x, *self.game.grid_size) for agent, robot in robots}

    def _is_time_limit(self) -> bool:
        return True

    def team_reward(self, rewards: dict[str, float]) -> float:
        """
        Return the reward for the deliveries of the team.

        :param rewards: Rewards by agent, as ``step`` returned them
        :return: Their sum, or their mean with the reward type "global"
        """
        total = sum(rewards.values())
        return total / len(rewards) if self.game.reward_type.name == "GLOBAL" else total


def make(name: str, **env_kwargs: Any) -> Warehouse:
    """
    Make a warehouse environment.

    :param name: Gymnasium's id, for instance ``"rware-tiny-2ag-v2"``
    :param env_kwargs: Keyword arguments that override those of the id, for instance ``max_steps`` (500) or ``sensor_range``
        (1). ``reward_type`` may be "global", "individual" or "two_stage", and ``observation_type`` "flattened" or "image"
    :return: The environment
    :raises ValueError: For an unknown name, reward type or observation type
    """
    known = names()
    from rware.warehouse import ObservationType, RewardType

    # The package expects members of its enumerations, which a YAML file cannot contain, so their names are accepted too
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
    Return the ids of the package.

    :return: Gymnasium's ids
    """
    import rware  # noqa: F401 (registers the ids)

    return [id for id in gym.registry if id.startswith("rware")]
