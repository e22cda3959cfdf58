"""What was made from weights and history is made anew when they have changed."""

import pickle
from copy import deepcopy

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_belief.belief_ppo import BeliefActorCriticPolicy
from sb3_belief.common.kept_tensors import KeptTensors


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


def write_in_place(tensor):
    tensor.add_(1)


def write_through_data(tensor):
    tensor.data.mul_(2)


def write_through_numpy(tensor):
    tensor.detach().numpy()[..., -1] = 7


def replace_data(tensor):
    tensor.data = th.zeros_like(tensor)


def initialise_data(tensor):
    th.nn.init.zeros_(tensor.data)


WRITES = [write_in_place, write_through_data, write_through_numpy, replace_data, initialise_data]


@pytest.mark.parametrize("write", WRITES)
@pytest.mark.parametrize("watched", [lambda x: x, lambda x: x.mT], ids=["contiguous", "transposed"])
def test_every_write_is_seen_once(write, watched):
    others, tensor = th.full((3,), th.nan), th.ones(2, 4)
    watch = KeptTensors()

    def changed():
        return watch.changed([others, watched(tensor)])

    assert changed() and not changed()
    write(tensor)
    assert changed() and not changed()


def test_a_replaced_tensor_is_seen_if_it_holds_something_else():
    watch = KeptTensors()
    assert watch.changed([th.ones(3)])
    assert watch.changed([th.zeros(3)])
    assert watch.changed([th.zeros(2)])
    assert watch.changed([th.zeros(2), th.zeros(2)])


@pytest.mark.parametrize("write", WRITES)
@pytest.mark.parametrize(
    "name", ["belief.value.weight", "belief.observation_embedding.0.bias", "history_actions", "history_observations"]
)
def test_a_belief_follows_every_write_to_weights_and_history(write, name):
    policy, observation = make_policy(), np.ones((1, 4), dtype=np.float32)
    policy.predict_others(observation)
    with th.no_grad():
        write(dict([*policy.features_extractor.named_parameters(), *policy.features_extractor.named_buffers()])[name])
    after = policy.predict_others(observation)
    fresh = make_policy()
    fresh.load_state_dict(policy.state_dict())
    assert np.array_equal(after.mean, fresh.predict_others(observation).mean)
