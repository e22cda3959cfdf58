"""Torch's distributions leave out their checks where a policy is trained; numbers that are none are noticed all the same."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from torch.distributions import Categorical, Distribution

from sb3_belief.belief_ppo import BeliefActorCriticPolicy

OBSERVATIONS = spaces.Box(-1, 1, (3,), np.float32)
ACTIONS = {
    "Discrete": spaces.Discrete(3),
    "MultiDiscrete": spaces.MultiDiscrete([2, 3]),
    "MultiBinary": spaces.MultiBinary(2),
    "Box": spaces.Box(-1, 1, (2,), np.float32),
}


def make(actions, belief):
    others = {} if belief == "none" else {"other": spaces.Discrete(2)}
    return BeliefActorCriticPolicy(OBSERVATIONS, actions, lambda _: 1e-3, others_action_spaces=others, belief=belief)


@pytest.mark.parametrize("belief", ["none", "dynamic"])
@pytest.mark.parametrize("actions", ACTIONS.values(), ids=ACTIONS)
@pytest.mark.parametrize("deterministic", [False, True])
def test_numbers_that_are_none_are_noticed(actions, belief, deterministic):
    policy = make(actions, belief)
    policy(th.zeros(2, 3), deterministic=deterministic)
    with th.no_grad():
        policy.action_net.bias.fill_(th.nan)
    with pytest.raises((ValueError, RuntimeError)):
        policy(th.zeros(2, 3), deterministic=deterministic)
    assert Distribution._validate_args


@pytest.mark.parametrize("belief", ["none", "dynamic"])
def test_checks_are_left_out_in_training_only(belief, monkeypatch):
    checked = []
    init = Categorical.__init__

    def noted(self, *args, **kwargs):
        init(self, *args, **kwargs)
        checked.append(self._validate_args)

    monkeypatch.setattr(Categorical, "__init__", noted)
    policy = make(spaces.Discrete(3), belief)
    observations = th.zeros(2, 3)
    actions = policy(observations)[0]
    policy.evaluate_actions(observations, actions)
    assert checked == [False, False]
    policy(observations, deterministic=True)
    policy.predict(np.zeros(3, dtype=np.float32))
    policy.get_distribution(observations)
    assert checked == [False, False, True, True, True]
