"""Arguments of the aisles that the tests of both forms are parametrised with."""

from typing import Any

VARIANTS: list[dict[str, Any]] = [
    {},
    {"kinds": 3, "n_robots": 2, "redraw_every": 1, "rollout_steps": 7, "partner_seed": 3, "max_steps": 11},
    {"redraw_unit": "episodes", "per_copy": True, "redraw_every": 2, "max_steps": 9, "reveal_partner": True},
    {"kinds": 4, "held_out": True, "per_copy": True, "rollout_steps": 5, "redraw_every": 2, "reveal_partner": True},
    {"length": 4, "sight": 2, "traffic": 1.0, "jam_steps": 1, "redraw_every": None, "n_robots": 2, "others_visible": False},
]
