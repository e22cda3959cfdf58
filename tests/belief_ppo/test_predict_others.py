"""A belief one can look at: what it says the others do, and why."""

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env

from sb3_belief.belief_ppo import BeliefPPO, MaskableBeliefPPO
from tests.belief_ppo.helpers import ROLLOUT, SMALL, make_model, observations_of
from tests.belief_ppo.toy_envs import AmongOthers

OTHERS: dict[str, spaces.Space] = {
    "b": spaces.Discrete(3),
    "c": spaces.MultiBinary(2),
    "d": spaces.MultiDiscrete([2, 4]),
    "e": spaces.Box(-1, 1, (3,), np.float32),
}
FINITE = {name: space for name, space in OTHERS.items() if name != "e"}
PREDICTING = ["dynamic", "context", "variational", "static", "adaptive"]


def expected_of(space: spaces.Space, output: np.ndarray, action_loss: str) -> np.ndarray:
    """What one row of the decoder says of one other, by hand."""
    if isinstance(space, spaces.Box):
        return output
    if isinstance(space, spaces.MultiBinary):
        return (
            1 / (1 + np.exp(-output)) if action_loss == "cross_entropy" else np.array([min(1.0, max(0.0, x)) for x in output])
        )
    sizes = [space.n] if isinstance(space, spaces.Discrete) else list(space.nvec)  # type: ignore[attr-defined]
    parts, start = [], 0
    for size in sizes:
        part = output[start : start + size]
        start += size
        weights = np.exp(part) if action_loss == "cross_entropy" else np.array([max(0.0, x) for x in part])
        parts.append(weights / weights.sum() if weights.sum() else np.full(size, 1 / size))
    return np.concatenate(parts)


@pytest.mark.parametrize(
    "algorithm, belief", [*((BeliefPPO, belief) for belief in PREDICTING), (MaskableBeliefPPO, "dynamic")]
)
@pytest.mark.parametrize("action_loss, others", [("mse", OTHERS), ("cross_entropy", FINITE)])
def test_it_says_what_the_decoder_says(algorithm, belief, action_loss, others):
    model = make_model(algorithm=algorithm, belief=belief, action_loss=action_loss, env_kwargs=dict(others=others))
    model.learn(2 * ROLLOUT)
    obs, policy = observations_of(model, 6), model.policy
    found = policy.predict_others(obs)
    weight, bias = (part.detach().numpy().astype(np.float64) for part in policy.belief.decoder.parameters())
    assert list(found.actions) == list(others)
    for row in range(6):
        output, start = weight @ found.mean[row] + bias, 0
        for name, space in others.items():
            width = spaces.flatdim(space)
            expected = expected_of(space, output[start : start + width], action_loss)
            np.testing.assert_allclose(found.actions[name][row], expected, atol=1e-5)
            start += width
    for name, space in others.items():
        said = found.actions[name]
        assert said.shape == (6, spaces.flatdim(space))
        if name != "e":
            assert (said >= 0).all() and (said <= 1).all()
        if isinstance(space, spaces.Discrete):
            np.testing.assert_allclose(said.sum(axis=1), 1, atol=1e-6)
        if isinstance(space, spaces.MultiDiscrete):
            np.testing.assert_allclose(np.add.reduceat(said, [0, 2], axis=1), 1, atol=1e-6)


@pytest.mark.parametrize("belief", PREDICTING)
def test_it_shows_the_belief_and_what_it_comes_from(belief):
    model = make_model(belief=belief, policy_kwargs=dict(latent_dim=7)).learn(2 * ROLLOUT)
    obs = observations_of(model, 6)
    found = model.policy.predict_others(obs)
    assert found.mean.shape == found.std.shape == (6, 7)
    assert (found.std > 0).all() if belief in ("dynamic", "variational") else (found.std == 0).all()
    if belief in ("dynamic", "context"):
        assert found.rows.shape == found.weights.shape == (6, 4)  # a tenth of forty
        assert model.policy.history.valid[found.rows].all() and all(len(set(rows)) == 4 for rows in found.rows.tolist())
        assert (found.weights > 0).all()
        np.testing.assert_allclose(found.weights.sum(axis=1), 1, atol=1e-6)
    elif belief == "adaptive":
        # 32 of its own copy, of which there are none, 32 of others, and the null row
        assert found.rows.shape == found.weights.shape == (6, 65)
        assert (found.rows[:, :32] == -1).all() and (found.rows[:, 32:-1] >= 0).any() and (found.rows[:, -1] == -1).all()
        assert model.policy.history.valid[found.rows[found.rows >= 0]].all()
        assert (found.weights[:, -1] > 0).all() and (found.weights[:, :-1][found.rows[:, :-1] < 0] == 0).all()
        np.testing.assert_allclose(found.weights.sum(axis=1), 1, atol=1e-6)
    else:
        assert found.rows.shape == found.weights.shape == (6, 0)


def test_the_rows_are_those_of_the_history():
    model = make_model().learn(ROLLOUT)
    history = model.policy.history.observations.numpy()
    # To a step that it remembers nothing is more similar than that step
    found = model.policy.predict_others(history[:10])
    assert all(row in found.rows[row] for row in range(10))
    partly = make_model(history_length=100).learn(ROLLOUT).policy
    assert partly.predict_others(history[:10]).rows.max() < ROLLOUT <= partly.history.valid.sum()


def test_one_observation_or_many():
    model = make_model().learn(ROLLOUT)
    obs = observations_of(model, 3)
    together, alone = model.policy.predict_others(obs), [model.policy.predict_others(row) for row in obs]
    for name in ("b", "c"):
        np.testing.assert_allclose(np.stack([each.actions[name] for each in alone]), together.actions[name], atol=1e-6)
    np.testing.assert_allclose(np.stack([each.mean for each in alone]), together.mean, atol=1e-6)
    assert alone[0].actions["b"].shape == (3,) and alone[0].rows.shape == (4,) and alone[0].weights.shape == (4,)


def test_looking_changes_nothing_and_needs_no_history():
    model = make_model()
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    obs = observations_of(model, 2)
    first, second = model.policy.predict_others(obs), model.policy.predict_others(obs)
    assert first.rows.shape == (2, 0)
    np.testing.assert_array_equal(first.actions["b"], second.actions["b"])
    assert all((value == before[name]).all() for name, value in model.policy.state_dict().items())


@pytest.mark.parametrize("belief", ["none", "wide"])
def test_a_policy_that_predicts_nobody_says_so(belief):
    model = make_model(belief=belief)
    with pytest.raises(ValueError, match=f"belief='{belief}' and {0 if belief == 'none' else 2} others.*'dynamic', 'context'"):
        model.policy.predict_others(observations_of(model, 2))


def test_nobody_to_predict():
    with pytest.warns(UserWarning, match="names no other agents"):
        model = make_model(env_kwargs=dict(others={}))
    with pytest.raises(ValueError, match="0 others"):
        model.policy.predict_others(observations_of(model, 2))


class Readable(AmongOthers):
    """What the others do can be told from the observation: b from its first number, c from the signs of the next two."""

    def __init__(self) -> None:
        super().__init__(others={"b": spaces.Discrete(3), "c": spaces.MultiBinary(2)})
        self.shown = np.zeros(5, dtype=np.float32)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        b, c = told(self.shown)
        self.shown, reward, terminated, truncated, info = super().step(action)
        info["others_actions"] = np.concatenate([np.eye(3)[b], c]).astype(np.float32)
        return self.shown, reward, terminated, truncated, info

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        self.shown, info = super().reset(**kwargs)
        return self.shown, info


def told(obs: np.ndarray) -> tuple[int, np.ndarray]:
    return int(np.digitize(obs[0], [-0.33, 0.33])), obs[1:3] > 0


@pytest.mark.parametrize("action_loss", ["mse", "cross_entropy"])
def test_trained_it_knows_what_the_others_do(action_loss):
    env = make_vec_env(Readable, n_envs=4, seed=0)
    learning: dict[str, Any] = dict(n_steps=64, batch_size=128, n_epochs=10, learning_rate=1e-2, history_length=100)
    model = BeliefPPO("BeliefPolicy", env, action_loss=action_loss, **{**SMALL, **learning})
    model.learn(5 * 256)
    obs = observations_of(model, 300)
    found: Any = model.policy.predict_others(obs)
    right_b = np.mean([found.actions["b"][i].argmax() == told(obs[i])[0] for i in range(300)])
    right_c = np.mean([(found.actions["c"][i] > 0.5) == told(obs[i])[1] for i in range(300)])
    # Chance is a third and a half
    assert right_b > 0.6 and right_c > 0.75
    # The logged accuracy is that of sampled beliefs
    assert model.logger.name_to_value["belief/accuracy"] > model.logger.name_to_value["belief/base_rate"] + 0.2
