"""The Multi-Robot Warehouse: which robot sees which, how episodes end, and reproducibility by seed."""

import pickle
from functools import partial
from typing import Any

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test

from sb3_belief import make_team_env
from sb3_belief.envs.adapters import rware
from tests.envs.adapters.tuple_helpers import (
    act,
    check_advantages,
    check_images_need_no_display,
    check_same_course,
    check_window_is_the_packages_own,
    train_save_load_evaluate,
)

TWO, FOUR = "rware-tiny-2ag-v2", "rware-tiny-4ag-v2"
LOAD = 4


def in_the_observation(env, obs):
    """
    Read from the observations which robot sees which other.

    After 8 numbers of the robot's own, an observation has one block for each cell of the window, row by row. A block begins
    with a 1 where a robot stands.
    """
    game, reach = env.game, env.game.sensor_range
    stands = {(robot.x, robot.y): j for j, robot in enumerate(game.agents)}
    visible = np.zeros((game.n_agents, game.n_agents), dtype=bool)
    for i, observation in enumerate(obs.values()):
        x, y = int(observation[0]), int(observation[1])
        blocks = observation[8:].reshape(2 * reach + 1, 2 * reach + 1, 7 + game.msg_bits)
        for row, column in np.argwhere(blocks[:, :, 0] == 1):
            visible[i, stands[x + int(column) - reach, y + int(row) - reach]] = True
    assert visible.diagonal().all()
    return [np.delete(visible[i], i).tolist() for i in range(game.n_agents)]


@pytest.mark.parametrize("env_kwargs", [{}, {"sensor_range": 3}, {"msg_bits": 2}])
def test_who_is_seen_is_who_is_in_the_observation(env_kwargs):
    env: Any = rware.make(FOUR, max_steps=20, **env_kwargs)
    seen = unseen = at_the_end = 0
    for episode in range(15):
        env.reset(seed=episode)
        assert not any(row.any() for row in env.visibility().values())
        for agent in env.possible_agents:
            env.action_space(agent).seed(episode)
        while env.agents:
            obs, *_ = env.step({agent: env.action_space(agent).sample() for agent in env.possible_agents})
            rows = [row.tolist() for row in env.visibility().values()]
            assert rows == in_the_observation(env, obs)
            seen, unseen = seen + sum(map(sum, rows)), unseen + 12 - sum(map(sum, rows))
        at_the_end += any(map(any, rows))
    assert seen > 50 and unseen > 50 and at_the_end > 2


def test_a_seed_gives_the_same_episode_whatever_was_before():
    used = rware.make(TWO)
    for seed in (0, 3, 3, 1):
        fresh = rware.make(TWO)
        pair: Any = used.reset(seed=seed), fresh.reset(seed=seed)
        rng = np.random.default_rng(seed)
        for _ in range(30):
            assert all(np.array_equal(pair[0][0][agent], pair[1][0][agent]) for agent in pair[0][0])
            actions = rng.integers(5, size=2).tolist()
            pair = act(used, *actions), act(fresh, *actions)


def test_pettingzoo_s_own_test():
    parallel_api_test(rware.make(TWO, max_steps=30), num_cycles=70)


@pytest.mark.parametrize(
    ("env_kwargs", "length"), [({}, 500), ({"max_steps": 7}, 7), ({"max_steps": None, "max_inactivity_steps": 9}, 9)]
)
def test_every_end_is_a_truncation(env_kwargs, length):
    env = rware.make(TWO, **env_kwargs)
    env.reset(seed=0)
    for t in range(1, length + 1):
        _, _, terminations, truncations, infos = act(env, 0, 0)
        assert set(terminations.values()) == {False} and set(truncations.values()) == {t == length}
        assert not any(infos.values())  # There is no success, there are no masks, and all agents are in play
    assert not env.agents


@pytest.mark.parametrize(
    ("reward_type", "own", "team"),
    [(None, [1.0, 0.0], 1.0), ("individual", [1.0, 0.0], 1.0), ("global", [1.0, 1.0], 1.0), ("two_stage", [0.5, 0.0], 0.5)],
)
def test_the_team_s_reward_counts_deliveries(reward_type, own, team):
    kwargs = {} if reward_type is None else {"reward_type": reward_type}
    env: Any = make_team_env(partial(rware.make, TWO, **kwargs), seed=0)
    env.reset()
    (game,) = env.get_attr("game")
    shelf, (x, y) = game.request_queue[0], game.goals[0]
    first, second = game.agents
    first.x, first.y, first.carrying_shelf = x, y, shelf
    second.x, second.y = 0, 0
    shelf.x, shelf.y = x, y
    game._recalc_grid()
    _, rewards, _, infos = env.step({agent: np.zeros(1, int) for agent in env.possible_agents})
    assert infos[0]["agent_rewards"].tolist() == own and rewards.tolist() == [team]


def test_advantages():
    assert set(check_advantages(partial(rware.make, TWO, max_steps=10), lambda obs: False, n_steps=32)) == {False}


def test_state():
    env, other = rware.make(FOUR, max_steps=40), rware.make(FOUR, max_steps=40)
    env.reset(seed=5)
    for robot, shelf in zip(env.game.agents, env.game.shelfs, strict=False):
        robot.x, robot.y = shelf.x, shelf.y
    env.game._recalc_grid()
    act(env, *[LOAD] * 4)
    assert all(robot.carrying_shelf for robot in env.game.agents)
    other.set_state(pickle.loads(pickle.dumps(env.get_state())))
    check_same_course(env, other, 30)


def test_observations_and_arguments():
    env = rware.make(TWO)
    obs, _ = env.reset(seed=0)
    assert obs["agent_0"].shape == (71,) and np.isinf(env.observation_space("agent_0").high).all()  # type: ignore[attr-defined]
    image = rware.make(TWO, observation_type="image", sensor_range=2)
    obs, _ = image.reset(seed=0)
    assert obs["agent_0"].shape == (5, 5, 5) and image.observation_space("agent_0").contains(obs["agent_0"])
    # The package's directional images are rotated views of one array, so the adapter must return copies
    first = obs["agent_1"].copy()
    act(image, 2, 2)
    assert np.array_equal(first, obs["agent_1"])
    assert TWO in rware.names()
    with pytest.raises(ValueError, match=r"no environment 'rware-tiny-2ag-v1'.*Did you mean 'rware-tiny-2ag-v2'"):
        rware.make("rware-tiny-2ag-v1")
    with pytest.raises(ValueError, match="reward_type='shared' must be one of 'global', 'individual', 'two_stage'"):
        rware.make(TWO, reward_type="shared")
    with pytest.raises(ValueError, match="observation_type='dict' must be one of 'flattened', 'image'"):
        rware.make(TWO, observation_type="dict")


def test_images_need_no_display():
    check_images_need_no_display(rware.make(TWO, render_mode="rgb_array"))


def test_the_window_is_the_packages_own():
    check_window_is_the_packages_own(rware.make(TWO, render_mode="human"))


@pytest.mark.parametrize("env_kwargs", [{}, {"msg_bits": 1, "reward_type": "global"}])
def test_training(env_kwargs, tmp_path):
    returns = train_save_load_evaluate(partial(rware.make, TWO, max_steps=20, **env_kwargs), tmp_path)
    assert all(value >= 0 for value in returns)
