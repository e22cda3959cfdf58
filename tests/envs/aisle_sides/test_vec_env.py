"""The aisles as one batch: its copies equal single environments to the bit, and its state can be restored."""

import pickle
from typing import Any

import numpy as np
import pytest

from sb3_belief.belief_ppo import BeliefPPO
from sb3_belief.envs import AisleSides
from sb3_belief.envs.aisle_sides.vec_env import AisleSidesVecEnv
from sb3_belief.team import Team, make_team_env
from sb3_belief.team.lockstep.joint_loop import JointLoop
from tests.envs.aisle_sides.variants import VARIANTS

# What an agent's own info may hold
TOLD = {"others_actions", "others_visible", "active", "terminal_observation", "episode", "TimeLimit.truncated", "truncated"}


def random_actions(env, rng):
    return {agent: rng.integers(3, size=env.num_envs) for agent in env.possible_agents}


@pytest.mark.parametrize("kwargs", VARIANTS)
@pytest.mark.parametrize("n_envs", [1, 3])
def test_a_batch_equals_single_copies_bit_for_bit(kwargs, n_envs):
    env = AisleSidesVecEnv(n_envs, **kwargs)
    singles = [AisleSides(**kwargs) for _ in range(n_envs)]
    env.seed(7)
    obs = env.reset()
    for i, single in enumerate(singles):
        for agent, values in single.reset(seed=7 + i)[0].items():
            np.testing.assert_array_equal(obs[agent][i], values)
    rng = np.random.default_rng(0)
    partners = set()
    for _ in range(90):
        actions = random_actions(env, rng)
        obs, rewards, dones, infos = env.step(actions)
        assert rewards.dtype == np.float32
        for i, single in enumerate(singles):
            assert infos[i]["partner"] == single.partner
            partners.add(single.partner)
            own, own_rewards, terminations, truncations, _ = single.step({a: int(v[i]) for a, v in actions.items()})
            info = infos[i]
            assert info["agent_rewards"].tolist() == list(own_rewards.values())
            assert rewards[i] == pytest.approx(np.mean(list(own_rewards.values())), abs=1e-7)
            assert info["truncated"].tolist() == list(truncations.values()) == [dones[i]] * len(own)
            assert not any(terminations.values()) and not info["life_end"].any() and info["active"].all()
            np.testing.assert_array_equal(info["visible"], list(single.visibility().values()))
            scripted = [np.eye(3)[did] for did in single.scripted_actions().values()]
            np.testing.assert_array_equal(info["scripted_actions"], np.concatenate(scripted))
            if dones[i]:
                assert info["TimeLimit.truncated"] is True
                for agent, values in info["terminal_observation"].items():
                    np.testing.assert_array_equal(values, own[agent])
                own = single.reset()[0]
            assert env.get_attr("partner", [i]) == [single.partner]
            for agent, values in own.items():
                assert obs[agent].dtype == values.dtype == np.float32
                np.testing.assert_array_equal(obs[agent][i], values)
    assert len(partners) > 1 or kwargs.get("redraw_every", 5) in (None, 5)


def test_a_batch_equals_the_general_vectoriser():
    kwargs: dict[str, Any] = {"n_robots": 2, "kinds": 2, "max_steps": 7, "rollout_steps": 7, "redraw_every": 1}
    batched = make_team_env("aisle-sides", n_envs=3, seed=2, env_kwargs=kwargs)
    general = make_team_env(AisleSides, n_envs=3, seed=2, env_kwargs=kwargs)
    assert isinstance(batched, AisleSidesVecEnv) and not isinstance(general, AisleSidesVecEnv)
    batched.reset(), general.reset()
    rng = np.random.default_rng(0)
    for _ in range(30):
        actions = random_actions(batched, rng)
        (obs, rewards, dones, infos), (obs2, rewards2, dones2, infos2) = batched.step(actions), general.step(actions)
        for agent in batched.possible_agents:
            np.testing.assert_array_equal(obs[agent], obs2[agent])
        np.testing.assert_array_equal(dones, dones2)
        np.testing.assert_allclose(rewards, rewards2, atol=1e-7)
        assert batched.get_attr("partner") == general.get_attr("partner")
        for info, info2 in zip(infos, infos2, strict=True):
            assert info.keys() | {"TimeLimit.truncated"} == info2.keys() | {"TimeLimit.truncated"}
            for key in info2.keys() - {"episode", "terminal_observation"}:
                np.testing.assert_array_equal(info.get(key, False), info2[key], err_msg=key)
    general.close()


def test_nothing_of_the_convention_reaches_an_agents_own_info():
    for env_name in ("aisle-sides", AisleSides):
        env = make_team_env(env_name, 3, seed=0, env_kwargs={"per_copy": True})
        loop = JointLoop(env)
        env.reset()
        actions = {"robot_0": np.zeros(3, dtype=np.int64)}
        for _ in range(45):
            step = env.step(actions)
            assert all("partner" in info and "agent_infos" not in info for info in step[3])
            (transition,) = loop._splitter.split(actions, step)
            assert all(info.keys() <= TOLD for info in transition[3])
        env.close()


def test_a_learner_sees_what_the_other_did_in_a_meeting():
    env = make_team_env("aisle-sides", 2, seed=0)
    loop = JointLoop(env)
    obs, seen = env.reset()["robot_0"], 0
    for _ in range(40):
        side = {"left": 1, "right": 2}[env.get_attr("partner")[0]]
        actions = {"robot_0": np.array([1, 2])}
        (transition,) = loop._splitter.split(actions, env.step(actions))
        for i in range(2):
            in_sight, meets = bool(obs[i, 2:5].any()), bool(obs[i, 2:4].any()) and obs[i, 1] == 0
            assert transition[3][i]["others_visible"].tolist() == [in_sight]
            expected = np.eye(3)[side if meets else 0] * in_sight
            assert transition[3][i]["others_actions"].tolist() == expected.tolist()
            seen += meets
        obs = transition[0]
    assert seen > 4


@pytest.mark.parametrize("kwargs", VARIANTS)
def test_state_of_a_batch_resumes_exactly(kwargs):
    def play(env, n_steps):
        rng = np.random.default_rng(1)
        record = []
        for _ in range(n_steps):
            obs, rewards, dones, infos = env.step(random_actions(env, rng))
            told = [(info["scripted_actions"].tolist(), info["visible"].tolist(), info["partner"]) for info in infos]
            record.append(({agent: values.tolist() for agent, values in obs.items()}, rewards.tolist(), dones.tolist(), told))
        return record

    env = AisleSidesVecEnv(3, **kwargs)
    env.seed(1)
    env.reset()
    play(env, 23)
    states = pickle.loads(pickle.dumps(env.get_state()))
    expected = play(env, 60)
    other = AisleSidesVecEnv(3, **kwargs)
    other.reset()
    other.set_state(states)
    assert play(other, 60) == expected
    with pytest.raises(ValueError, match="2 copies for 3"):
        other.set_state(states[:2])


def test_arrays_of_a_step_are_not_shared():
    env = AisleSidesVecEnv(4, max_steps=3)
    env.seed(0)
    env.reset()
    kept = [env.step({"robot_0": np.ones(4, int)}) for _ in range(9)]
    copies = pickle.loads(pickle.dumps(kept))
    for step in kept:
        step[1][:] += 10.0
        step[0]["robot_0"][:] += 10.0
    for (*_, infos), (*_, infos2) in zip(kept, copies, strict=True):
        assert all((info["agent_rewards"] == info2["agent_rewards"]).all() for info, info2 in zip(infos, infos2, strict=True))


def test_a_team_learns_on_it():
    env = make_team_env("aisle-sides-kinds", n_envs=4, env_kwargs={"n_robots": 2, "max_steps": 8, "rollout_steps": 8})
    policy_kwargs: dict[str, Any] = {"net_arch": [8], "embedding_dim": 8, "latent_dim": 4}
    small: dict[str, Any] = {"n_steps": 8, "batch_size": 32, "history_length": 32, "device": "cpu"}
    team = Team(BeliefPPO, "BeliefPolicy", env, seed=0, policy_kwargs=policy_kwargs, **small).learn(64)
    model: Any = team.agents["robot_1"]
    # The other learner is never seen, and the robot of the own aisle sometimes
    assert model.rollout_buffer.others_visible.shape[-1] == 3
    visible = model.rollout_buffer.others_visible.reshape(-1, 3)
    assert not visible[:, :2].any() and visible[:, 2].any()
