"""Learners without training beside a picker, which show what it is worth to know its order of collecting."""

from collections.abc import Sequence
from itertools import permutations
from typing import Any

import numpy as np

from sb3_belief.envs.foraging_partners.parallel_env import LEARNER
from sb3_belief.envs.foraging_partners.partners import Cell, action_towards, distance
from sb3_belief.envs.reference_policies import ReferencePolicy
from sb3_belief.vec_env.team_vec_env import TeamObs

_ORDERS = tuple(permutations(range(3)))
# For a player that is not in sight
_NOWHERE: Cell = (-9, -9)


class _Seen:
    """
    What an observation shows.

    :param row: Observation [15 or more]
    """

    def __init__(self, row: np.ndarray):
        blocks = row[:15].reshape(5, 3).astype(int)
        #: {number of a food that is left: its cell}
        self.foods: dict[int, Cell] = {k: (int(y), int(x)) for k, (y, x, level) in enumerate(blocks[:3]) if level > 0}
        self.me: Cell = (int(blocks[3, 0]), int(blocks[3, 1]))
        self.other: Cell = (int(blocks[4, 0]), int(blocks[4, 1])) if blocks[4, 2] > 0 else _NOWHERE
        self.field = np.zeros((8, 8), dtype=int)
        for cell in self.foods.values():
            self.field[cell] = 1

    def action(self, food: int) -> int:
        """Return the action that leads to a food."""
        return action_towards(self.foods[food], self.field, self.me, self.other)

    def nearest(self, foods: Sequence[int]) -> int:
        """Return the nearest of some foods."""
        return min(foods, key=lambda food: distance(self.me, self.foods[food]))


class KnowingPicker(ReferencePolicy):
    """Learner that is told the order, and goes where the picker goes."""

    def act(self, obs: TeamObs, partners: list[str]) -> TeamObs:
        """
        Go to the picker's food.

        :param obs: Observations [n_envs, 15] of the learner
        :param partners: Order of each copy
        :return: Actions [n_envs]
        """
        actions = []
        for row, partner in zip(obs[LEARNER], partners, strict=True):
            seen = _Seen(row)
            actions.append(seen.action(next(food for food in map(int, partner.split("-")) if food in seen.foods)))
        return {LEARNER: np.array(actions)}


class RememberingPicker(ReferencePolicy):
    """
    Learner that remembers in which order food was collected, which is the order of the picker.

    It goes to the nearest food that may be the picker's next one, loads once, and goes on to the next such one if nobody is
    there. Where it sees the picker beside a food it goes to that.

    :param n_envs: Number of environment copies
    :param episodes: Number of episodes after which it forgets: 10 for an ideal memory, 1 for the best blind rule found
    """

    def __init__(self, n_envs: int, episodes: int = 10):
        self.episodes = episodes
        self.played = np.zeros(n_envs, dtype=np.int64)
        self.orders = [list(_ORDERS) for _ in range(n_envs)]
        self.tried: list[list[int]] = [[] for _ in range(n_envs)]

    def act(self, obs: TeamObs, partners: list[str]) -> TeamObs:
        """
        Go where the picker may be.

        :param obs: Observations [n_envs, 15] of the learner
        :param partners: Not used
        :return: Actions [n_envs]
        """
        actions = []
        for copy, row in enumerate(obs[LEARNER]):
            seen, tried = _Seen(row), self.tried[copy]
            beside = [food for food, cell in seen.foods.items() if distance(seen.other, cell) == 1]
            nexts = sorted({next(food for food in order if food in seen.foods) for order in self.orders[copy]})
            target = beside[0] if beside else seen.nearest([food for food in nexts if food not in tried] or nexts)
            if not beside and distance(seen.me, seen.foods[target]) == 1:
                tried.append(target)
                if len(tried) >= len(nexts):
                    tried.clear()
            actions.append(seen.action(target))
        return {LEARNER: np.array(actions)}

    def watch(self, obs: TeamObs, rewards: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]) -> None:
        """
        Keep the orders by which the food that was just collected came first.

        :param obs: Observations before the step
        :param rewards: Rewards of the step, more than 0 where food was collected
        :param dones: Where an episode has ended, bool [n_envs]
        :param infos: Not used, since a food is collected only by a player beside it
        """
        for copy in np.flatnonzero(rewards > 0):
            seen = _Seen(obs[LEARNER][copy])
            collected = next(food for food, cell in seen.foods.items() if distance(seen.me, cell) == 1)
            self.orders[copy] = [
                order for order in self.orders[copy] if next(food for food in order if food in seen.foods) == collected
            ]
            self.tried[copy].clear()
        for copy in np.flatnonzero(dones):
            self.tried[copy].clear()
            self.played[copy] += 1
            if self.played[copy] % self.episodes == 0:
                self.orders[copy] = list(_ORDERS)


class FollowingPicker(ReferencePolicy):
    """
    Learner that sees the picker everywhere (``partner_sight=None``) and goes to the food that it has come nearer to since the
    last one was collected.

    :param n_envs: Number of environment copies
    """

    def __init__(self, n_envs: int):
        self.starts: list[Cell | None] = [None] * n_envs

    def act(self, obs: TeamObs, partners: list[str]) -> TeamObs:
        """
        Go where the picker seems to go.

        :param obs: Observations [n_envs, 15] of the learner
        :param partners: Not used
        :return: Actions [n_envs]
        """
        actions = []
        for copy, row in enumerate(obs[LEARNER]):
            seen = _Seen(row)
            start = self.starts[copy] = self.starts[copy] or seen.other
            nearer = {food: distance(start, cell) - distance(seen.other, cell) for food, cell in seen.foods.items()}
            most = max(nearer.values())
            likely = [food for food, cell in seen.foods.items() if nearer[food] == most]
            beside = [food for food in likely if distance(seen.other, seen.foods[food]) == 1]
            actions.append(seen.action(seen.nearest(beside or likely)))
        return {LEARNER: np.array(actions)}

    def watch(self, obs: TeamObs, rewards: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]) -> None:
        """
        Begin anew where food was collected.

        :param obs: Not used
        :param rewards: Rewards of the step, more than 0 where food was collected
        :param dones: Where an episode has ended, bool [n_envs]
        :param infos: Not used
        """
        for copy in np.flatnonzero((rewards > 0) | dones):
            self.starts[copy] = None
