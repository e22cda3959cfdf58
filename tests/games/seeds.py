"""
With which seeds the games of the comparison set are played: with the first one, as CI does, or as many as GAME_SEEDS says.

    make test-games   # five, which takes most of an hour
"""

import os

SEEDS = range(int(os.environ.get("GAME_SEEDS", "1")))
