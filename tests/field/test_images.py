"""Agents that see images: what their belief is inferred from, and what memory that takes."""

import copy
import warnings
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env

from sb3_belief import BeliefPPO, MaskableBeliefPPO
from tests.belief_ppo.helpers import SMALL, make_model
from tests.belief_ppo.toy_envs import AmongOthers
from tests.team.helpers import Team, make_team_env
from tests.team.toy_envs import ToyEnv

FIRST = spaces.Box(0, 255, (3, 36, 40), np.uint8)
LAST = spaces.Box(0, 255, (36, 40, 3), np.uint8)
BOTH = spaces.Dict(image=LAST, vector=spaces.Box(-1, 1, (3,), np.float32))


@pytest.mark.parametrize(
    ("space", "policy", "width"),
    [
        (FIRST, "BeliefPolicy", 512),
        (LAST, "CnnPolicy", 512),
        (BOTH, "MultiInputPolicy", 256 + 3),
        # These have no features but the observation itself
        (FIRST, "MlpPolicy", 3 * 36 * 40),
        (BOTH["vector"], "BeliefPolicy", 3),
    ],
)
def test_the_belief_sees_the_features_of_images(space, policy, width):
    env = make_vec_env(AmongOthers, n_envs=2, seed=0, env_kwargs=dict(observation_space=space))
    model: Any = BeliefPPO(policy, env, **SMALL).learn(2 * 28)
    assert model.policy.history.observations.shape == (40, width) and model.policy.history.valid.all()
    assert model.logger.name_to_value["belief/first_log_ratio"] < 1e-5


def test_what_is_remembered_are_the_features_of_the_present_network():
    model = make_model(n_envs=2, env_kwargs=dict(observation_space=LAST)).learn(2 * 28)
    policy, images = model.policy, np.stack([LAST.sample() for _ in range(70)])
    policy.remember(images, np.zeros((70, policy.layout.width), np.float32))
    expected = policy.features_extractor.features(policy.obs_to_tensor(images)[0].float() / 255)[-40:]
    np.testing.assert_allclose(policy.history.observations, expected.detach(), rtol=1e-4, atol=1e-6)


def test_the_belief_trains_the_features():
    """Its loss reaches the convolutions, too."""
    model = make_model(env_kwargs=dict(observation_space=FIRST))
    policy, belief = model.policy, model.policy.belief
    features = policy.features_extractor.features(th.rand(4, *FIRST.shape))
    belief(features, policy.history).prediction.sum().backward()
    assert all(weights.grad.abs().sum() > 0 for weights in policy.features_extractor.features.cnn[0].parameters())


@pytest.mark.parametrize("chosen", [None, False])
def test_the_choice_is_saved(chosen, tmp_path):
    kwargs: Any = {} if chosen is None else {"belief_from_features": chosen}
    model = make_model(env_kwargs=dict(observation_space=LAST), policy_kwargs=kwargs).learn(28)
    model.save(tmp_path / "model.zip")
    loaded = type(model).load(tmp_path / "model.zip", env=model.get_env())
    assert loaded.policy.belief_from_features == (chosen is None)
    images = np.stack([LAST.sample() for _ in range(5)])
    np.testing.assert_array_equal(model.predict(images, deterministic=True)[0], loaded.predict(images, deterministic=True)[0])
    loaded.learn(28)


def test_a_model_from_before_there_was_a_choice_keeps_its_networks(tmp_path):
    model = make_model(env_kwargs=dict(observation_space=LAST), policy_kwargs=dict(belief_from_features=False))
    # As it was saved then
    model.policy_kwargs = {key: value for key, value in model.policy_kwargs.items() if key != "belief_from_features"}
    del model.belief_from_features
    model.save(tmp_path / "old.zip")
    loaded = type(model).load(tmp_path / "old.zip", env=model.get_env())
    assert loaded.policy.history.observations.shape[1] == 3 * 36 * 40
    loaded.learn(28)


class Flicker(ToyEnv):
    """A ``ToyEnv`` whose agents see the time as a picture."""

    def observation_space(self, agent):
        return LAST

    def observations(self):
        return {agent: np.full(LAST.shape, 30 * self.t, np.uint8) for agent in self.agents}


def test_a_team_of_agents_that_see_images(tmp_path):
    env = make_team_env(Flicker, n_envs=2)
    kwargs: dict[str, Any] = {"n_steps": 8, "batch_size": 8, "n_epochs": 1, "history_length": 30, "device": "cpu"}
    team = Team(BeliefPPO, "BeliefPolicy", env, seed=0, **kwargs).learn(32)
    assert team.agents["agent_1"].policy.history.observations.shape == (30, 512)
    team.save(tmp_path / "team.zip")
    Team.load(tmp_path / "team.zip", env=env).learn(16)


LARGE = spaces.Box(0, 255, (280, 480, 3), np.uint8)


def made(algorithm, n_steps, monkeypatch, **policy_kwargs):
    """Make a model for large images, without its networks and buffers."""
    env = make_vec_env(AmongOthers, env_kwargs=dict(observation_space=copy.deepcopy(LARGE)))

    class Enough(Exception):
        """Raised where the memory would be allocated."""

    def stop(*args, **kwargs):
        raise Enough

    # SB3's own, in which networks and buffers are made
    stock = next(kind for kind in algorithm.__mro__ if kind.__module__.startswith(("stable_baselines3.", "sb3_contrib.")))
    monkeypatch.setattr(stock, "_setup_model", stop)
    with pytest.raises(Enough):
        algorithm("BeliefPolicy", env, n_steps=n_steps, policy_kwargs=policy_kwargs)


@pytest.mark.parametrize("algorithm", [BeliefPPO, MaskableBeliefPPO])
def test_gigabytes_are_announced_before_they_are_allocated(algorithm, monkeypatch):
    # 3,000 steps of 403,200 bytes; 800 rows of 403,200 numbers of 4 bytes, and a layer of 64 times as many weights
    with pytest.warns(
        UserWarning, match=r"about 1\.2 GB .*\(1\.2 GB in the rollout buffer of 3000 steps of 1 copies, 0\.0 GB"
    ):
        made(algorithm, 3000, monkeypatch)
    says = (
        r"about 1\.7 GB .*\(0\.0 GB in the rollout.*, 1\.7 GB in the history.*shorter history_length, or policy_kwargs=dict\("
    )
    with pytest.warns(UserWarning, match=says):
        made(algorithm, 64, monkeypatch, belief_from_features=False)


def test_the_choice_is_yes_or_no():
    with pytest.raises(ValueError, match="belief_from_features is 'no'; it must be True or False"):
        make_model(policy_kwargs=dict(belief_from_features="no"))


def test_small_models_say_nothing(monkeypatch):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        made(BeliefPPO, 64, monkeypatch)
