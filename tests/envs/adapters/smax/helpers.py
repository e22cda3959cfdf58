"""Helpers that the tests of SMAX share."""

from typing import Any

import numpy as np

from sb3_belief.envs.adapters import smax

# Tests look inside, at what the types do not promise
make: Any = smax.make


make_batched: Any = smax.make_batched


# The enemies do not shoot: battles that random play neither wins nor loses soon
PEACE: dict[str, Any] = {"enemy_shoots": False, "walls_cause_death": False}

UNIT_FEATURES, OWN_FEATURES, STOP = 13, 10, 4


def masked_choice(masks, generator):
    return {agent: (generator.random(mask.shape) * mask).argmax(axis=-1) for agent, mask in masks.items()}


def set_step(state, step):
    """
    Change a copy's state as if ``step`` steps had been made: it is the only whole number of its own that starts at 0.
    """
    (index,) = [k for k, leaf in enumerate(state["leaves"]) if leaf.shape == () and leaf.dtype == np.int32]
    state["leaves"][index] = np.array(step, dtype=np.int32)


def attack(env):
    """
    :return: actions of a team that goes right until it can shoot, then at the enemy with the lowest number
    """
    masks = env.battles.masks[:, 0]
    return {
        agent: int(mask[5:].argmax()) + 5 if mask[5:].any() else (1 if mask[1] else STOP)
        for agent, mask in zip(env.possible_agents, masks, strict=True)
    }
