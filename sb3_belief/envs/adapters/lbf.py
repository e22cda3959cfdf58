"""Level-Based Foraging, https://github.com/semitable/lb-foraging, with the ids ``lbf/<Gymnasium id>``."""

from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np

from sb3_belief.envs.adapters.gym_tuple import DrawnTupleEnv, make_registered
from sb3_belief.envs.pictures import AGENT_COLOURS, GridPicture, cell_position

_FOOD = (196, 60, 52)


class Foraging(DrawnTupleEnv):
    """
    Level-Based Foraging: players on a grid collect food. See ``docs/environments/lbf.md``.

    A food is collected if the levels of the adjacent players that load it at the same step sum up to at least its own level.

    An episode terminates with success when no food is left. The package reports its step limit as a termination too. Here it
    is a truncation if food is left.

    The team's reward is the sum over the agents: 1 for an episode in which all food is collected.
    """

    action_names: ClassVar[tuple[str, ...]] = ("none", "north", "south", "west", "east", "load")
    state_names: ClassVar[tuple[str, ...]] = (
        "field",
        "players",
        "current_step",
        "_food_spawned",
        "_game_over",
        "_valid_actions",
        "_np_random",
    )

    def _prepare_reset(self) -> None:
        # The package avoids the players' old positions when it places players and food, so without this the first observation
        # would depend on the end of the last episode and not on the seed alone
        for player in self.game.players:
            player.position = None

    def _visible(self, observations: Sequence[np.ndarray]) -> np.ndarray:
        """
        Return the players that the observation shows.

        They are computed from positions, because an observation of three or more players does not say which of them it shows:
        its k-th block holds the k-th visible player, whichever that is.
        """
        sight = self.game.sight
        positions = [player.position for player in self.game.players]
        rows = []
        for viewer, (row, column) in enumerate(positions):
            # The package shows players in the square of side 2 * sight + 1 whose upper left corner is sight rows and columns
            # away, but moved into the field at the upper and left border. From there a player sees up to twice as far
            top, left = max(row - sight, 0), max(column - sight, 0)
            others = positions[:viewer] + positions[viewer + 1 :]
            rows.append([0 <= y - top <= 2 * sight and 0 <= x - left <= 2 * sight for y, x in others])
        return np.array(rows, dtype=bool)

    def _draw(self) -> np.ndarray:
        picture = GridPicture(*self.game.field.shape)
        for row, column in np.argwhere(self.game.field):
            picture.square(row, column, _FOOD, str(self.game.field[row, column]), size=0.7)
        for index, player in enumerate(self.game.players):
            picture.disc(player.position[0], player.position[1], AGENT_COLOURS[index % len(AGENT_COLOURS)], str(player.level))
        return picture.image()

    def picture_positions(self) -> dict[str, tuple[float, float]]:
        """
        Return where the players are in the picture.

        :return: {agent: (x, y)} as fractions of its width and height, from the upper left corner
        """
        players = zip(self.possible_agents, self.game.players, strict=True)
        return {agent: cell_position(*player.position, *self.game.field.shape) for agent, player in players}

    def _is_success(self) -> bool:
        return not self.game.field.any()

    def _is_time_limit(self) -> bool:
        return not self._is_success()

    def team_reward(self, rewards: dict[str, float]) -> float:
        """
        Return the sum of the agents' rewards.

        :param rewards: Rewards by agent, as ``step`` returned them
        :return: Their sum, which is the fraction of all food levels that was collected in this step
        """
        return sum(rewards.values())


def make(name: str, **env_kwargs: Any) -> Foraging:
    """
    Make a foraging environment.

    :param name: Gymnasium's id, for instance ``"Foraging-2s-8x8-2p-2f-coop-v3"``
    :param env_kwargs: Keyword arguments that override those of the id, for instance ``max_episode_steps`` (50), ``sight`` or
        ``penalty``
    :return: The environment
    :raises ValueError: For an unknown name, or for grid observations, for which the package makes no valid space
    """
    if env_kwargs.get("grid_observation"):
        raise ValueError(
            "lbforaging's grid_observation=True is not supported: the package gives it an observation space of a wrong shape."
            " Leave it out for the vector observations."
        )
    return Foraging(make_registered("lbforaging", name, names(), **env_kwargs), name=name)


def names() -> list[str]:
    """
    Return the ids of the package with vector observations.

    :return: Gymnasium's ids
    """
    import lbforaging  # noqa: F401 (registers the ids)

    return [id for id in gym.registry if id.startswith("Foraging-") and not id.startswith("Foraging-grid")]
