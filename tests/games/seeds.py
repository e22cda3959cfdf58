"""
With which seeds games are played: as many as GAME_SEEDS says, or what CI has time for.

    make test-games   # five, which takes most of an hour
"""

import os

_GIVEN = os.environ.get("GAME_SEEDS")
#: Of the games of the comparison set
SEEDS = range(int(_GIVEN or 1))
#: Of the games that prove the belief dynamic, whose bars are for means over seeds
BELIEF_SEEDS = range(max(3, len(SEEDS)))
