"""Environments: a registry of ids, and this package's own PettingZoo environments."""

from sb3_belief.envs.registry import EnvSpec, make_batched_env, make_parallel_env, registered_ids, spec
from sb3_belief.envs.switching_convention import SwitchingConvention
from sb3_belief.envs.traffic_junction import TrafficJunction

__all__ = [
    "EnvSpec",
    "SwitchingConvention",
    "TrafficJunction",
    "make_batched_env",
    "make_parallel_env",
    "registered_ids",
    "spec",
]
