"""The switching conventions as one batch: its copies equal single environments to the bit, and its state can be restored."""

import pickle
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from sb3_belief.envs import SwitchingConvention
from sb3_belief.envs.switching_convention.vec_env import SwitchingConventionVecEnv
from sb3_belief.team import make_team_env
from tests.envs.switching_convention.variants import VARIANTS


def test_cues_are_uniform():
    env = SwitchingConventionVecEnv(64, m=4)
    env.seed(0)
    env.reset()
    cues = [env.step({"follower": np.zeros(64, int)})[0]["follower"] for _ in range(100)]
    counts = np.bincount(np.concatenate(cues), minlength=4)
    assert (np.abs(counts - 1600) < 4 * np.sqrt(1600 * 0.75)).all()


def test_copies_meet_the_same_conventions_with_cues_of_their_own():
    env = SwitchingConventionVecEnv(5, K=2, rollout_steps=3, seed=4)
    env.seed(0)
    cues, switches = [env.reset()["follower"]], 0
    for _ in range(30):
        before = env.get_attr("convention")
        assert all(np.array_equal(convention, before[0]) for convention in before)
        cues.append(env.step({"follower": np.zeros(5, int)})[0]["follower"])
        switches += not np.array_equal(before[0], env.get_attr("convention", [3])[0])
    assert 3 <= switches <= 5
    assert len(np.unique(np.array(cues), axis=1).T) == 5


@pytest.mark.parametrize("kwargs", VARIANTS)
@pytest.mark.parametrize("n_envs", [1, 3])
def test_a_batch_equals_single_copies_bit_for_bit(kwargs, n_envs):
    env = SwitchingConventionVecEnv(n_envs, **kwargs)
    singles = [SwitchingConvention(**kwargs) for _ in range(n_envs)]
    env.seed(7)
    first = env.reset()["follower"]
    assert first.dtype == np.int64
    assert first.tolist() == [single.reset(seed=7 + i)[0]["follower"] for i, single in enumerate(singles)]
    generator = np.random.default_rng(0)
    length = env.config.rollout_steps
    for t in range(60):
        actions = generator.integers(env.config.m, size=n_envs)
        obs, rewards, dones, infos = env.step({"follower": actions})
        assert rewards.dtype == np.float32 and obs["follower"].dtype == np.int64
        for i, single in enumerate(singles):
            single_obs, single_rewards, terminations, _, _ = single.step({"follower": int(actions[i])})
            info = infos[i]
            assert rewards[i] == single_rewards["follower"] and info["agent_rewards"].tolist() == [rewards[i]]
            assert info["agent_rewards"].dtype == info["scripted_actions"].dtype == np.float32
            leader = single.scripted_action_spaces["leader"]
            np.testing.assert_array_equal(
                info["scripted_actions"], spaces.flatten(leader, single.scripted_actions()["leader"])
            )
            assert info["visible"].tolist() == [single.visibility()["follower"].tolist()]
            assert info["active"].tolist() == [True] and info["truncated"].tolist() == [False]
            assert info["life_end"].tolist() == [dones[i]] == [terminations["follower"]]
            if dones[i]:
                assert (t + 1) % length == 0 and info["episode"]["l"] == length
                assert info["TimeLimit.truncated"] is False
                assert info["terminal_observation"] == single_obs
                single_obs = single.reset()[0]
            else:
                assert "terminal_observation" not in info
            assert obs["follower"][i] == single_obs["follower"]
            assert np.array_equal(env.get_attr("convention")[i], single.convention)


@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
def test_a_batch_equals_the_general_vectoriser(vec_env):
    batched = make_team_env("convention-watch-act", n_envs=3, seed=2, env_kwargs={"rollout_steps": 5})
    general = make_team_env(
        SwitchingConvention, n_envs=3, seed=2, vec_env=vec_env, env_kwargs={"K": 2, "rewarded": "last", "rollout_steps": 5}
    )
    assert isinstance(batched, SwitchingConventionVecEnv) and not isinstance(general, SwitchingConventionVecEnv)
    assert batched.scripted_action_spaces == general.scripted_action_spaces
    np.testing.assert_array_equal(batched.reset()["follower"], general.reset()["follower"])
    generator = np.random.default_rng(0)
    for _ in range(23):
        actions = {"follower": generator.integers(4, size=3)}
        (obs, rewards, dones, infos), (obs2, rewards2, dones2, infos2) = batched.step(actions), general.step(actions)
        np.testing.assert_array_equal(obs["follower"], obs2["follower"])
        assert obs["follower"].dtype == obs2["follower"].dtype
        np.testing.assert_array_equal(rewards, rewards2)
        np.testing.assert_array_equal(dones, dones2)
        for info, info2 in zip(infos, infos2, strict=True):
            # Worker processes report at every step whether a limit was reached, the batch only at an end
            assert info.keys() | {"TimeLimit.truncated"} == info2.keys() | {"TimeLimit.truncated"}
            for key in info2.keys() - {"episode", "terminal_observation"}:
                np.testing.assert_array_equal(info.get(key, False), info2[key], err_msg=key)
            if "episode" in info:
                assert info["episode"]["r"] == info2["episode"]["r"]
                assert info["terminal_observation"]["follower"] == info2["terminal_observation"]["follower"]
    general.close()


def test_arrays_of_a_step_are_not_shared():
    env = SwitchingConventionVecEnv(4, rollout_steps=3)
    env.seed(0)
    env.reset()
    kept = [env.step({"follower": np.zeros(4, int)}) for _ in range(9)]
    copies = pickle.loads(pickle.dumps(kept))
    for step in kept:
        step[1][:] += 10.0
    for (*_, infos), (*_, infos2) in zip(kept, copies, strict=True):
        assert all(info["agent_rewards"] == info2["agent_rewards"] for info, info2 in zip(infos, infos2, strict=True))


def test_state_of_a_batch_resumes_exactly():
    kwargs: dict[str, Any] = {"K": 2, "rollout_steps": 5}

    def play(env, n_steps):
        steps = [env.step({"follower": np.arange(3) % 4}) for _ in range(n_steps)]
        # All but the wall-clock time that the monitor writes
        return [
            (obs["follower"].tolist(), rewards.tolist(), dones.tolist(), [info["scripted_actions"].tolist() for info in infos])
            for obs, rewards, dones, infos in steps
        ]

    env = SwitchingConventionVecEnv(3, **kwargs)
    env.seed(1)
    env.reset()
    play(env, 13)
    states = pickle.loads(pickle.dumps(env.get_state()))
    cues = env.game.cue
    expected = play(env, 40)
    other = SwitchingConventionVecEnv(3, **kwargs)
    other.reset()
    assert other.set_state(states)["follower"].tolist() == cues.tolist()
    assert play(other, 40) == expected
    with pytest.raises(ValueError, match="2 copies for 3"):
        other.set_state(states[:2])
