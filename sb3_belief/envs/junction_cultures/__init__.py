"""Junction cultures: one car learns in the traffic of scripted ones, whose right of way is the custom of the place."""

from sb3_belief.envs.junction_cultures.parallel_env import JunctionCultures

__all__ = ["JunctionCultures"]
