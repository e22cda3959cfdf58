"""Aisle sides: robots that meet head-on in the aisles of a warehouse have to keep to the side that is the custom there."""

from sb3_belief.envs.aisle_sides.parallel_env import AisleSides

__all__ = ["AisleSides"]
