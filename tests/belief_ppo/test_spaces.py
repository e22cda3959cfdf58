"""Observations and actions of every kind (see test_no_leak.py too, which trains in all of them)."""

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.torch_layers import CombinedExtractor
from torch.nn import functional as F

from sb3_belief.belief_ppo.buffers import read_others
from sb3_belief.belief_ppo.others import action_layout
from tests.belief_ppo.helpers import ROLLOUT, make_model

OTHERS: dict[str, dict[str, spaces.Space]] = {
    "one": {"b": spaces.Discrete(2)},
    "box": {"b": spaces.Box(-1, 1, (3,), np.float32), "c": spaces.Discrete(3)},
    "multi": {"b": spaces.MultiDiscrete([2, 3]), "c": spaces.MultiBinary(2)},
}


@pytest.mark.parametrize("others", OTHERS)
def test_learns_among_others_of_any_kind(others):
    model = make_model(env_kwargs=dict(others=OTHERS[others])).learn(2 * ROLLOUT)
    layout = model.policy.layout
    assert layout.width == sum(spaces.flatdim(space) for space in OTHERS[others].values())
    measured = model.logger.name_to_value
    assert measured["belief/first_log_ratio"] < 1e-5 and np.isfinite(measured["belief/action_loss"])
    assert ("belief/accuracy" in measured) == bool(layout.blocks)


def test_image_and_dict_observations_and_continuous_actions():
    space = spaces.Dict(
        vector=spaces.Box(-1, 1, (3,), np.float32), kind=spaces.Discrete(4), image=spaces.Box(0, 255, (3, 36, 36), np.uint8)
    )
    env_kwargs = dict(observation_space=space, action_space=spaces.Box(-1, 1, (2,), np.float32), inactive=3)
    policy_kwargs = dict(features_extractor_class=CombinedExtractor, belief_from_features=False)
    model = make_model(n_envs=2, env_kwargs=env_kwargs, policy_kwargs=policy_kwargs).learn(2 * 28)
    assert model.logger.name_to_value["belief/first_log_ratio"] < 1e-5
    history = model.policy.history
    assert history.observations.shape == (40, 3 + 4 + 3 * 36 * 36)
    # Preprocessed as the policy sees it: images in [0, 1], discrete values one-hot
    assert 0 <= history.observations[:, :-3].min() and history.observations[:, :-3].max() <= 1


def test_images_with_channels_last_are_remembered_as_the_policy_sees_them():
    space = spaces.Box(0, 255, (36, 36, 3), np.uint8)
    policy_kwargs = dict(belief_from_features=False)
    model = make_model(n_envs=2, env_kwargs=dict(observation_space=space), policy_kwargs=policy_kwargs).learn(2 * 28)
    assert model.observation_space.shape == (3, 36, 36)
    history = model.policy.history.observations
    assert history.shape == (40, 3 * 36 * 36) and 0 <= history.min() and 0.9 < history.max() <= 1
    one, batch = space.sample(), np.stack([space.sample() for _ in range(3)])
    assert model.policy.predict_others(one).mean.shape == (64,)
    assert model.policy.predict_others(batch).mean.shape == (3, 64)


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(-1, 1, (5,), np.float32),
        spaces.Box(0, 255, (36, 40, 3), np.uint8),
        spaces.Box(0, 255, (3, 40, 36), np.uint8),
        spaces.Discrete(5),
        spaces.MultiDiscrete([3, 4]),
        spaces.MultiBinary(9),
        spaces.Dict(image=spaces.Box(0, 255, (36, 40, 3), np.uint8), kind=spaces.Discrete(4)),
    ],
    ids=lambda space: f"{type(space).__name__}{space.shape or ''}",
)
def test_what_a_user_lets_it_remember_is_found_again(space):
    """Steps given as `predict` takes them: nothing is more similar to an observation than itself, remembered."""
    policy = make_model(n_envs=1, env_kwargs=dict(observation_space=space), similarity="observation").policy
    space.seed(0)
    samples = [space.sample() for _ in range(20)]
    obs = {key: np.stack([s[key] for s in samples]) for key in space} if isinstance(space, spaces.Dict) else np.stack(samples)
    policy.remember(obs, np.zeros((20, 7), dtype=np.float32))
    assert policy.history.valid.sum() == 20
    remembered = policy.history.observations
    for i, rows in enumerate(policy.predict_others(obs).rows):
        # Convolutions round differently for one image and for several
        np.testing.assert_allclose(
            policy.flat_observations(policy.obs_to_tensor(samples[i])[0])[0], remembered[i], rtol=1e-3, atol=1e-6
        )
        similarity = F.cosine_similarity(remembered, remembered[i : i + 1])
        assert similarity[rows].max() > 1 - 1e-6


def test_what_cannot_be_remembered_is_refused():
    policy = make_model().policy
    with pytest.raises(ValueError, match=r"the shape \(4, 3\); 4 steps beside b, c need \(4, 7\)"):
        policy.remember(np.zeros((4, 5), dtype=np.float32), np.zeros((4, 3), dtype=np.float32))
    assert not policy.history.valid.any()
    static = make_model(belief="static").policy
    static.remember(np.zeros((4, 5), dtype=np.float32), np.zeros((4, 7), dtype=np.float32))
    assert static.history is None


def test_others_are_read_in_order_and_zeroed_where_not_visible():
    layout = action_layout({"b": spaces.Discrete(2), "c": spaces.MultiDiscrete([2, 2]), "d": spaces.Box(-5, 5, (1,))})
    assert layout.blocks == [(0, 0, 2), (1, 2, 2), (1, 4, 2)] and layout.owners == [0, 0, 1, 1, 1, 1, 2]
    row = np.array([0, 1, 1, 0, 0, 1, np.nan], dtype=np.float32)
    infos = [{"others_actions": row, "others_visible": np.array([False, True, False])}]
    actions, visible = read_others(infos, layout)
    assert actions.tolist() == [[0, 0, 1, 0, 0, 1, 0]] and visible.tolist() == [[False, True, False]]
