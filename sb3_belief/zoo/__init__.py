"""Training from YAML: runs on disk, their replay, the command line and the demo."""

from sb3_belief.zoo.rl_zoo3 import register_rl_zoo3

__all__ = ["register_rl_zoo3"]
