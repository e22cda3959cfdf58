"""Level-Based Foraging, https://github.com/semitable/lb-foraging: ids ``lbf/<its Gymnasium id>``."""

from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np

from sb3_belief.envs.adapters.gym_tuple import ResumableTupleEnv, make_registered


class Foraging(ResumableTupleEnv):
    """
    Players on a grid collect food; a food is collected when those next to it who load at the same step have levels that sum up
    to its own. See ``docs/environments/lbf.md``.

    An episode terminates when no food is left, which is its success. The package reports its step limit as an end of the same
    kind; here it is a truncation if food is left.

    The team's reward is the sum over the agents: 1 for an episode in which all food is collected.
    """

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
        # The package places players and food only where nobody stood at the end of the last episode: the first
        # observation would depend on that and not on the seed alone
        for player in self.game.players:
            player.position = None

    def _visible(self, observations: Sequence[np.ndarray]) -> np.ndarray:
        """
        Those who are in the observation. Read from the positions, because with three players and more the observation's blocks
        are packed: the k-th block is whoever is seen as the k-th.
        """
        sight = self.game.sight
        positions = [player.position for player in self.game.players]
        rows = []
        for viewer, (row, column) in enumerate(positions):
            # The package counts rows and columns from the corner of what a viewer sees, at the upper and left border from that
            # of the field, and shows who is at 0 to 2 sight there: from a border one sees up to twice as far
            top, left = max(row - sight, 0), max(column - sight, 0)
            others = positions[:viewer] + positions[viewer + 1 :]
            rows.append([0 <= y - top <= 2 * sight and 0 <= x - left <= 2 * sight for y, x in others])
        return np.array(rows, dtype=bool)

    def _is_success(self) -> bool:
        return not self.game.field.any()

    def _is_time_limit(self) -> bool:
        return not self._is_success()

    def team_reward(self, rewards: dict[str, float]) -> float:
        """
        :param rewards: what ``step`` returned
        :return: their sum: the part of the food's levels that was collected in this step
        """
        return sum(rewards.values())

    def render(self) -> Any:
        """
        :return: an image for ``render_mode="rgb_array"``; a window is opened for "human"
        """
        # The package's render() does not look at its own render_mode
        return self.game.render(mode=self.render_mode or "human")


def make(name: str, **env_kwargs: Any) -> Foraging:
    """
    :param name: Gymnasium's id, e.g. ``"Foraging-2s-8x8-2p-2f-coop-v3"``
    :param env_kwargs: override the arguments that the id stands for, e.g. ``max_episode_steps`` (50), ``sight``, ``penalty``
    :return: the environment
    :raises ValueError: for an unknown name, or for grid observations, with which the package makes no valid space
    """
    if env_kwargs.get("grid_observation"):
        raise ValueError(
            "lbforaging's grid_observation=True is not supported: the package gives it an observation space of a wrong shape."
            " Leave it out for the vector observations."
        )
    return Foraging(make_registered("lbforaging", name, names(), **env_kwargs), name=name)


def names() -> list[str]:
    """
    :return: the package's ids with vector observations
    """
    import lbforaging  # noqa: F401 (registers them)

    return [id for id in gym.registry if id.startswith("Foraging-") and not id.startswith("Foraging-grid")]
