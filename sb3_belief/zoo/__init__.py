"""Training from YAML: runs on disk, their replay, the command line and the demo."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sb3_belief.zoo.rl_zoo3 import register_rl_zoo3

__all__ = ["register_rl_zoo3"]


def __getattr__(name: str) -> Any:
    # Imported when it is asked for: it takes torch and SB3 with it, which the help of the command line does not need
    if name in __all__:
        from sb3_belief.zoo import rl_zoo3

        return getattr(rl_zoo3, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
