"""The Traffic Junction as one batch: its copies equal single environments to the bit."""

import pickle

import numpy as np
import pytest
from pettingzoo import ParallelEnv

from sb3_belief.envs import TrafficJunction
from sb3_belief.envs.env_util import make_team_env
from sb3_belief.envs.traffic_junction.policies import all_gas, evaluate_junction_policy
from sb3_belief.envs.traffic_junction.vec_env import TrafficJunctionVecEnv

VARIANTS = [
    {},
    {"order": "ic3net", "arrival_rate": 0.4},
    {"reward": "team", "reward_scale": 0.1},
    {"level": "easy", "vision": 2, "observe_last_actions": True},
    {"level": "hard", "arrival_rate": 0.2},
]


def assert_same_step(e, i, obs, step, single: ParallelEnv):
    """
    Compare copy ``i`` of a batch with a single environment after the same step.

    :param e: What the single environment's ``step`` returned
    :param i: Number of the copy
    :param obs: Observations of the batch
    :param step: Rewards, dones and infos of the batch
    :param single: The single environment
    """
    rewards, dones, infos = step
    single_obs, single_rewards, _, truncations, single_infos = e
    agents = single.possible_agents
    own = np.array([single_rewards[agent] for agent in agents])
    info = infos[i]
    assert info["agent_rewards"].tobytes() == own.astype(np.float32).tobytes()
    assert rewards[i] == np.float32(single.team_reward(single_rewards))
    assert info["active"].tolist() == [single_infos[agent]["active"] for agent in agents]
    assert info["life_end"].tolist() == [single_infos[agent]["life_end"] for agent in agents]
    assert info["truncated"].tolist() == [truncations[a] and not single_infos[a]["life_end"] for a in agents]
    visibility = single.visibility()
    assert info["visible"].tolist() == [visibility[agent].tolist() for agent in agents]
    assert dones[i] == (not single.agents)
    if dones[i]:
        assert info["TimeLimit.truncated"] is True
        assert info["is_success"] is single_infos[agents[0]]["is_success"]
        assert info["episode"]["l"] == single.core.max_steps
        obs = info["terminal_observation"]
    else:
        assert "terminal_observation" not in info and "is_success" not in info and "episode" not in info
    for agent in agents:
        values = obs[agent] if dones[i] else obs[agent][i]
        assert values.dtype == np.float32
        assert values.tobytes() == single_obs[agent].tobytes()


@pytest.mark.parametrize("kwargs", VARIANTS)
@pytest.mark.parametrize("n_envs", [1, 3])
def test_copies_equal_single_environments_bit_for_bit(kwargs, n_envs):
    env = TrafficJunctionVecEnv(n_envs, **kwargs)
    env.seed(7)
    obs = env.reset()
    singles = [TrafficJunction(**kwargs) for _ in range(n_envs)]
    first = [single.reset(seed=7 + i) for i, single in enumerate(singles)]
    agents = env.possible_agents
    generator = np.random.default_rng(0)
    masks = env.action_masks()
    for i, (single_obs, single_infos) in enumerate(first):
        assert all(obs[agent][i].tobytes() == single_obs[agent].tobytes() for agent in agents)
        assert all(masks[agent][i].tolist() == single_infos[agent]["action_mask"].tolist() for agent in agents)
    n_visible = n_life_ends = 0
    for _ in range(2 * env.core.max_steps + 5):
        joint = (generator.random((len(agents), n_envs)) < 0.3).astype(int)
        obs, rewards, dones, infos = env.step(dict(zip(agents, joint, strict=True)))
        masks = env.action_masks()
        assert rewards.dtype == np.float32 and rewards.shape == (n_envs,)
        for i, single in enumerate(singles):
            single_step = single.step({agent: int(joint[k, i]) for k, agent in enumerate(agents)})
            assert_same_step(single_step, i, obs, (rewards, dones, infos), single)
            n_visible += infos[i]["visible"].sum()
            n_life_ends += infos[i]["life_end"].sum()
            single_infos = single_step[-1]
            if not single.agents:
                single_obs, single_infos = single.reset()
                assert all(obs[agent][i].tobytes() == single_obs[agent].tobytes() for agent in agents)
            assert all(masks[agent][i].tolist() == single_infos[agent]["action_mask"].tolist() for agent in agents)
    assert n_visible > 0
    assert (n_life_ends > 0) == (kwargs.get("reward") != "team")


def test_equals_the_parallel_env_under_the_general_vectoriser():
    batched = make_team_env("traffic-junction-medium", n_envs=2, seed=3, env_kwargs={"arrival_rate": 0.3})
    general = make_team_env(TrafficJunction, n_envs=2, seed=3, env_kwargs={"arrival_rate": 0.3})
    assert isinstance(batched, TrafficJunctionVecEnv) and not isinstance(general, TrafficJunctionVecEnv)
    first, second = batched.reset(), general.reset()
    generator = np.random.default_rng(0)
    for _ in range(85):
        masks = general.action_masks()
        assert masks is not None
        for agent in batched.possible_agents:
            np.testing.assert_array_equal(first[agent], second[agent])
            np.testing.assert_array_equal(batched.action_masks()[agent], masks[agent])
        actions = dict(zip(batched.possible_agents, generator.integers(0, 2, size=(10, 2)), strict=True))
        first, rewards, dones, infos = batched.step(actions)
        second, other_rewards, other_dones, other_infos = general.step(actions)
        np.testing.assert_array_equal(rewards, other_rewards)
        np.testing.assert_array_equal(dones, other_dones)
        for info, other in zip(infos, other_infos, strict=True):
            for key in ("agent_rewards", "visible", "active", "life_end", "truncated", "is_success", "TimeLimit.truncated"):
                np.testing.assert_array_equal(info.get(key, False), other.get(key, False), err_msg=key)
            assert info.get("episode", {}).get("r") == other.get("episode", {}).get("r")
            for agent, values in info.get("terminal_observation", {}).items():
                np.testing.assert_array_equal(values, other["terminal_observation"][agent])
    general.close()


def test_a_batch_has_the_statistics_of_single_copies():
    env = TrafficJunction(arrival_rate=0.1)
    env.reset(seed=12345)
    actions = dict.fromkeys(env.possible_agents, 0)
    episodes, successes, occupancies = 250, 0, []
    for _ in range(episodes):
        occupancy = 0.0
        while env.agents:
            infos = env.step(actions)[-1]
            occupancy += env.core.on_road.mean() / 40
        successes += infos["car_0"]["is_success"]
        occupancies.append(occupancy)
        env.reset()
    batch = evaluate_junction_policy(all_gas, 2048, seed=1, arrival_rate=0.1)
    single = successes / episodes
    assert abs(single - batch.success_rate) < 4 * np.sqrt(batch.standard_error**2 + single * (1 - single) / episodes)
    assert abs(np.mean(occupancies) - batch.occupancy) < 5 * np.std(occupancies) / np.sqrt(episodes)


def test_copies_differ_and_reset_goes_on():
    env = TrafficJunctionVecEnv(2, arrival_rate=0.5)
    env.seed(0)
    env.reset()
    brakes = {agent: np.ones(2, dtype=int) for agent in env.possible_agents}
    first = env.step(brakes)[0]
    for _ in range(3):
        first = env.step(brakes)[0]
    assert any(not np.array_equal(values[0], values[1]) for values in first.values())
    draws = env.core.draws.copy()
    env.reset()
    assert not np.array_equal(env.core.draws, draws), "a seed is used once"


def test_state_resumes_exactly():
    env = TrafficJunctionVecEnv(3, arrival_rate=0.3)
    env.seed(5)
    env.reset()
    generator = np.random.default_rng(0)

    def play(target, draws):
        steps = [target.step(dict(zip(target.possible_agents, draw, strict=True))) for draw in draws]
        # All but the wall-clock time that the monitor writes
        return pickle.dumps(
            [(dict(o), r, d, [{**i, "episode": i.get("episode", {}).get("r")} for i in infos]) for o, r, d, infos in steps]
        )

    play(env, generator.integers(0, 2, size=(40, 10, 3)))
    states = pickle.loads(pickle.dumps(env.get_state()))
    draws = generator.integers(0, 2, size=(90, 10, 3))
    expected = play(env, draws)
    other = TrafficJunctionVecEnv(3)
    other.reset()
    obs = other.set_state(states)
    assert all(not values.any() for values in obs.values()), "the states are those of new episodes"
    assert play(other, draws) == expected
    with pytest.raises(ValueError, match="2 copies for 3"):
        other.set_state(states[:2])


def test_set_arrival_rate_reaches_all_copies():
    env = TrafficJunctionVecEnv(4, arrival_rate=0.0)
    env.reset()
    gas = {agent: np.zeros(4, dtype=int) for agent in env.possible_agents}
    assert not any(values.any() for values in env.step(gas)[0].values())
    env.env_method("set_arrival_rate", 1.0)
    obs = env.step(gas)[0]
    np.testing.assert_array_equal(np.sum([values[:, 0] for values in obs.values()], axis=0), 4)


def test_wrong_use():
    with pytest.raises(ValueError, match="num_envs=0"):
        TrafficJunctionVecEnv(0)
    with pytest.raises(ValueError, match="level='huge'"):
        TrafficJunctionVecEnv(2, level="huge")
    env = TrafficJunctionVecEnv(2)
    env.reset()
    actions = {agent: np.zeros(2, dtype=int) for agent in env.possible_agents}
    with pytest.raises(ValueError, match=r"0 \(gas\) or 1 \(brake\)"):
        env.step({**actions, "car_0": np.array([0, 3])})
    with pytest.raises(ValueError, match="render_mode"):
        env.render()
