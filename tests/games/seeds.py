"""
With which seeds games are played: as many as GAME_SEEDS says, or what CI has time for.

    make test-games   # five, which takes most of an hour
"""

import os

_GIVEN = os.environ.get("GAME_SEEDS")
SEEDS = range(int(_GIVEN or 1))
