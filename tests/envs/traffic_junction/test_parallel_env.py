"""The Traffic Junction as a PettingZoo environment: interface, infos, visibility, seeds and state."""

import json
import pickle

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test, parallel_seed_test

from sb3_belief.envs import TrafficJunction
from tests.envs.traffic_junction.scenarios import EAST, STRAIGHT, TOP, put

LEVELS = ("easy", "medium", "hard")


def play(env, n_steps, seed=0):
    """Return everything that ``n_steps`` steps of random actions return, with visibility and resets, across episodes."""
    generator = np.random.default_rng(seed)
    record = []
    for _ in range(n_steps):
        actions = dict(zip(env.possible_agents, generator.integers(0, 2, size=len(env.possible_agents)).tolist(), strict=True))
        record.append((*env.step(actions), env.visibility()))
        if not env.agents:
            record.append(env.reset())
    return record


def same(a, b):
    """Return whether two results are equal to the bit."""
    return pickle.dumps(a) == pickle.dumps(b)


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("order", ["commnet", "ic3net"])
def test_pettingzoo_api_and_seeds(level, order):
    # A warning of PettingZoo's tests would be a deviation from the interface
    parallel_api_test(TrafficJunction(level, order=order), num_cycles=100)
    parallel_seed_test(lambda: TrafficJunction(level, order=order), num_cycles=100)


def test_seeds_decide_and_go_on():
    envs = [TrafficJunction() for _ in range(3)]
    for env, seed in zip(envs, (5, 5, 6), strict=True):
        env.reset(seed=seed)
    first, second, other = (play(env, 90) for env in envs)
    assert same(first, second)
    assert not same(first, other)
    env = envs[0]
    episodes = []
    for episode_seed in (5, None, None, 5):
        env.reset(seed=episode_seed)
        episodes.append(play(env, 39))
    assert same(episodes[0], episodes[3])
    assert not same(episodes[0], episodes[1]) and not same(episodes[1], episodes[2])


def test_infos_masks_and_the_last_step():
    env = TrafficJunction(arrival_rate=0.4)
    obs, infos = env.reset(seed=1)
    assert all(not values.any() for values in obs.values())
    assert all(info["action_mask"].tolist() == [False, True] for info in infos.values())
    assert not any(row.any() for row in env.visibility().values())
    was_on_road = np.zeros(10, dtype=bool)
    n_life_ends = 0
    for t in range(40):
        acted = dict.fromkeys(env.possible_agents, 0)
        obs, rewards, terminations, truncations, infos = env.step(acted)
        assert [infos[a]["active"] for a in env.possible_agents] == was_on_road.tolist()
        was_on_road = np.array([values[0] == 1 for values in obs.values()])
        for agent, on_road in zip(env.possible_agents, was_on_road, strict=True):
            assert infos[agent]["action_mask"].dtype == bool
            assert infos[agent]["action_mask"].tolist() == [on_road, True]
            assert env.observation_space(agent).contains(obs[agent])
            if not infos[agent]["active"]:
                assert rewards[agent] == 0.0 and not infos[agent]["life_end"]
            n_life_ends += infos[agent]["life_end"]
            assert ("is_success" in infos[agent]) == (t == 39)
        assert not any(terminations.values())
        assert set(truncations.values()) == {t == 39}
        assert set(truncations) == set(env.possible_agents)
        assert env.agents == ([] if t == 39 else env.possible_agents)
    assert n_life_ends > 5
    assert infos["car_0"]["is_success"] is (int(env.core.n_collisions[0]) == 0)


@pytest.mark.parametrize("collides", [True, False])
def test_success_is_no_collision_in_the_whole_episode(collides):
    env = TrafficJunction(arrival_rate=0.0)
    env.reset(seed=0)
    put(env.core, 0, TOP, STRAIGHT, 5)
    put(env.core, 1, EAST, STRAIGHT, 6 if collides else 3)
    actions = dict.fromkeys(env.possible_agents, 0)
    infos = [env.step(actions)[-1] for _ in range(40)]
    assert all(info["is_success"] is not collides for info in infos[-1].values())


@pytest.mark.parametrize("reward,ends", [("own", True), ("team", False)])
def test_arrival_ends_a_life_with_own_reward_only(reward, ends):
    env = TrafficJunction(arrival_rate=0.0, reward=reward)
    env.reset(seed=0)
    put(env.core, 2, TOP, STRAIGHT, 12)
    infos = env.step(dict.fromkeys(env.possible_agents, 0))[-1]
    assert [infos[agent]["life_end"] for agent in env.possible_agents] == [i == 2 and ends for i in range(10)]
    assert infos["car_2"]["active"] and infos["car_2"]["action_mask"].tolist() == [False, True]


def test_visibility_is_that_of_the_moment_of_choice():
    env = TrafficJunction(arrival_rate=0.0)
    env.reset(seed=0)
    put(env.core, 0, TOP, STRAIGHT, 3)
    put(env.core, 1, TOP, STRAIGHT, 5)
    env._observe()
    actions = dict.fromkeys(env.possible_agents, 0)
    # They are two cells apart when they choose, and one cell after the step
    env.step({**actions, "car_1": 1})
    assert not env.visibility()["car_0"].any() and not env.visibility()["car_1"].any()
    # They are one cell apart when they choose, and two cells after the step
    env.step({**actions, "car_0": 1})
    visible = env.visibility()
    assert visible["car_0"].tolist() == [True] + [False] * 8
    assert visible["car_1"].tolist() == [True] + [False] * 8
    assert not visible["car_2"].any()
    env.step(actions)
    assert not env.visibility()["car_0"].any()


def test_reward_scale_and_team_reward():
    plain, scaled, team = (TrafficJunction(**kwargs) for kwargs in ({}, {"reward_scale": 0.1}, {"reward": "team"}))
    for env in (plain, scaled, team):
        env.reset(seed=3)
    total = 0.0
    for own, small, mean in zip(play(plain, 39), play(scaled, 39), play(team, 39), strict=True):
        np.testing.assert_allclose(list(small[1].values()), 0.1 * np.array(list(own[1].values())))
        np.testing.assert_allclose(list(mean[1].values()), np.mean(list(own[1].values())))
        assert plain.team_reward(own[1]) == np.mean(list(own[1].values()))
        total += plain.team_reward(own[1])
    assert total < -1


@pytest.mark.parametrize("at", [0, 17, 40])
def test_state_resumes_exactly_in_another_environment(at):
    env = TrafficJunction(arrival_rate=0.3)
    env.reset(seed=4)
    generator = np.random.default_rng(1)
    for _ in range(at):
        env.step(dict(zip(env.possible_agents, generator.integers(0, 2, size=10).tolist(), strict=True)))
    env.set_arrival_rate(0.25)
    state = pickle.loads(pickle.dumps(env.get_state()))
    json.dumps(state["core"]["generator"])
    other = TrafficJunction()
    other.reset(seed=99)
    other.set_state(state)
    assert other.agents == env.agents
    assert same(other.visibility(), env.visibility())
    if at == 40:
        assert same(env.reset(), other.reset())
    assert same(play(env, 130), play(other, 130))


def test_a_state_is_a_copy():
    env = TrafficJunction(arrival_rate=0.5)
    env.reset(seed=4)
    play(env, 10)
    state = env.get_state()
    before = pickle.dumps(state)
    play(env, 50)
    assert pickle.dumps(state) == before
    env.set_state(state)
    play(env, 50)
    assert pickle.dumps(state) == before


def test_observations_are_not_changed_later():
    env = TrafficJunction(arrival_rate=0.5)
    env.reset(seed=4)
    record = play(env, 1)[0]
    before = pickle.dumps(record)
    play(env, 45)
    assert pickle.dumps(record) == before


@pytest.mark.parametrize(
    "kwargs,message",
    [
        ({"level": "mdium"}, "'easy', 'medium', 'hard'"),
        ({"order": "magym"}, "'commnet', 'ic3net'"),
        ({"reward": "shared"}, "'own', 'team'"),
        ({"arrival_rate": 1.5}, r"\[0, 1\]"),
        ({"arrival_rate": "0.1"}, r"\[0, 1\]"),
        ({"arrival_rate": float("nan")}, r"\[0, 1\]"),
        ({"reward_scale": 0}, "positive"),
        ({"vision": -1}, ">= 0"),
        ({"vision": 1.0}, "integer"),
        ({"observe_last_actions": 1}, "True or False"),
        ({"render_mode": "ansi"}, "'human', 'rgb_array'"),
    ],
)
def test_wrong_arguments(kwargs, message):
    with pytest.raises(ValueError, match=message):
        TrafficJunction(**kwargs)


def test_wrong_use():
    env = TrafficJunction()
    actions = dict.fromkeys(env.possible_agents, 0)
    with pytest.raises(ValueError, match=r"reset\(\)"):
        env.step(actions)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="'car_3' is 2"):
        env.step({**actions, "car_3": 2})
    with pytest.raises(ValueError, match="No action for 'car_9'"):
        env.step({agent: 0 for agent in env.possible_agents[:-1]})
    with pytest.raises(ValueError, match=r"arrival_rate=-0\.1"):
        env.set_arrival_rate(-0.1)
    with pytest.raises(ValueError, match="render_mode"):
        env.render()
    with pytest.raises(ValueError, match="level"):
        env.set_state({**TrafficJunction("easy").get_state()})
