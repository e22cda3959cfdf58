"""Replay of whole episodes, and returns from their own last step."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_belief.references.episodes import EpisodeReplayBuffer, lambda_returns

N, D, U, S = 2, 3, 2, 4
OBS_SPACE = spaces.Dict(
    {
        "obs": spaces.Box(-np.inf, np.inf, (N, D)),
        "mask": spaces.MultiBinary((N, U)),
        "active": spaces.MultiBinary(N),
        "state": spaces.Box(-np.inf, np.inf, (S,)),
    }
)
ACTION_SPACE = spaces.MultiDiscrete([U] * N)


def joint_obs(numbers, mask=1):
    """Joint observations of copies that are told apart by a number."""
    ones = np.asarray(numbers, dtype=np.float32)
    return {
        "obs": np.broadcast_to(ones[:, None, None], (len(ones), N, D)),
        "mask": np.full((len(ones), N, U), mask, dtype=np.int8),
        "active": np.ones((len(ones), N), dtype=np.int8),
        "state": np.broadcast_to(ones[:, None], (len(ones), S)),
    }


def replay(buffer_size=10, n_envs=2):
    return EpisodeReplayBuffer(buffer_size, OBS_SPACE, ACTION_SPACE, "cpu", n_envs)


def play(buffer, steps):
    """Add steps of the only copy with a number each: (number, next number, reward, done, truncated)."""
    starts = np.array([True])
    for number, after, reward, done, truncated in steps:
        buffer.begin(starts)
        starts = np.array([done])
        buffer.add(
            joint_obs([number]),
            joint_obs([after]),
            np.array([[number % U, 1]]),
            np.array([reward]),
            np.array([done]),
            [{"TimeLimit.truncated": truncated}],
        )


@pytest.mark.parametrize(
    ("end", "bootstrap", "expected"), [(1.0, 0.0, [2.4112, 1.71, 2.0]), (0.0, 3.0, [3.81088, 3.654, 4.7])]
)
def test_returns_by_hand(end, bootstrap, expected):
    # Next to an episode that is longer, to whose end the returns must not reach
    rewards = th.tensor([[1.0, 0.0, 2.0, 100.0, 100.0], [1.0] * 5])
    values = th.tensor([[1.0, 1.5, bootstrap, 77.0, 77.0], [1.0] * 5])
    ends = th.tensor([[0.0, 0.0, end, 0.0, 0.0], [0.0] * 5])
    exists = th.tensor([[1.0, 1.0, 1.0, 0.0, 0.0], [1.0] * 5])
    returns = lambda_returns(rewards, ends, exists, values, 0.9, 0.8)
    assert returns[0, :3].tolist() == pytest.approx(expected, abs=1e-5)


def test_one_step_targets():
    rewards, values = th.tensor([[1.0, 2.0, 3.0]]), th.tensor([[10.0, 20.0, 30.0]])
    returns = lambda_returns(rewards, th.tensor([[0.0, 0.0, 1.0]]), th.ones(1, 3), values, 0.5, 0.0)
    assert returns.tolist() == [[6.0, 12.0, 3.0]]


def test_an_episode_is_there_from_its_end_on():
    buffer = replay(n_envs=1)
    play(buffer, [(1, 2, 0.5, False, False)])
    assert buffer.size() == 0
    buffer.add(joint_obs([2]), joint_obs([3]), np.array([[0, 1]]), np.array([1.5]), np.array([True]), [{}])
    assert buffer.size() == 1
    batch = buffer.sample(1)
    assert batch.obs[0, :, 0, 0].tolist() == [1, 2, 3] and batch.state[0, :, 0].tolist() == [1, 2, 3]
    assert batch.actions[0].tolist() == [[1, 1], [0, 1]] and batch.rewards[0].tolist() == [0.5, 1.5]
    assert batch.ends[0].tolist() == [0, 1] and batch.exists[0].tolist() == [1, 1]
    assert batch.mask.dtype == th.bool and batch.actions.dtype == th.int64


def test_a_limit_is_no_end():
    buffer = replay(n_envs=1)
    play(buffer, [(1, 2, 0.0, True, True)])
    assert buffer.sample(1).ends.tolist() == [[0.0]]


def test_own_lengths():
    buffer = replay(n_envs=1)
    play(buffer, [(1, 2, 1.0, True, False), (3, 4, 1.0, False, False), (4, 5, 1.0, False, False), (5, 6, 1.0, True, False)])
    batch = buffer.batch(buffer.episodes)
    assert batch.exists.tolist() == [[1, 0, 0], [1, 1, 1]] and batch.obs[0, :, 0, 0].tolist() == [1, 2, 0, 0]
    assert batch.mask[0].all(), "a maximum over no action would be minus infinity"


def test_the_oldest_makes_room():
    buffer = replay(buffer_size=2, n_envs=1)
    for number in range(5):
        play(buffer, [(number, number, float(number), True, False)])
    assert buffer.size() == 2 and sorted(episode["rewards"][0] for episode in buffer.episodes) == [3, 4]


def test_copies_do_not_mix():
    buffer = replay(n_envs=2)
    buffer.begin(np.array([True, True]))
    for t in range(2):
        done = np.array([t == 1, False])
        buffer.add(joint_obs([t, 10 + t]), joint_obs([t + 1, 11 + t]), np.ones((2, N)), np.array([1.0, 2.0]), done, [{}, {}])
    assert buffer.size() == 1 and buffer.sample(1).rewards.tolist() == [[1.0, 1.0]]


def test_steps_of_an_episode_that_was_given_up_are_forgotten():
    buffer = replay(n_envs=1)
    play(buffer, [(1, 2, 9.0, False, False)])
    play(buffer, [(5, 6, 1.0, True, False)])
    assert buffer.sample(1).rewards.tolist() == [[1.0]]


def test_an_episode_whose_beginning_is_not_known_is_left_out():
    buffer = replay(n_envs=1)
    for done in (False, True):
        buffer.add(joint_obs([1]), joint_obs([2]), np.array([[0, 1]]), np.array([1.0]), np.array([done]), [{}])
    assert buffer.size() == 0


def test_what_the_environment_overwrites_is_kept():
    buffer = replay(n_envs=1)
    obs, actions = {key: value.copy() for key, value in joint_obs([1]).items()}, np.ones((1, N), dtype=int)
    buffer.begin(np.array([True]))
    for done in (False, True):
        buffer.add(obs, joint_obs([2]), actions, np.array([1.0]), np.array([done]), [{}])
        obs["obs"][:], actions[:] = 99, 0
    assert buffer.sample(1).obs[0, 0, 0, 0] == 1 and buffer.sample(1).actions[0, 0, 0] == 1
