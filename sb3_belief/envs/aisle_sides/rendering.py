"""Pictures of the aisles."""

from collections.abc import Sequence

import numpy as np

from sb3_belief.envs.aisle_sides.config import LEFT, MIDDLE
from sb3_belief.envs.aisle_sides.core import NOBODY, AisleCore
from sb3_belief.envs.pictures import AGENT_COLOURS, GridPicture, cell_position

_RACK, _JAM, _OTHER, _SIGN = (176, 168, 156), (250, 214, 206), (96, 98, 108), (248, 206, 70)
# Each aisle is three columns wide, and there is a rack on either side of it
_WIDTH = 4


def draw_aisles(core: AisleCore, copy: int) -> np.ndarray:
    """
    Draw one copy: learners, coloured, drive up, and others, grey, come down with their kind as a letter.

    Whoever has stepped aside in the last step, or stands in a jam since, is drawn there. A square in the upper row shows to
    which side each kind keeps (L or R), which no learner sees.

    :param core: The copies
    :param copy: Index of the copy
    :return: uint8 [height, width, 3]
    :raises ImportError: If pygame is not installed
    """
    rules, length = core.config, core.config.length
    columns = _columns(core)
    picture = GridPicture(length + 1, columns)
    for robot in range(rules.n_robots + 1):
        for row in range(1, length + 1):
            picture.square(row, _WIDTH * robot, _RACK, size=0.9)
    for kind, side in enumerate(core.sides[core.types.current[copy]]):
        if kind < columns:
            text = "LR"[side - LEFT] if rules.kinds == 1 else "ABCDEF"[kind] + "LR"[side - LEFT]
            picture.square(0, kind, _SIGN, text, size=0.9)
    for robot in range(rules.n_robots):
        if core.jam[copy, robot]:
            for cell in (core.position[copy, robot], core.other[copy, robot]):
                for column in range(1, _WIDTH):
                    picture.square(length - cell, _WIDTH * robot + column, _JAM, size=0.9)
        if core.other[copy, robot] != NOBODY:
            letter = "" if rules.kinds == 1 else "ABCDEF"[core.kind[copy, robot]]
            row, column = length - core.other[copy, robot], _column(core, copy, robot, other=True)
            picture.disc(row, column, _OTHER, letter, heading=(1, 0))
        row, column = length - core.position[copy, robot], _column(core, copy, robot)
        picture.disc(row, column, AGENT_COLOURS[robot % len(AGENT_COLOURS)], str(robot), heading=(-1, 0))
    return picture.image()


def robot_positions(core: AisleCore, copy: int, agents: Sequence[str]) -> dict[str, tuple[float, float]]:
    """
    Return where the learners are in the picture of a copy.

    :param core: The copies
    :param copy: Index of the copy
    :param agents: Names of the learners
    :return: {agent: (x, y)}, as fractions of its width and height, from the upper left corner
    """
    rows, columns = core.config.length + 1, _columns(core)
    return {
        agent: cell_position(rows - 1 - int(core.position[copy, i]), _column(core, copy, i), rows, columns)
        for i, agent in enumerate(agents)
    }


def _columns(core: AisleCore) -> int:
    # Wide enough for the signs of all kinds
    return max(_WIDTH * core.config.n_robots + 1, core.config.kinds)


def _column(core: AisleCore, copy: int, robot: int, other: bool = False) -> int:
    """Return the column of a robot, which is that of the middle unless it has just stepped aside."""
    middle = _WIDTH * robot + 2
    met = core.other_action[copy, robot] != MIDDLE
    if not met:
        return middle
    # A robot that comes down has its left where the other one has its right
    action = (core.other_action if other else core.action)[copy, robot]
    left = 1 if other else -1
    return middle + (left if action == LEFT else -left)
