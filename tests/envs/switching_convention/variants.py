"""Arguments of the switching conventions that the tests of both forms are parametrised with."""

from typing import Any

VARIANTS: list[dict[str, Any]] = [
    {},
    {"m": 2, "K": 1, "rollout_steps": 1, "seed": 3},
    {"m": 5, "K": 3, "rollout_steps": 4, "rewarded": "last", "seed": 1},
    {"K": None, "rollout_steps": 3},
    {"K": 2, "rollout_steps": 5, "leader_visible": False},
]
