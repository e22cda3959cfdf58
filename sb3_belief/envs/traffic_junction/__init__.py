"""Traffic Junction: cars with a short range of sight have to cross a junction without a collision."""

from sb3_belief.envs.traffic_junction.parallel_env import TrafficJunction

__all__ = ["TrafficJunction"]
