"""Switching conventions: a follower has to match a scripted leader, which changes its behaviour from time to time."""

from sb3_belief.envs.switching_convention.parallel_env import SwitchingConvention

__all__ = ["SwitchingConvention"]
