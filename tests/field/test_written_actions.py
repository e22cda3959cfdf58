"""Environments that use the arrays of actions for their own calculations."""

import numpy as np
import pytest
from gymnasium import spaces

from sb3_belief import BeliefPPO
from tests.field.walkers import Walkers
from tests.team.helpers import Team, make_team_env


class WritesIntoActions(Walkers):
    """An environment that uses the arrays of the actions for its own calculations."""

    act_space: spaces.Space = spaces.MultiDiscrete([3, 3])

    def step(self, actions):
        for action in actions.values():
            action[:] = 2
        return super().step(actions)


class WritesIntoNumbers(WritesIntoActions):
    act_space = spaces.Box(-1, 2, (2,), np.float32)


@pytest.mark.parametrize("env_class", [WritesIntoActions, WritesIntoNumbers])
def test_what_an_environment_does_to_the_actions_reaches_nobody(env_class):
    """Neither the agent's own rollout nor what the others see of it."""
    team = Team(BeliefPPO, "BeliefPolicy", make_team_env(env_class), seed=0, n_steps=32, batch_size=32, device="cpu").learn(32)
    first, second = (model.rollout_buffer for model in team.agents.values())
    assert not (first.actions == 2).all() and not (second.actions == 2).all()
    if env_class is WritesIntoActions:
        taken = np.eye(3, dtype=np.float32)[first.actions.reshape(-1, 2).astype(int)].reshape(-1, 6)
    else:
        taken = np.clip(first.actions.reshape(-1, 2), -1, 2)
    np.testing.assert_allclose(second.others_actions, taken, atol=1e-6)
