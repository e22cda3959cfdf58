"""Makers and helpers that the tests of SMAX share."""

from typing import Any

import numpy as np

from sb3_belief.envs.adapters import smax

# Typed as Any, since the tests also look at attributes that the public types do not have
make: Any = smax.make
make_batched: Any = smax.make_batched

# Enemies that do not shoot, so that random play neither wins nor loses soon
PEACE: dict[str, Any] = {"enemy_shoots": False, "walls_cause_death": False}

UNIT_FEATURES, OWN_FEATURES, STOP = 13, 10, 4


def masked_choice(masks, generator):
    """Return random legal actions of all agents, ``[n_copies]`` each."""
    return {agent: (generator.random(mask.shape) * mask).argmax(axis=-1) for agent, mask in masks.items()}


def set_step(state, step):
    """Change a copy's state as if ``step`` steps of the episode had been made."""
    # The step counter is the only integer scalar of the state
    (index,) = [k for k, leaf in enumerate(state["leaves"]) if leaf.shape == () and leaf.dtype == np.int32]
    state["leaves"][index] = np.array(step, dtype=np.int32)


def attack(env):
    """Return actions of a team that walks right until it can shoot, and then shoots at the enemy with the lowest number."""
    masks = env.battles.masks[:, 0]
    return {
        agent: int(mask[5:].argmax()) + 5 if mask[5:].any() else (1 if mask[1] else STOP)
        for agent, mask in zip(env.possible_agents, masks, strict=True)
    }
