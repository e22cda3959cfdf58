"""
Q-learners on games whose values are known by hand.

Played uniformly (epsilon 1), an independent Q-learner's values of a matrix game are the means over the others' actions.
Payoffs are scaled, because the Huber loss fits means only where errors stay below 1, and values are given in payoffs again.
"""

from itertools import product
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_belief import make_team_env
from sb3_belief.baselines import DPIQN, DRPIQN, IQL
from sb3_belief.envs import make_parallel_env
from tests.games.seeds import SEEDS
from tests.team.helpers import Team


def values(env_id: str, seed: int, scale: float, n_timesteps: int, gamma: float = 0.0, **env_kwargs: Any) -> list[np.ndarray]:
    """
    Let IQL learn a game that is played uniformly.

    :param env_id: The game
    :param seed: Seed of everything
    :param scale: What payoffs are multiplied by
    :param n_timesteps: Number of joint steps
    :param gamma: Discount factor; 0 for a table, which may then be played several times an episode
    :param env_kwargs: Further arguments of the game
    :return: The values of each agent by observation and action, ``[n_observations, n_actions]``, in payoffs
    """
    env = make_team_env(env_id, n_envs=200, seed=seed, env_kwargs={"reward_scale": scale, **env_kwargs})
    team = Team(
        IQL,
        "MlpPolicy",
        env,
        seed=seed,
        gamma=gamma,
        learning_rate=lambda left: 3e-3 * left,
        buffer_size=200_000,
        batch_size=2048,
        learning_starts=2_000,
        train_freq=1,
        # Values of later steps take a few copies of the target network to arrive
        gradient_steps=4 if gamma else 2,
        target_update_interval=4_000,
        exploration_initial_eps=1.0,
        exploration_final_eps=1.0,
        policy_kwargs={"net_arch": [32]},
        device="cpu",
    ).learn(n_timesteps)
    width = env.observation_space["agent_0"].shape[0]
    with th.no_grad():
        return [model.q_net(th.eye(width)).numpy() / scale for model in team.agents.values()]


def greedy_payoff(env_id: str, tables: list[np.ndarray], **env_kwargs: Any) -> float:
    """Return what the agents earn who each play their best action of a game of one step."""
    env = make_parallel_env(env_id, **env_kwargs)
    return float(env.payoffs[tuple(int(table[0].argmax()) for table in tables)])


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_climbing(seed):
    tables = values("climbing", seed, 0.02, n_timesteps=100_000, n_steps=25)
    assert tables[0][0] == pytest.approx([-6.33, -7.67, 3.67], abs=0.3)
    assert tables[1][0] == pytest.approx([-6.33, -5.67, 1.67], abs=0.3)
    assert greedy_payoff("climbing", tables) == 5


@pytest.mark.slow
def test_the_huber_loss_fits_no_means_where_errors_are_large():
    first, second = values("climbing", 0, 1.0, n_timesteps=100_000, n_steps=25)
    # Where the sum of the errors, cut off at 1 and -1, is zero
    assert first[0] == pytest.approx([0, 0, 5], abs=0.3)
    assert second[0] == pytest.approx([0, 6, 0.5], abs=0.3)


@pytest.mark.slow
@pytest.mark.parametrize(("k", "seed"), [*product([-25], SEEDS), *product([-50, -100], [0])])
def test_penalty(k, seed):
    tables = values("penalty", seed, 0.5 / (10 - k), n_timesteps=100_000, n_steps=25, k=k)
    if k == -25:
        for table in tables:
            assert table[0] == pytest.approx([(k + 10) / 3, 2 / 3, (k + 10) / 3], abs=0.3)
    # The optimum is 10
    assert greedy_payoff("penalty", tables, k=k) == 2


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_two_steps(seed):
    first, second = values("two-step", seed, 0.1, n_timesteps=60_000, gamma=0.99)
    # The rows are the first step, 2A and 2B
    assert first == pytest.approx(np.array([[6.93, 4.455], [7, 7], [0.5, 4.5]]), abs=0.3)
    assert second == pytest.approx(np.array([[5.6925, 5.6925], [7, 7], [0.5, 4.5]]), abs=0.3)
    # So the first agent chooses 2A, which pays 7, and not 8
    assert first[0].argmax() == 0


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_qtran_s_matrix(seed):
    tables = values("qtran-matrix", seed, 0.04, n_timesteps=100_000, n_steps=25)
    for table in tables:
        assert table[0] == pytest.approx([-16 / 3, -4, -4], abs=0.3)
    assert greedy_payoff("qtran-matrix", tables) == 0


class Hits(BaseCallback):
    """Callback that records the mean reward of each joint step, which in the conventions is the share of matches."""

    def __init__(self) -> None:
        super().__init__()
        self.hits: list[float] = []

    def _on_step(self) -> bool:
        self.hits.append(float(self.locals["rewards"].mean()))
        return True


def success(algorithm: Any, seed: int) -> float:
    """Return the share of matches over the last five of twenty conventions of ``convention-redraw``, with epsilon .05."""
    window = 12 if algorithm is DRPIQN else 0
    env = make_team_env("convention-redraw", n_envs=50, seed=seed, env_kwargs={"seed": seed}, observe_window=window)
    kwargs: dict[str, Any] = {"learning_rate": 1e-3, "buffer_size": 100_000, "learning_starts": 1_000, "train_freq": 1}
    kwargs |= {"exploration_fraction": 0.5, "gamma": 0.0, "policy_kwargs": {"net_arch": [32, 32]}, "device": "cpu"}
    record = Hits()
    Team(algorithm, "MlpPolicy", env, seed=seed, **kwargs).learn(80_000, record)
    # Five rollouts of 16 steps each
    return float(np.reshape(record.hits, (20, -1)).mean(axis=1)[15:].mean())


@pytest.mark.slow
@pytest.mark.parametrize(("algorithm", "seed"), [*product([DPIQN, DRPIQN], SEEDS)])
def test_who_has_no_history_of_the_others_is_as_good_as_a_static_belief(algorithm, seed):
    # The optimum is .85, chance .25, and this the band of BeliefPPO(belief="static"): what an old convention has in common
    # with a new one is luck
    assert 0.14 <= success(algorithm, seed) <= 0.29
