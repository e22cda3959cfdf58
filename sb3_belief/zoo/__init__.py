"""From a few lines of YAML to a run on disk: training, replaying, and the demo."""

from sb3_belief.zoo.rl_zoo3 import register_rl_zoo3

__all__ = ["register_rl_zoo3"]
