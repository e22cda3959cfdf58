"""What was made from weights and history is made anew when they have changed."""

import pickle
import weakref
from copy import deepcopy

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_belief.belief_ppo import BeliefActorCriticPolicy
from sb3_belief.common.tensor_version import TensorVersions


def make_policy():
    th.manual_seed(0)
    space, others = spaces.Box(-10, 10, (4,)), {"other": spaces.Discrete(3)}
    policy = BeliefActorCriticPolicy(space, spaces.Discrete(2), lambda _: 1e-2, others_action_spaces=others, history_length=20)
    policy.remember(
        np.random.default_rng(0).normal(size=(20, 4)).astype(np.float32), np.eye(3, dtype=np.float32)[np.arange(20) % 3]
    )
    return policy


@pytest.mark.parametrize("copy", [lambda policy: policy, deepcopy, lambda policy: pickle.loads(pickle.dumps(policy))])
def test_a_step_of_the_fused_optimiser_is_seen(copy):
    policy, observation = copy(make_policy()), np.ones((1, 4), dtype=np.float32)
    before = policy.predict_others(observation)
    assert policy.optimizer.defaults["fused"]
    values, log_prob, _ = policy.evaluate_actions(th.randn(8, 4), th.zeros(8))
    (values - log_prob).sum().backward()
    policy.optimizer.step()
    after = policy.predict_others(observation)
    # As a policy that has kept nothing
    fresh = make_policy()
    fresh.load_state_dict(policy.state_dict())
    assert np.array_equal(after.mean, fresh.predict_others(observation).mean)
    assert not np.array_equal(after.mean, before.mean)


def test_writes_and_replacements_are_seen():
    a, b = th.ones(3), th.nn.Parameter(th.ones(2))
    watch = TensorVersions()
    assert watch.changed([a, b]) and not watch.changed([a, b])
    a.add_(1)
    assert watch.changed([a, b]) and not watch.changed([a, b])
    b.data = th.zeros(2)
    assert watch.changed([a, b]) and not watch.changed([a, b])
    assert watch.changed([a.clone(), b])


def test_what_was_seen_is_held_so_that_nothing_else_comes_to_lie_in_its_place():
    watch, tensors = TensorVersions(), [th.ones(50)]
    seen = weakref.ref(tensors[0])
    watch.changed(tensors)
    tensors[0] = th.ones(50)
    assert seen() is not None
    assert watch.changed(tensors) and seen() is None
