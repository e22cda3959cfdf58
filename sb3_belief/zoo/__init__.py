"""Training from YAML: runs on disk, their replay, the command line and the demo."""

from typing import TYPE_CHECKING

from sb3_belief.common.lazy_imports import lazy_attributes

if TYPE_CHECKING:
    from sb3_belief.zoo.rl_zoo3 import register_rl_zoo3
else:
    # It takes torch and SB3 with it, which the help of the command line does not need
    __getattr__, __dir__ = lazy_attributes(__name__, {"register_rl_zoo3": "sb3_belief.zoo.rl_zoo3"})

__all__ = ["register_rl_zoo3"]
