"""The matrix games: payoffs, what agents observe and what the state holds, and the values of uniform and best play."""

from itertools import product

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test, parallel_seed_test

from sb3_belief import make_team_env
from sb3_belief.envs import check_team_env, make_parallel_env
from sb3_belief.envs.matrix_games import Cues, MatrixGame, Penalty, Permutation

IDS = [
    *("climbing", "qtran-matrix", "qplex-matrix", "coordination", "penalty", "permutation", "two-step"),
    *("cues", "hidden-offset", "levers"),
]


def table(env):
    """Return the reward of each joint action of the present step, by playing it."""
    payoffs = np.zeros([env.n_actions] * len(env.possible_agents))
    for joint in product(range(env.n_actions), repeat=payoffs.ndim):
        env.reset()
        payoffs[joint] = env.step(dict(zip(env.possible_agents, joint, strict=True)))[1]["agent_0"]
    return payoffs


@pytest.mark.parametrize("env_id", IDS)
def test_pettingzoo_interface_seeds_and_checker(env_id):
    parallel_api_test(make_parallel_env(env_id), num_cycles=50)
    parallel_seed_test(lambda: make_parallel_env(env_id), num_cycles=50)
    assert check_team_env(env_id, n_steps=60).failures == []


@pytest.mark.parametrize("env_id", IDS)
def test_every_game_has_a_state(env_id):
    env = make_team_env(env_id, n_envs=2, seed=0)
    assert env.state_source == "env"
    env.reset()
    assert env.states().shape == (2, *env.state_space.shape)


def test_tables():
    climbing, penalty = table(make_parallel_env("climbing")), table(make_parallel_env("penalty", k=-25))
    assert np.round(climbing.mean(axis=1), 2).tolist() == [-6.33, -7.67, 3.67]
    assert np.round(climbing.mean(axis=0), 2).tolist() == [-6.33, -5.67, 1.67]
    assert np.round(penalty.mean(axis=0), 2).tolist() == [-5, 0.67, -5]
    assert table(make_parallel_env("qtran-matrix")).sum() == 8 - 4 * 12
    assert table(make_parallel_env("qplex-matrix")).sum() == 8 - 4 * 12 + 12
    assert table(make_parallel_env("coordination")).tolist() == [[1, 0], [0, 1]]


@pytest.mark.parametrize(("n", "uniform"), [(2, 0.5), (3, 0.2222)])
def test_permutation(n, uniform):
    assert table(make_parallel_env("permutation", n=n)).mean() == pytest.approx(uniform, abs=1e-4)


@pytest.mark.parametrize("env_id", ["climbing", "qplex-matrix", "permutation", "two-step"])
def test_payoffs_are_scaled(env_id):
    env, scaled = make_parallel_env(env_id), make_parallel_env(env_id, reward_scale=0.1)
    for each in (env, scaled):
        each.reset()
    joint = {"agent_0": 1, "agent_1": 0}
    if env_id == "two-step":
        env.step(joint)
        scaled.step(joint)
    reward = env.step(joint)[1]["agent_0"]
    assert reward and scaled.step(joint)[1]["agent_0"] == pytest.approx(0.1 * reward)


def test_a_table_is_played_n_times_an_episode():
    env = make_team_env("climbing", env_kwargs={"n_steps": 25})
    env.reset()
    for t in range(25):
        _, rewards, dones, infos = env.step({"agent_0": [1], "agent_1": [1]})
        assert dones[0] == (t == 24)
    assert rewards[0] == 7 and infos[0]["episode"]["r"] == 175 and not infos[0]["TimeLimit.truncated"]


@pytest.mark.parametrize(("first", "payoffs"), [(0, [[7, 7], [7, 7]]), (1, [[0, 1], [1, 8]])])
def test_two_steps(first, payoffs):
    env = make_parallel_env("two-step")
    for joint in product(range(2), repeat=2):
        obs, _ = env.reset()
        assert obs["agent_0"].tolist() == env.state().tolist() == [1, 0, 0]
        obs, rewards, ends, _, _ = env.step({"agent_0": first, "agent_1": joint[0]})
        assert obs["agent_1"].tolist() == env.state().tolist() == [0, 1 - first, first]
        assert rewards == {"agent_0": 0, "agent_1": 0} and not any(ends.values())
        _, rewards, ends, _, _ = env.step(dict(zip(env.possible_agents, joint, strict=True)))
        assert set(rewards.values()) == {payoffs[joint[0]][joint[1]]} and all(ends.values())


def test_cues():
    env = make_parallel_env("cues")
    rng, returns = np.random.default_rng(0), []
    for seed in range(2000):
        obs, _ = env.reset(seed=seed)
        assert env.state().tolist() == [obs[agent][0] for agent in env.possible_agents]
        actions = dict(zip(env.possible_agents, rng.integers(2, size=5), strict=True))
        _, rewards, ends, _, _ = env.step(actions)
        right = [actions[agent] == obs[agent][0] for agent in env.possible_agents]
        assert set(rewards.values()) == {sum(right)} and all(ends.values())
        returns.append((right[0], sum(right)))
    # Given its own choice, an agent's return has the variance of the four others'
    assert np.var([total for own, total in returns if own]) == pytest.approx(1, abs=0.1)


def test_hidden_offset():
    env = make_parallel_env("hidden-offset")
    seen = set()
    for seed in range(20):
        obs, _ = env.reset(seed=seed)
        (offset,) = env.state()
        _, rewards, _, _, _ = env.step({"agent_0": 0, "agent_1": 1})
        assert rewards == {"agent_0": 10 * offset, "agent_1": 1 + 10 * offset}
        assert obs["agent_0"].tolist() == [1]
        seen.add(float(offset))
    assert seen == {-1.0, 1.0}


def test_levers():
    env = make_parallel_env("levers")
    env.reset()
    for t in range(10):
        swapped = t >= 5
        obs, rewards, ends, _, _ = env.step({"agent_0": 3 * swapped + t % 3, "agent_1": 3 * (not swapped) + t % 3})
        assert set(rewards.values()) == {1} and all(ends.values()) == (t == 9)
    assert obs["agent_0"].tolist() == obs["agent_1"].tolist() == [5, 5] and env.state().tolist() == [5] * 4
    env.reset()
    payoffs = table(env)
    assert payoffs[:3, 3:].all() and payoffs.sum() == 9


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: MatrixGame([[1, 2, 3], [4, 5, 6]]), r"the shape \(2, 3\)"),
        (lambda: MatrixGame([[1, np.nan], [0, 0]]), "finite"),
        (lambda: MatrixGame([[1]], n_steps=0), "n_steps=0"),
        (lambda: Penalty(k=5), "k=5"),
        (lambda: Permutation(1), "n=1"),
        (lambda: Cues(0), "n_agents=0"),
    ],
)
def test_wrong_arguments(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_wrong_use():
    env = make_parallel_env("climbing")
    with pytest.raises(ValueError, match="reset"):
        env.step({"agent_0": 0, "agent_1": 0})
    env.reset()
    for actions in ({"agent_0": 0}, {"agent_0": 0, "agent_1": 3}):
        with pytest.raises(ValueError, match="agent_1"):
            env.step(actions)
