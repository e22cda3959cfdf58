"""Tiny cooperative games whose best play is known by hand, for tests of learners."""

from sb3_belief.envs.matrix_games.cues import Cues
from sb3_belief.envs.matrix_games.hidden_offset import HiddenOffset
from sb3_belief.envs.matrix_games.levers import Levers
from sb3_belief.envs.matrix_games.matrix_game import MatrixGame, Penalty, Permutation
from sb3_belief.envs.matrix_games.two_step import TwoStep

__all__ = ["Cues", "HiddenOffset", "Levers", "MatrixGame", "Penalty", "Permutation", "TwoStep"]
