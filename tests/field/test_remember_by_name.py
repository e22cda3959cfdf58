"""What the others did can be remembered by their names, in their own spaces, instead of as flattened rows."""

from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from tests.belief_ppo.helpers import make_model

OTHERS: dict[str, Any] = {
    "b": spaces.Discrete(3, start=1),
    "c": spaces.MultiDiscrete([2, 3]),
    "d": spaces.MultiBinary(2),
    "e": spaces.Box(-1, 1, (2,), np.float32),
}
N = 6


@pytest.fixture
def policy():
    return make_model(n_envs=1, env_kwargs=dict(others=OTHERS)).policy


@pytest.fixture
def steps():
    """Observations, the others' actions by name, and the same actions as ``info["others_actions"]`` has them."""
    observations = np.random.default_rng(0).normal(size=(N, 5)).astype(np.float32)
    for name, space in OTHERS.items():
        space.seed(len(name))
    taken = {name: np.stack([space.sample() for _ in range(N)]) for name, space in OTHERS.items()}
    flat = [np.concatenate([spaces.flatten(OTHERS[name], taken[name][i]) for name in OTHERS]) for i in range(N)]
    return observations, taken, np.stack(flat).astype(np.float32)


def remembered(policy):
    return policy.history.actions[policy.history.valid].numpy()


def test_actions_by_name_are_those_of_the_rows(policy, steps):
    observations, taken, rows = steps
    policy.remember(observations, taken)
    assert (remembered(policy) == rows).all() and len(remembered(policy)) == N
    by_name = policy.history
    policy.remember(observations, rows)
    assert th.equal(policy.history.actions[N : 2 * N], by_name.actions[:N])
    # The order of the names does not matter, and lists are as good as arrays
    policy.remember(observations, {name: taken[name].tolist() for name in reversed(OTHERS)})
    assert th.equal(policy.history.actions[2 * N : 3 * N], by_name.actions[:N])


def test_who_was_not_visible_is_zero_whatever_stands_there(policy, steps):
    observations, taken, rows = steps
    seen = np.arange(N) % 2 == 0
    expected = rows.copy()
    expected[~seen, :3] = 0
    taken["b"] = np.where(seen, taken["b"], -7)
    policy.remember(observations, taken, visible={"b": seen})
    assert (remembered(policy) == expected).all()
    policy.remember(observations, rows, visible={"b": seen})
    assert (remembered(policy)[N:] == expected).all()
    # Who is left out was not visible at all
    policy.remember(observations, {"c": taken["c"]})
    expected[:, :3] = expected[:, 8:] = 0
    assert (remembered(policy)[2 * N :] == expected).all()


def test_a_single_step(policy, steps):
    observations, taken, rows = steps
    policy.remember(observations[0], {name: actions[0] for name, actions in taken.items()})
    assert (remembered(policy) == rows[:1]).all()
    # Plain numbers too
    policy.remember(observations[0], {"b": int(taken["b"][0])})
    assert (remembered(policy)[1, :3] == rows[0, :3]).all()


@pytest.mark.parametrize(
    ("actions", "visible", "message"),
    [
        ({"x": np.zeros(N)}, None, "'x' is none of the others that the belief is about: b, c, d, e"),
        ({"b": np.ones(N, dtype=int)}, {"x": np.ones(N, dtype=bool)}, "'x' is none of the others"),
        ({"b": np.ones(N - 1, dtype=int)}, None, r"'b' have the shape \(5,\); 6 steps in Discrete.* need \(6,\)"),
        ({"c": np.zeros(N, dtype=int)}, None, r"'c' have the shape \(6,\); .* need \(6, 2\)"),
        ({"b": np.zeros(N, dtype=int)}, None, "0.* is no action of 'b', whose space is Discrete"),
        ({"b": np.ones(N)}, None, "1.0.* is no action of 'b'"),
        ({"e": np.full((N, 2), np.nan)}, None, "nan.* is no action of 'e'"),
        ({"b": np.ones(N, dtype=int)}, {"b": np.ones(3, dtype=bool)}, r"visible\['b'\] is bool of the shape \(3,\)"),
        ({"b": np.ones(N, dtype=int)}, {"b": np.ones(N)}, r"visible\['b'\] is float64"),
    ],
)
def test_what_does_not_fit_is_refused_before_anything_is_remembered(policy, steps, actions, visible, message):
    with pytest.raises(ValueError, match=message):
        policy.remember(steps[0], actions, visible)
    assert not policy.history.valid.any()


def test_an_agent_adapts_to_what_it_remembers_by_name():
    """The belief is the same as from rows: named actions reach what policy and prediction are computed from."""
    one, two = (make_model(n_envs=1).policy for _ in range(2))
    observations = np.random.default_rng(1).normal(size=(30, 5)).astype(np.float32)
    taken = np.random.default_rng(2).integers(3, size=30)
    before = one.predict_others(observations[:4]).mean
    one.remember(observations, {"b": taken})
    rows = np.concatenate([np.eye(3)[taken], np.zeros((30, 4))], axis=1).astype(np.float32)
    two.remember(observations, rows)
    assert (one.predict_others(observations[:4]).mean == two.predict_others(observations[:4]).mean).all()
    assert not np.allclose(one.predict_others(observations[:4]).mean, before)
