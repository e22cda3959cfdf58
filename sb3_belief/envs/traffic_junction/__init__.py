"""Traffic Junction: cars that see little cross a junction without a collision."""

from sb3_belief.envs.traffic_junction.parallel_env import TrafficJunction

__all__ = ["TrafficJunction"]
