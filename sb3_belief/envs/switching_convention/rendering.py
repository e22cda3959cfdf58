"""Pictures of a switching convention."""

import numpy as np

from sb3_belief.envs.pictures import AGENT_COLOURS, GridPicture
from sb3_belief.envs.switching_convention.game import ConventionGame

_CUE, _CUE_NOW, _ACTION = (226, 226, 220), (248, 206, 70), (206, 214, 236)
_LEADER, _HIT, _MISS = AGENT_COLOURS[0], (52, 178, 120), (214, 78, 96)


def draw_convention(game: ConventionGame, copy: int) -> np.ndarray:
    """
    Draw one copy: the cues, with the one that the follower observes now; the leader's action at each cue; and the actions of
    the last step, the leader's and the follower's, which is green if it was the same.

    :param game: The copies
    :param copy: Index of the copy
    :return: uint8 [height, width, 3]
    :raises ImportError: If pygame is not installed
    """
    picture = GridPicture(4, game.config.m)
    for cue, action in enumerate(game.conventions[copy]):
        picture.square(0, cue, _CUE_NOW if cue == game.cue[copy] else _CUE, str(cue), size=0.9)
        picture.square(1, cue, _ACTION, str(action), size=0.9)
    if game.time[copy] > 0:
        leader, follower = int(game.leader[copy]), int(game.follower[copy])
        picture.disc(2, leader, _LEADER, str(leader))
        picture.disc(3, follower, _HIT if leader == follower else _MISS, str(follower))
    return picture.image()
