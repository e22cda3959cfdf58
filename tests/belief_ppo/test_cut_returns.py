"""Returns that the end of a rollout cuts while the agent is out of play: right on average, without the critic's opinion."""

from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

from sb3_belief.belief_ppo import BeliefRolloutBuffer
from tests.belief_ppo.helpers import ALGORITHMS, SMALL
from tests.belief_ppo.toy_envs import AmongOthers

GAMMA, LENGTH = 0.9, 12
# What a step pays while the agent is in play, and while it is not
GAMES = {"death costs nothing": (1.0, 1.0), "death costs": (1.0, 0.0), "death is a relief": (0.0, 2.0)}


def true_values(alive: float, dead: float, risk: float) -> np.ndarray:
    """Return the value before each step of an episode, of an agent in play."""
    v_alive, v_dead = np.zeros(LENGTH + 1), np.zeros(LENGTH + 1)
    for t in reversed(range(LENGTH)):
        v_dead[t] = dead + GAMMA * v_dead[t + 1]
        v_alive[t] = alive + GAMMA * ((1 - risk) * v_alive[t + 1] + risk * v_dead[t + 1])
    return v_alive


def play(game: str, n_steps: int, tells_next: bool = True, n_rollouts: int = 60, risk: float = 0.15) -> np.ndarray:
    """
    Play a game in which the agent may die at each step, with a critic that knows the true values of an agent in play.

    :return: Return minus true value of the steps in play, of all rollouts after the first ten
    """
    rng, n_envs = np.random.default_rng(0), 64
    alive_pays, dead_pays = GAMES[game]
    v_alive = true_values(alive_pays, dead_pays, risk)
    box, actions = spaces.Box(-1, 1, (1,)), spaces.Discrete(2)
    buffer = BeliefRolloutBuffer(n_steps, box, actions, "cpu", gae_lambda=0.8, gamma=GAMMA, n_envs=n_envs)
    t, alive, starts = rng.integers(0, LENGTH, n_envs), np.ones(n_envs, dtype=bool), np.ones(n_envs, dtype=bool)
    differences = []
    for rollout in range(n_rollouts):
        buffer.reset()
        for _ in range(n_steps):
            # Of an agent out of play the critic knows nothing
            values = th.tensor(np.where(alive, v_alive[t], 1000.0))
            active, alive, t = alive, alive & (rng.random(n_envs) > risk), t + 1
            ends = t == LENGTH
            buffer.stage(active, alive | ends if tells_next else None)
            rewards = np.where(active, alive_pays, dead_pays)
            buffer.add(np.zeros((n_envs, 1)), np.zeros((n_envs, 1)), rewards, starts, values, th.zeros(n_envs))
            alive, t, starts = alive | ends, np.where(ends, 0, t), ends
        given = buffer.rewards.copy(), buffer.episode_starts.copy()
        buffer.compute_returns_and_advantage(th.tensor(np.where(alive, v_alive[t], 1000.0)), starts)
        assert np.array_equal(buffer.rewards, given[0]) and np.array_equal(buffer.episode_starts, given[1])
        if rollout >= 10:
            differences.append((buffer.returns - buffer.values)[buffer.active])
    return np.concatenate(differences)


@pytest.mark.parametrize("n_steps", [5, 17])
@pytest.mark.parametrize("game", GAMES)
def test_returns_are_right_on_average_whatever_death_costs(game, n_steps):
    found = play(game, n_steps)
    assert abs(found.mean()) < 4 * found.std() / np.sqrt(len(found)) + 0.01


def test_without_next_active_only_deaths_in_the_very_last_step_go_to_the_critic():
    found = play("death costs nothing", 17, tells_next=False)
    # The critic's 1000 enters where the last step of a rollout killed the agent, and fades out towards earlier ones
    wrong = np.abs(found) > 0.01
    assert 0 < wrong.mean() < 0.15


def turns(pattern: list[bool], n_rollouts: int, n_steps: int) -> list[np.ndarray]:
    """Let the agent play in a pattern of steps, each worth its number, for ever; return its advantages in each rollout."""
    buffer = BeliefRolloutBuffer(n_steps, spaces.Box(-1, 1, (1,)), spaces.Discrete(2), "cpu", 0.9, 0.5, 1)
    step, advantages = 0, []
    for _ in range(n_rollouts):
        buffer.reset()
        for _ in range(n_steps):
            active, after = pattern[step % len(pattern)], pattern[(step + 1) % len(pattern)]
            buffer.stage(np.array([active]), np.array([after]))
            value = th.full((1,), 2.0 if active else 1000.0)
            buffer.add(np.zeros((1, 1)), np.zeros((1, 1)), np.ones(1), np.array([step == 0]), value, th.zeros(1))
            step += 1
        buffer.compute_returns_and_advantage(th.full((1,), 2.0 if after else 1000.0), np.zeros(1, dtype=bool))
        advantages.append(buffer.advantages[buffer.active].copy())
    return advantages


def test_who_comes_back_into_play_goes_on_with_the_critics_value():
    # With gamma 0.5: a step, two of absence, and the value of the next turn: 1 + 0.5 + 0.25 + 0.125 * 2 - 2 = 0
    for advantages in turns([True, False, False], n_rollouts=6, n_steps=4):
        assert advantages == pytest.approx(0.0, abs=1e-6)
    # A lasting absence shows what it is worth only when it ends, in a later rollout: 1 + ... + 0.5**6 * 2 - 2 = 0
    assert np.concatenate(turns([True] + [False] * 5, n_rollouts=6, n_steps=3)) == pytest.approx(0.0, abs=1e-6)


def test_what_absences_cost_is_learned_across_rollouts():
    # A turn is worth 1 + 0.5 + 0.25 * 2 = 2 beside a critic that says 3: each absence turns out to differ by ...
    buffer = BeliefRolloutBuffer(3, spaces.Box(-1, 1, (1,)), spaces.Discrete(2), "cpu", 0.9, 0.5, 1)
    found = []
    for rollout in range(2):
        buffer.reset()
        for step in range(3):
            number = 3 * rollout + step
            active = number % 2 == 0
            buffer.stage(np.array([active]), np.array([not active]))
            value = th.full((1,), 3.0)
            buffer.add(np.zeros((1, 1)), np.zeros((1, 1)), np.ones(1), np.array([number == 0]), value, th.zeros(1))
        buffer.compute_returns_and_advantage(th.full((1,), 3.0), np.zeros(1, dtype=bool))
        found.append(buffer.advantages[:, 0].copy())
    # ... 1 + 0.5 * 1 + 0.25 * 3 - 3 = -0.75, which is what to expect of the one that the end of the rollout cuts
    assert found[0][2] == pytest.approx(-0.75)
    assert found[1][1] == pytest.approx(1 + 0.5 + 0.25 * 3 - 3)


def test_absences_do_not_outlast_a_rollout_without_any():
    buffer = BeliefRolloutBuffer(2, spaces.Box(-1, 1, (1,)), spaces.Discrete(2), "cpu", 0.9, 0.5, 1)
    for active, after in (([True, False], False), ([True, True], True), ([False, True], True)):
        buffer.reset()
        for played in active:
            buffer.stage(np.array([played]), np.array([after]))
            buffer.add(np.zeros((1, 1)), np.zeros((1, 1)), np.ones(1), np.zeros(1), th.full((1,), 50.0), th.zeros(1))
        buffer.compute_returns_and_advantage(th.zeros(1), np.zeros(1, dtype=bool))
    assert buffer._cut_returns._n_steps == 0.0


class DiesAtTheLimit(AmongOthers):
    """Its agent dies in the last step before the time limit."""

    def _info(self) -> dict[str, Any]:
        return {**super()._info(), "next_active": self.steps < 7}


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("dies", [True, False])
def test_nothing_is_bootstrapped_at_a_limit_for_who_died_in_the_last_step(dies, algorithm):
    env = make_vec_env(DiesAtTheLimit if dies else AmongOthers, n_envs=2, seed=0, env_kwargs=dict(episode_length=7))
    model = algorithm("BeliefPolicy", env, **{**SMALL, "n_steps": 14, "batch_size": 14})
    own = []

    class Collects(BaseCallback):
        def _on_step(self) -> bool:
            own.append(self.locals["rewards"].copy())
            return True

    model.learn(28, callback=Collects())
    added = model.rollout_buffer.rewards - np.array(own)
    assert (added != 0).sum() == (0 if dies else 4)
