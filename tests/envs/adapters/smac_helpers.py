"""Makers and helpers that the tests of SMAC and SMACv2 share."""

from functools import partial
from typing import Any

from sb3_belief import team
from sb3_belief.envs.adapters import smac, smacv2

# Typed as Any, since the tests also look at attributes that the public types do not have
make: Any = smac.make
make_v2: Any = smacv2.make
make_team_env: Any = team.make_team_env

MAKERS = [partial(make, "3m"), partial(make, "2s3z"), partial(make_v2, "protoss_5_vs_5"), partial(make_v2, "zerg_10_vs_11")]


def random_play(env, generator, act=None):
    """
    Step with random legal actions.

    :param env: The environment
    :param generator: Where the actions are drawn from
    :param act: Actions of some agents, in place of random ones
    :return: What ``step`` returns
    """
    masks = {agent: env._masks[i] for i, agent in enumerate(env.possible_agents)}
    chosen = {agent: int((generator.random(mask.shape) * mask).argmax()) for agent, mask in masks.items()}
    return env.step({**chosen, **(act or {})})


def near_the_limit(env, steps_left):
    """Set the clock of the battle so that this number of steps is left."""
    game = getattr(env.game, "env", env.game)
    game._episode_steps = game.episode_limit - steps_left


def hide(env):
    """Put the two sides so far apart that they never meet and the battle never ends."""
    for side, x in ((env.game.agents, 2.0), (env.game.enemies, 30.0)):
        for unit in side.values():
            unit.pos.x = x


def still(env):
    """Return actions with which all units stay where they are: 0 for the dead, 1 for the others."""
    return {agent: 0 if env._masks[i, 0] else 1 for i, agent in enumerate(env.possible_agents)}
