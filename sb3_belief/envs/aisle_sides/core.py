"""
The rules of the aisles, for many copies at once.

:class:`AisleCore` takes and returns arrays [n_copies, n_robots]. Names of agents, dictionaries and Gym interfaces are added by
the environments that use it.
"""

from dataclasses import asdict
from typing import Any

import numpy as np

from sb3_belief.envs.aisle_sides.config import LEFT, MIDDLE, AisleConfig, convention_sides
from sb3_belief.envs.base import check_same_arguments
from sb3_belief.envs.drawn_types import DrawnTypes

NOBODY = -1
"""Position of the other robot of an aisle that has none."""


class AisleCore:
    """
    ``n_copies`` independent warehouses that are stepped together.

    Each copy has a random generator of its own, and all random numbers of an episode are drawn at its start in one call. A
    copy with a given seed therefore behaves the same alone and in a batch.

    The order of events in a step: another robot that was passed turns off; robots that face each other and may move pass or
    jam; all that are free move; another robot may enter.

    :param n_copies: Number of environment copies
    :param config: The rules
    """

    def __init__(self, n_copies: int, config: AisleConfig):
        self.config, self.n_copies = config, n_copies
        self.sides = convention_sides(config.kinds)
        self.generators = [np.random.default_rng() for _ in range(n_copies)]
        shape = (n_copies, config.n_robots)
        self.position = np.zeros(shape, dtype=np.int64)
        # Position and kind of the other robot of the aisle, which drives towards position 0
        self.other = np.full(shape, NOBODY)
        self.kind = np.zeros(shape, dtype=np.int64)
        # Steps until a jam dissolves, 0 where there is none
        self.jam = np.zeros(shape, dtype=np.int64)
        # The actions of the last step. The learners' are for pictures only
        self.action = np.zeros(shape, dtype=np.int64)
        self.other_action = np.zeros(shape, dtype=np.int64)
        # Whether the learner could see the other robot when the last actions were chosen
        self.saw = np.zeros(shape, dtype=bool)
        self.time = np.zeros(n_copies, dtype=np.int64)
        # The random numbers of each step and aisle: whether a robot enters, and its kind. They lie in [0, 1)
        self.draws = np.zeros((n_copies, config.max_steps, config.n_robots, 2))
        self.types = DrawnTypes(n_copies, config, config.weights)
        self._copy = np.arange(n_copies)

    @property
    def gap(self) -> np.ndarray:
        """How many cells ahead the other robot is, int [n_copies, n_robots]. Not positive where there is none ahead."""
        return np.where(self.other == NOBODY, 0, self.other - self.position)

    @property
    def in_sight(self) -> np.ndarray:
        """Whether a learner sees the other robot of its aisle, bool [n_copies, n_robots]."""
        gap = self.gap
        return (gap > 0) & (gap <= self.config.sight)

    @property
    def facing(self) -> np.ndarray:
        """Whether neither robot can move on before both have chosen a side, bool [n_copies, n_robots]."""
        gap = self.gap
        return (gap > 0) & (gap <= 2) & (self.jam == 0)

    def seed(self, copy: int, seed: int | None) -> None:
        """
        Seed one copy, which starts again with the first convention of its sequence.

        The convention changes at once. The new random generator is used from the copy's next reset on.

        :param copy: Index of the copy
        :param seed: Seed, or None for one from the operating system
        """
        self.generators[copy] = np.random.default_rng(seed)
        self.types.seed(copy, seed)

    def reset(self, copies: np.ndarray | None = None) -> None:
        """
        Start new episodes in empty aisles.

        :param copies: Indices of the copies to reset, int [k]. None for all
        """
        chosen = self._copy if copies is None else copies
        for array in (self.position, self.kind, self.jam, self.action, self.other_action, self.saw, self.time):
            array[chosen] = 0
        self.other[chosen] = NOBODY
        for copy in chosen:
            self.generators[copy].random(out=self.draws[copy])
        self.types.update(chosen)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Advance all copies by one step. No copy is reset.

        :param actions: 0 (middle), 1 (left) or 2 (right), int [n_copies, n_robots]. In a jam they are ignored
        :return: Rewards, float32 [n_copies, n_robots], and whether the step limit is reached, bool [n_copies]
        """
        rules, facing = self.config, self.facing
        self.saw = self.in_sight & rules.others_visible
        side = self.sides[self.types.current[:, None], self.kind]
        meets = facing & (actions != MIDDLE)
        self.action, self.other_action = actions, np.where(meets, side, MIDDLE)
        self.other[(self.other != NOBODY) & (self.other <= self.position)] = NOBODY

        jammed = self.jam > 0
        self.jam -= jammed
        passes = (meets & (actions == side)) | (jammed & (self.jam == 0))
        self.jam[meets & (actions != side)] = rules.jam_steps
        moves = passes | ~(facing | jammed)
        self.position += moves
        self.other -= moves & (self.other != NOBODY)
        self.position[self.position == rules.length] = 0
        self._enter()

        self.time += 1
        dones = self.time >= rules.max_steps
        self.types.step(dones)
        return (moves / rules.length).astype(np.float32), dones

    def _enter(self) -> None:
        draws = self.draws[self._copy, self.time]
        far = self.config.length - 1 - self.position > self.config.sight
        enters = (self.other == NOBODY) & far & (draws[:, :, 0] < self.config.traffic)
        self.other[enters] = self.config.length - 1
        self.kind[enters] = (draws[enters, 1] * self.config.kinds).astype(np.int64)

    def observe(self) -> np.ndarray:
        """
        Build the observations of the current state.

        :return: float32 [n_robots, n_copies, width], a new array, with the parts that
            :class:`~sb3_belief.envs.AisleSides` describes
        """
        rules = self.config
        obs = np.zeros((rules.n_robots, self.n_copies, observation_width(rules)), dtype=np.float32)
        obs[:, :, 0] = self.position.T / (rules.length - 1)
        obs[:, :, 1] = self.jam.T / rules.jam_steps
        robots, copies = np.nonzero(self.in_sight.T)
        obs[robots, copies, 1 + self.gap[copies, robots]] = 1.0
        obs[robots, copies, 2 + rules.sight + self.kind[copies, robots]] = 1.0
        if rules.reveal_partner:
            side = self.sides[self.types.current[copies], self.kind[copies, robots]]
            obs[robots, copies, 2 + rules.sight + rules.kinds + side - LEFT] = 1.0
        return obs

    def get_state(self, copy: int) -> dict[str, Any]:
        """
        Return everything that determines the following steps of one copy.

        :param copy: Index of the copy
        :return: Copies of arrays and plain data
        """
        return {
            "config": asdict(self.config),
            **{name: np.copy(getattr(self, name)[copy]) for name in _STATE_ARRAYS},
            "generator": self.generators[copy].bit_generator.state,
            "types": self.types.get_state(copy),
        }

    def set_state(self, copy: int, state: dict[str, Any]) -> None:
        """
        Restore one copy.

        :param copy: Index of the copy
        :param state: State that ``get_state`` returned for a copy with the same rules
        :raises ValueError: If the rules differ
        """
        check_same_arguments(state["config"], asdict(self.config))
        for name in _STATE_ARRAYS:
            # New arrays, since those of the last step may be the caller's own
            array = getattr(self, name).copy()
            array[copy] = state[name]
            setattr(self, name, array)
        self.generators[copy].bit_generator.state = state["generator"]
        self.types.set_state(copy, state["types"])


def observation_width(config: AisleConfig) -> int:
    """
    Return the number of entries of an observation.

    :param config: The rules
    :return: 2 for the robot itself, and the distance, kind and, if it is told, side of the one in sight
    """
    return 2 + config.sight + config.kinds + (2 if config.reveal_partner else 0)


_STATE_ARRAYS = ("position", "other", "kind", "jam", "action", "other_action", "saw", "time", "draws")
