"""Steps in which the agent is not in play: no loss, no advantage statistics, no history row."""

from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env

from sb3_belief.belief_ppo import BeliefRolloutBuffer
from sb3_belief.belief_ppo.buffers import attached
from tests.belief_ppo.helpers import ALGORITHMS, EVERY, ROLLOUT, SMALL, make_model, same_parameters
from tests.belief_ppo.toy_envs import AmongOthers


class Unplayed(AmongOthers):
    """What it shows in the steps in which the agent is out of play depends on ``garbage``, and nothing else does."""

    def __init__(self, garbage, **kwargs):
        super().__init__(inactive=3, **kwargs)
        self.garbage = garbage

    def step(self, action):
        played = (self.steps + 1) % 3 != 0
        obs, reward, terminated, truncated, info = super().step(action if played else 0)
        if (self.steps + 1) % 3 == 0:
            obs = np.full_like(obs, self.garbage)
        return obs, reward, terminated, truncated, info


@pytest.mark.parametrize("algorithm, belief", EVERY)
def test_inactive_steps_train_nothing(belief, algorithm):
    models: list[Any] = []
    for garbage in (-1.0, 1.0):
        env = make_vec_env(Unplayed, n_envs=2, seed=0, env_kwargs=dict(garbage=garbage))
        models.append(algorithm("BeliefPolicy", env, belief=belief, **SMALL).learn(3 * 28))
    first, second = (model.rollout_buffer.observations for model in models)
    assert not np.array_equal(first, second)
    assert same_parameters(*models)
    rows = sum(len(samples.actions) for samples in models[0].rollout_buffer.get(16))
    assert rows == models[0].rollout_buffer.active.sum() < 28


def test_advantages_pass_through_inactive_steps():
    buffer = BeliefRolloutBuffer(4, spaces.Box(-1, 1, (1,)), spaces.Discrete(2), gamma=0.9, gae_lambda=0.8, n_envs=1)
    for step, (reward, value, active) in enumerate([(1, 5, True), (2, 100, False), (3, 100, False), (4, 7, True)]):
        buffer.stage(np.array([active]))
        estimate = th.tensor([float(value)])
        buffer.add(np.zeros((1, 1)), np.zeros((1, 1)), np.array([reward]), np.array([step == 0]), estimate, estimate)
    buffer.compute_returns_and_advantage(th.tensor([[10.0]]), np.array([False]))
    last = 4 + 0.9 * 10 - 7
    # Out of play, nothing is estimated: from the first step on it earns 1, 2, 3, and then what the last step is worth
    first = (1 + 0.9 * 2 + 0.9**2 * 3 + 0.9**3 * 7 - 5) + (0.9 * 0.8) ** 3 * last
    assert buffer.advantages[3, 0] == pytest.approx(last, rel=1e-5)
    assert buffer.advantages[0, 0] == pytest.approx(first, rel=1e-5)


def test_a_rollout_without_an_active_step_trains_nothing():
    model = make_model(env_kwargs=dict(inactive=1))
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    model.learn(2 * 42)
    assert all(th.equal(value, before[name]) for name, value in model.policy.state_dict().items())


# -- few active steps --------------------------------------------------------------------------------------------------


def filled_buffer(active: list[bool]) -> BeliefRolloutBuffer:
    """A buffer of one environment, whose observation is the number of the step."""
    buffer = BeliefRolloutBuffer(len(active), spaces.Box(0, 100, (1,)), spaces.Discrete(2), device="cpu", n_envs=1)
    for step, played in enumerate(active):
        buffer.stage(np.array([played]))
        buffer.add(np.full((1, 1), step), np.zeros((1, 1)), np.ones(1), np.zeros(1), th.zeros(1), th.zeros(1))
    buffer.compute_returns_and_advantage(th.zeros(1, 1), np.zeros(1))
    return buffer


@pytest.mark.parametrize("batch_size", [1, 2, 3, 4, 20, None])
@pytest.mark.parametrize("n_active", [2, 3, 7, 19])
def test_a_minibatch_of_less_than_two_active_rows_goes_with_the_next(n_active, batch_size):
    rng = np.random.default_rng(0)
    active = [bool(played) for played in rng.permutation(20) < n_active]
    buffer = filled_buffer(active)
    expected = {step for step, played in enumerate(active) if played}
    for _ in range(20):
        seen: list[int] = []
        for samples in buffer.get(batch_size):
            rows = samples.observations.flatten().tolist()
            assert len(rows) >= 2
            seen += rows
        # Each once, but for one that is left over at the end
        assert len(seen) == len(set(seen)) and set(seen) <= expected and len(expected) - len(seen) <= 1
        if batch_size in (20, None):
            assert set(seen) == expected


def test_the_beliefs_part_goes_with_its_rows():
    model = make_model(env_kwargs=dict(inactive=3), batch_size=3)
    pairs = []

    def watched_update():
        buffer = model.rollout_buffer
        flat = {buffer.observations[t, e].tobytes(): buffer.others_actions[t, e] for t in range(14) for e in range(3)}
        get = buffer.get

        def watched_get(batch_size):
            for samples in get(batch_size):
                part = attached(samples.observations)
                assert len(part.noise) == len(samples.observations)
                for row, actions in zip(samples.observations.numpy(), part.others_actions.numpy(), strict=True):
                    pairs.append((flat[row.tobytes()].tolist(), actions.tolist()))
                yield samples

        buffer.get = watched_get
        update()
        buffer.get = get

    update, model._update = model._update, watched_update
    model.learn(ROLLOUT)
    assert len(pairs) >= 40 and all(expected == found for expected, found in pairs)
    assert len({tuple(found) for _, found in pairs}) > 5


class PlayedOnce(AmongOthers):
    """The agent is in play in the first ``n_played`` steps of an episode."""

    def __init__(self, n_played: int, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.n_played = n_played

    def _info(self) -> dict[str, Any]:
        return {**super()._info(), "active": self.steps <= self.n_played}


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("belief", ["dynamic", "static", "none"])
@pytest.mark.parametrize("n_played", [0, 1, 2])
def test_rollouts_with_hardly_an_active_step(n_played, belief, algorithm):
    env = make_vec_env(PlayedOnce, n_envs=1, seed=0, env_kwargs=dict(n_played=n_played, episode_length=14))
    model = algorithm("BeliefPolicy", env, belief=belief, **{**SMALL, "batch_size": 7})
    before = {name: value.clone() for name, value in model.policy.named_parameters()}
    model.learn(4 * 14)
    moved = [name for name, value in model.policy.named_parameters() if not th.equal(value, before[name])]
    assert all(th.isfinite(value).all() for value in model.policy.state_dict().values())
    # A single step is no rollout to learn from, but one to remember
    assert bool(moved) == (n_played == 2)
    if model.policy.history is not None:
        assert model.policy.history.valid.sum() == 4 * n_played
    if n_played and belief != "none":
        assert model.logger.name_to_value["belief/first_log_ratio"] < 1e-5
