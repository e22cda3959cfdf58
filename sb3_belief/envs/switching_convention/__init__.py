"""Switching conventions: a follower must do what a scripted leader does, who changes its mind."""

from sb3_belief.envs.switching_convention.parallel_env import SwitchingConvention

__all__ = ["SwitchingConvention"]
