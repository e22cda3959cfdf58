"""Level-Based Foraging: which agent sees which, how episodes end, and reproducibility by seed."""

import copy
import pickle
from functools import partial
from typing import Any

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test

from sb3_belief import make_team_env
from sb3_belief.envs.adapters import lbf
from tests.envs.adapters.tuple_helpers import (
    act,
    check_advantages,
    check_images_need_no_display,
    check_same_course,
    check_window_is_the_packages_own,
    train_save_load_evaluate,
)

TWO, THREE = "Foraging-2s-8x8-2p-2f-coop-v3", "Foraging-2s-10x10-3p-3f-v3"
NORTH, WEST, LOAD = 1, 3, 5


def placed(name, *players, food=((6, 6, 4),), **env_kwargs):
    """Return an environment whose players, of level 1, and whose food (row, column, level) stand where a test wants them."""
    env: Any = lbf.make(name, **env_kwargs)
    env.reset(seed=0)
    env.game.field[:] = 0
    for row, column, level in food:
        env.game.field[row, column] = level
    env.game._food_spawned = env.game.field.sum()
    for player, position in zip(env.game.players, players, strict=True):
        player.position, player.level = position, 1
    env.game._gen_valid_moves()
    return env


def in_the_observation(env, obs):
    """
    Read from the observations which agent sees which other.

    Each visible player has a block [row, column, level], counted from the corner of the viewer's window. All players at that
    position are in view. There can be two, because the package lets a player into a cell that another fails to leave.
    """
    game = env.game
    stands: dict[Any, list[int]] = {}
    for j, player in enumerate(game.players):
        stands.setdefault(player.position, []).append(j)
    visible = np.zeros((game.n_agents, game.n_agents), dtype=bool)
    for i, observation in enumerate(obs.values()):
        corner = np.maximum(np.array(game.players[i].position) - game.sight, 0)
        for block in observation[3 * game.max_num_food :].reshape(-1, 3):
            if block[2] > 0:
                visible[i, stands[tuple((block[:2] + corner).astype(int))]] = True
    assert visible.diagonal().all()
    return [np.delete(visible[i], i).tolist() for i in range(game.n_agents)]


@pytest.mark.parametrize("name", [TWO, THREE, "Foraging-2s-5x5-4p-1f-v3", "Foraging-8x8-2p-2f-v3"])
def test_who_is_seen_is_who_is_in_the_observation(name):
    env, rng = lbf.make(name, max_episode_steps=10), np.random.default_rng(0)
    n, one_sided, at_the_end, seen = len(env.possible_agents), 0, 0, 0
    for episode in range(60):
        env.reset(seed=episode)
        assert not any(row.any() for row in env.visibility().values())
        while env.agents:
            obs, *_ = act(env, *rng.integers(6, size=n).tolist())
            rows = [row.tolist() for row in env.visibility().values()]
            assert rows == in_the_observation(env, obs)
            one_sided += rows[0][0] != rows[1][0]
            seen += sum(map(sum, rows))
        at_the_end += any(map(any, rows))
    assert seen > 100 and at_the_end > 5
    assert (one_sided > 10) == name.startswith("Foraging-2s")


@pytest.mark.parametrize(
    ("first", "second", "seen"),
    [
        ((0, 0), (4, 4), [True, False]),  # A player in the upper left corner sees four cells far, the other one two
        ((0, 0), (5, 4), [False, False]),
        ((1, 1), (4, 1), [True, False]),
        ((3, 3), (5, 5), [True, True]),
        ((3, 3), (6, 3), [False, False]),
        ((7, 7), (5, 5), [True, True]),  # In the lower right corner sight is as in the middle
        ((7, 7), (4, 7), [False, False]),
        ((7, 0), (7, 4), [True, False]),
        ((0, 7), (4, 7), [True, False]),
    ],
)
def test_who_is_seen_at_the_borders(first, second, seen):
    env = placed(TWO, first, second, food=((6, 2, 4),))
    obs, *_ = act(env, 0, 0)
    assert [row.tolist() for row in env.visibility().values()] == [[flag] for flag in seen]
    # The level in the block that follows the agent's own
    assert [bool(own[6 + 3 + 2] > 0) for own in obs.values()] == seen


def test_packed_blocks_are_not_taken_for_agents():
    """The second player sees the third but not the first, whose block would be the next one."""
    env = placed(THREE, (9, 9), (4, 4), (5, 5))
    obs, *_ = act(env, 0, 0, 0)
    assert [row.tolist() for row in env.visibility().values()] == [[False, False], [False, True], [False, True]]
    assert obs["agent_1"][9 + 3 + 2] > 0 and obs["agent_1"][9 + 6 + 2] == 0


def test_a_seed_gives_the_same_episode_whatever_was_before():
    """Without the adapter the package would avoid the cells in which players stood last."""
    used = lbf.make(TWO)
    for seed in [*range(40), 39, 39]:
        first, fresh = used.reset(seed=seed)[0], lbf.make(TWO).reset(seed=seed)[0]
        assert all(np.array_equal(first[agent], fresh[agent]) for agent in first)
        for _ in range(3):
            act(used, NORTH, WEST)


def test_pettingzoo_s_own_test():
    parallel_api_test(lbf.make(THREE), num_cycles=120)


@pytest.mark.parametrize(("limit", "steps", "success"), [(50, 2, True), (2, 2, True), (1, 1, False)])
def test_the_limit_truncates_only_where_food_is_left(limit, steps, success):
    env = placed(TWO, (2, 1), (2, 3), food=((2, 2, 2),), max_episode_steps=limit)
    assert act(env, LOAD, 0)[1] == {"agent_0": 0.0, "agent_1": 0.0}  # One player alone cannot load this food
    if steps == 1:
        env = placed(TWO, (2, 1), (2, 3), food=((2, 2, 2),), max_episode_steps=limit)
    _, rewards, terminations, truncations, infos = act(env, LOAD, LOAD if success else 0)
    assert set(terminations.values()) == {success} and set(truncations.values()) == {not success}
    assert [info["is_success"] for info in infos.values()] == [success] * 2
    assert rewards == dict.fromkeys(env.possible_agents, 0.5 * success) and not env.agents


def test_random_episodes_end_at_50_or_with_the_last_food():
    env: Any = make_team_env(partial(lbf.make, "Foraging-5x5-2p-1f-v3"), n_envs=4, seed=0)
    env.reset()
    rng, ends = np.random.default_rng(0), []
    for _ in range(400):
        _, _, dones, infos = env.step({agent: rng.integers(6, size=4) for agent in env.possible_agents})
        ends += [info for info, done in zip(infos, dones, strict=True) if done]
    for info in ends:
        collected = info["terminal_observation"]["agent_0"][2] == 0  # The food's level, which is seen from everywhere
        assert info["is_success"] == collected and info["TimeLimit.truncated"] == (not collected)
        assert info["truncated"].tolist() == [not collected] * 2 and info["life_end"].tolist() == [collected] * 2
        # The team's return is the collected share of the food
        assert info["episode"]["r"] == pytest.approx(float(collected), abs=1e-5)
        assert collected or info["episode"]["l"] == 50
    assert {info["is_success"] for info in ends} == {True, False}


def test_advantages():
    make = partial(lbf.make, "Foraging-5x5-2p-1f-v3", max_episode_steps=8)
    assert set(check_advantages(make, lambda obs: bool(obs[2] == 0), n_steps=128)) == {True, False}


@pytest.mark.parametrize("carry", [copy.deepcopy, lambda state: pickle.loads(pickle.dumps(state))])
def test_state(carry):
    env, other = lbf.make(THREE, max_episode_steps=6), lbf.make(THREE, max_episode_steps=6)
    env.reset(seed=5)
    act(env, 0, 1, 2)
    state = carry(env.get_state())
    other.set_state(state)
    state["game"]["field"][:] = 99  # The environment has copied the state that it was given
    assert other.agents and np.array_equal(list(other.visibility().values()), list(env.visibility().values()))
    check_same_course(env, other, 20)


def test_arguments():
    env = lbf.make(TWO, sight=3, penalty=0.1, max_episode_steps=7)
    assert (env.game.sight, env.game.penalty, env.game._max_episode_steps) == (3, 0.1, 7)
    assert (lbf.make(TWO).game.sight, lbf.make(TWO).game._max_episode_steps) == (2, 50)
    assert TWO in lbf.names() and THREE in lbf.names() and not any("grid" in name for name in lbf.names())
    with pytest.raises(
        ValueError, match=r"no environment 'Foraging-8x8-2p-2f-coop-v2'.*Did you mean 'Foraging-8x8-2p-2f-coop-v3'"
    ):
        lbf.make("Foraging-8x8-2p-2f-coop-v2")
    with pytest.raises(ValueError, match="grid_observation=True is not supported"):
        lbf.make(TWO, grid_observation=True)


def test_making_one_warns_of_nothing(recwarn):
    lbf.make(THREE).reset(seed=0)
    assert not recwarn.list


def test_images_need_no_display():
    check_images_need_no_display(lbf.make(TWO, render_mode="rgb_array"))


def test_the_window_is_the_packages_own():
    check_window_is_the_packages_own(lbf.make(TWO, render_mode="human"))


@pytest.mark.parametrize("name", [TWO, THREE])
def test_training(name, tmp_path):
    returns = train_save_load_evaluate(partial(lbf.make, name, max_episode_steps=12), tmp_path)
    assert all(0 <= value <= 1.001 for value in returns)
