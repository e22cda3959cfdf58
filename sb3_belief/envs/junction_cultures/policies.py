"""
Hand rules for the learner of a junction with cultures, as bounds of what can be learned, and a function that evaluates them.

A rule is called with the copies, :class:`CultureCore`, of which it looks only at what ``car_0`` sees, and returns actions, int
[n_copies].
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from sb3_belief.envs.junction_cultures.config import CultureConfig
from sb3_belief.envs.junction_cultures.core import CultureCore
from sb3_belief.envs.traffic_junction.core import BRAKE, GAS

Rule: TypeAlias = Callable[[CultureCore], np.ndarray]


def follows_culture(core: CultureCore) -> np.ndarray:
    """
    Do as the others do, knowing the culture.

    :param core: The copies
    :return: int [n_copies]
    """
    return core.ruled(core.config.priorities[core.types.current])[:, 0]


def follows_reverse(core: CultureCore) -> np.ndarray:
    """
    Do the opposite of the culture: go first where the others do.

    :param core: The copies
    :return: int [n_copies]
    """
    ranks = core.config.priorities
    return core.ruled((ranks.max() - ranks)[core.types.current])[:, 0]


class Yields:
    """
    Rule without knowledge of the culture: brake for a car in the next cell, and perhaps for one from elsewhere that wants it.

    :param probability: With which the car brakes for one that wants the same next cell: 1 yields always, 0 never
    :param seed: Seed of the rule's random generator
    """

    def __init__(self, probability: float = 1.0, seed: int = 0):
        self.probability, self.rng = probability, np.random.default_rng(seed)

    def __call__(self, core: CultureCore) -> np.ndarray:
        """
        Choose an action in each copy.

        :param core: The copies
        :return: int [n_copies]
        """
        occupied, crossing = core.conflicts()
        # From the same entry the lower number goes first in all cultures, and no number is lower
        elsewhere = core.entries != core.entries[:, :1]
        doubts = (crossing[:, 0] & elsewhere).any(axis=1)
        brakes = occupied[:, 0].any(axis=1) | (doubts & (self.rng.random(core.n_copies) < self.probability))
        return np.where(brakes, BRAKE, GAS)


@dataclass(frozen=True)
class LifeResult:
    """
    Result of :func:`evaluate_culture_rule`, for the learner alone.

    :param return_per_life: All its rewards, divided by the number of its cars that arrived
    :param collisions: Collisions per arrival
    :param steps: Steps on the road per arrival
    :param lives: Number of arrivals
    """

    return_per_life: float
    collisions: float
    steps: float
    lives: int


def evaluate_culture_rule(rule: Rule, episodes: int = 4096, seed: int = 0, n_envs: int = 64, **env_kwargs: Any) -> LifeResult:
    """
    Evaluate a rule per life of the learner.

    Rewards of cars that the end of an episode cuts off count as well, so that who never arrives does not look good.

    :param rule: Maps the copies to actions
    :param episodes: Smallest number of episodes, at least 1, rounded up to a multiple of ``n_envs``
    :param seed: Copy i is seeded with ``seed + i``
    :param n_envs: Number of environment copies
    :param env_kwargs: Arguments of the environment
    :return: Return, collisions and steps per life
    :raises ValueError: If ``episodes`` is not positive
    """
    if episodes < 1:
        raise ValueError(f"episodes={episodes} must be at least 1.")
    core = CultureCore(n_envs, CultureConfig(**env_kwargs))
    for copy in range(n_envs):
        core.seed(copy, seed + copy)
    core.reset()
    core.observe()
    total, n_collisions, n_steps, lives = 0.0, 0, 0, 0
    for _ in range(-(-episodes // n_envs) * core.traffic.max_steps):
        step = core.step(rule(core))
        total += float(step.rewards[:, 0].sum())
        n_collisions += int(step.partners[:, 0].sum())
        n_steps += int(step.acted[:, 0].sum())
        lives += int(step.left[:, 0].sum())
        if step.dones.any():
            core.reset(np.flatnonzero(step.dones))
        core.observe()
    arrived = max(lives, 1)
    return LifeResult(total / arrived, n_collisions / arrived, n_steps / arrived, lives)
