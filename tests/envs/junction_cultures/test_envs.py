"""The junction with cultures as a PettingZoo environment and as a batch, which equal each other to the bit."""

import pickle
from typing import Any

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test, parallel_seed_test

from sb3_belief.envs import JunctionCultures, TrafficJunction, check_team_env, make_batched_env, make_parallel_env
from sb3_belief.envs.junction_cultures.vec_env import JunctionCulturesVecEnv
from sb3_belief.team import make_team_env
from sb3_belief.team.lockstep.joint_loop import JointLoop

VARIANTS: list[dict[str, Any]] = [
    {"rollout_steps": 7, "redraw_every": 1},
    {"level": "easy", "redraw_unit": "episodes", "per_copy": True, "redraw_every": 1, "reveal_partner": True},
    {"cultures": "orders", "held_out": True, "per_copy": True, "redraw_every": 1, "reward_scale": 0.1, "vision": 2},
]
# What an agent's own info may hold
TOLD = {
    *("others_actions", "others_visible", "active", "terminal_observation", "episode", "TimeLimit.truncated"),
    *("is_success", "action_mask", "terminal_action_masks"),
}


@pytest.mark.parametrize("kwargs", VARIANTS)
@pytest.mark.filterwarnings("ignore:Agent was given info but was dead")
def test_pettingzoo_api_and_seeds(kwargs):
    # A warning of PettingZoo's tests would be a deviation from the interface, but for that of what is the team's info
    parallel_api_test(JunctionCultures(**kwargs), num_cycles=100)
    parallel_seed_test(lambda: JunctionCultures(**kwargs), num_cycles=100)


def test_the_env_checker_finds_nothing():
    report = check_team_env("junction-cultures-easy")
    assert not report.failures, str(report)


@pytest.mark.parametrize("kwargs", VARIANTS)
def test_a_batch_equals_single_copies_bit_for_bit(kwargs):
    env = JunctionCulturesVecEnv(3, **kwargs)
    singles = [JunctionCultures(**kwargs) for _ in range(3)]
    env.seed(7)
    obs = env.reset()["car_0"]
    for i, single in enumerate(singles):
        np.testing.assert_array_equal(obs[i], single.reset(seed=7 + i)[0]["car_0"])
    rng = np.random.default_rng(0)
    partners, n_lives = set(), 0
    for _ in range(90):
        actions = rng.choice(2, size=3, p=[0.8, 0.2])
        step, rewards, dones, infos = env.step({"car_0": actions})
        masks = env.action_masks()["car_0"]
        for i, single in enumerate(singles):
            info = infos[i]
            assert info["partner"] == single.partner
            partners.add(info["partner"])
            own, own_rewards, terminations, truncations, own_infos = single.step({"car_0": int(actions[i])})
            assert info["agent_rewards"].tolist() == [rewards[i]] == [np.float32(own_rewards["car_0"])]
            assert info["active"].tolist() == [own_infos["car_0"]["active"]]
            assert info["life_end"].tolist() == [own_infos["car_0"]["life_end"]]
            assert info["truncated"].tolist() == [truncations["car_0"] and not info["life_end"][0]]
            assert dones[i] == truncations["car_0"] and not terminations["car_0"]
            n_lives += info["life_end"][0]
            np.testing.assert_array_equal(info["visible"], [single.visibility()["car_0"]])
            scripted = [np.eye(2)[did] for did in single.scripted_actions().values()]
            np.testing.assert_array_equal(info["scripted_actions"], np.concatenate(scripted))
            mask = own_infos["car_0"]["action_mask"]
            if dones[i]:
                assert (
                    info["TimeLimit.truncated"] == info["truncated"][0]
                    and info["is_success"] == own_infos["car_0"]["is_success"]
                )
                np.testing.assert_array_equal(info["terminal_observation"]["car_0"], own["car_0"])
                own, reset_infos = single.reset()
                mask = reset_infos["car_0"]["action_mask"]
            np.testing.assert_array_equal(step["car_0"][i], own["car_0"])
            np.testing.assert_array_equal(masks[i], mask)
            assert env.get_attr("partner", [i]) == [single.partner]
    assert len(partners) > 1 and n_lives > 0


def test_a_batch_equals_the_general_vectoriser_and_nobody_is_told():
    kwargs: dict[str, Any] = {"level": "easy", "per_copy": True, "redraw_unit": "episodes", "redraw_every": 1}
    batched = make_team_env("junction-cultures-easy", n_envs=3, seed=2, env_kwargs=kwargs)
    general = make_team_env(JunctionCultures, n_envs=3, seed=2, env_kwargs=kwargs)
    assert isinstance(batched, JunctionCulturesVecEnv) and not isinstance(general, JunctionCulturesVecEnv)
    loops = [JointLoop(batched), JointLoop(general)]
    batched.reset(), general.reset()
    rng = np.random.default_rng(0)
    for _ in range(45):
        actions = {"car_0": rng.integers(2, size=3)}
        steps = batched.step(actions), general.step(actions)
        np.testing.assert_array_equal(steps[0][0]["car_0"], steps[1][0]["car_0"])
        np.testing.assert_array_equal(steps[0][1], steps[1][1])
        for info, info2 in zip(steps[0][3], steps[1][3], strict=True):
            assert info.keys() | {"TimeLimit.truncated"} == info2.keys() | {"TimeLimit.truncated"}
            for key in info2.keys() - {"episode", "terminal_observation", "terminal_action_masks"}:
                np.testing.assert_array_equal(info.get(key, False), info2[key], err_msg=key)
            last = [each["terminal_action_masks"]["car_0"].tolist() for each in (info, info2) if "episode" in each]
            assert last[:1] == last[1:]
            assert "agent_infos" not in info and "partner" in info
        for loop, step in zip(loops, steps, strict=True):
            (transition,) = loop._splitter.split(actions, step)
            assert all(info.keys() <= TOLD for info in transition[3])
    general.close()


def test_only_the_oracle_observes_the_culture():
    def observed(partner_seed, **kwargs):
        env = JunctionCultures(level="easy", redraw_every=None, partner_seed=partner_seed, **kwargs)
        return env.partner, env.reset(seed=5)[0]["car_0"]

    found = {observed(seed)[0] for seed in range(8)}
    assert found == {"N-W", "W-N"}
    for seed in range(3):
        (name, seen), (same, told) = observed(seed), observed(seed, reveal_partner=True)
        assert name == same and np.array_equal(told[:-2], seen)
        assert told[-2:].tolist() == {"N-W": [1, 0], "W-N": [0, 1]}[name]


@pytest.mark.parametrize("kwargs", VARIANTS)
@pytest.mark.parametrize("n_envs", [1, 3])
def test_state_resumes_exactly_in_another_environment(kwargs, n_envs):
    def play(env, n_steps):
        rng = np.random.default_rng(1)
        record = []
        for _ in range(n_steps):
            obs, rewards, dones, infos = env.step({"car_0": rng.choice(2, size=n_envs, p=[0.8, 0.2])})
            told = [(info["scripted_actions"].tolist(), info["visible"].tolist(), info["partner"]) for info in infos]
            record.append((obs["car_0"].tolist(), rewards.tolist(), dones.tolist(), told))
        return record

    makes: list[Any] = [lambda: JunctionCulturesVecEnv(n_envs, **kwargs)]
    if n_envs == 1:
        makes.append(lambda: make_team_env(JunctionCultures, env_kwargs=kwargs))
    for make in makes:
        env = make()
        env.seed(1)
        env.reset()
        play(env, 23)
        state = pickle.loads(pickle.dumps(env.exact_state()))
        expected = play(env, 60)
        other = make()
        other.reset()
        other.set_exact_state(state)
        assert play(other, 60) == expected
    with pytest.raises(ValueError, match="with the same arguments"):
        JunctionCultures(vision=3).core.set_state(0, JunctionCultures(**kwargs).core.get_state(0))


def test_ids_and_what_they_share_with_the_traffic_junction():
    for name, level, n_cultures in (("easy", "easy", 2), ("medium", "medium", 2), ("orders", "medium", 24)):
        single = make_parallel_env(f"junction-cultures-{name}")
        batched = make_batched_env(f"junction-cultures-{name}", 2)
        assert isinstance(single, JunctionCultures) and isinstance(batched, JunctionCulturesVecEnv)
        assert single.config == batched.config and len(single.config.names) == n_cultures
        junction = TrafficJunction(level)
        assert single.observation_space("car_0") == junction.observation_space("car_0")
        assert ["car_0", *single.scripted_action_spaces] == junction.possible_agents


def test_wrong_use_and_pictures():
    env = JunctionCultures(level="easy", render_mode="rgb_array", arrival_rate=1.0)
    with pytest.raises(ValueError, match="call reset"):
        env.step({"car_0": 0})
    env.reset(seed=0)
    wrong: list[Any] = [{"car_0": 2}, {"car_1": 0}]
    for actions in wrong:
        with pytest.raises(ValueError, match="needed is that of 'car_0'"):
            env.step(actions)
    batched = JunctionCulturesVecEnv(2, level="easy", render_mode="rgb_array")
    batched.reset()
    with pytest.raises(ValueError, match="must be 0"):
        batched.step({"car_0": np.array([0, 2])})
    with pytest.raises(ValueError, match="num_envs=0"):
        JunctionCulturesVecEnv(0)
    pytest.importorskip("pygame")
    assert env.picture_positions() == {}
    while not env.picture_positions():
        env.step({"car_0": 0})
    image = env.render()
    assert image.shape == batched.get_images()[0].shape and image.std() > 10  # type: ignore[union-attr]
    with pytest.raises(ValueError, match="made without a render mode"):
        JunctionCultures().render()
