"""Environments: a registry of ids, the PettingZoo environments of this package, and adapters to those of other packages."""

from sb3_belief.envs.adapters.pettingzoo import to_parallel
from sb3_belief.envs.aisle_sides import AisleSides
from sb3_belief.envs.env_checker import check_team_env
from sb3_belief.envs.junction_cultures import JunctionCultures
from sb3_belief.envs.registry import EnvSpec, make_batched_env, make_parallel_env, register, registered_ids, spec
from sb3_belief.envs.suites import SUITES, Suite
from sb3_belief.envs.switching_convention import SwitchingConvention
from sb3_belief.envs.traffic_junction import TrafficJunction

# Earlier names of the two, which stay importable
FAMILIES, Family = SUITES, Suite

__all__ = [
    "FAMILIES",
    "SUITES",
    "AisleSides",
    "EnvSpec",
    "Family",
    "JunctionCultures",
    "Suite",
    "SwitchingConvention",
    "TrafficJunction",
    "check_team_env",
    "make_batched_env",
    "make_parallel_env",
    "register",
    "registered_ids",
    "spec",
    "to_parallel",
]
