"""The convention game with a convention of its own in each copy and episode."""

import pickle
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from pettingzoo.test import parallel_api_test, parallel_seed_test

from sb3_belief.envs import make_batched_env, make_parallel_env
from sb3_belief.envs.reference_policies import reference_returns
from sb3_belief.envs.switching_convention.episode_env import ConventionEpisode, ConventionEpisodeVecEnv
from sb3_belief.envs.switching_convention.policies import (
    BlindFollower,
    KnowingFollower,
    RememberingFollower,
    ideal_convention_return,
)
from sb3_belief.team import make_team_env
from sb3_belief.team.lockstep.joint_loop import JointLoop

VARIANTS: list[dict[str, Any]] = [
    {"rollout_steps": 5},
    {"rollout_steps": 4, "redraw_every": 3, "partner_seed": 2, "reveal_partner": True},
    {"m": 3, "rollout_steps": 3, "redraw_every": 2, "redraw_unit": "rollouts"},
    {"rollout_steps": 3, "redraw_every": 2, "redraw_unit": "rollouts", "per_copy": False, "reveal_partner": True},
    {"rollout_steps": 3, "redraw_every": None},
]


def partners_by_episode(n_episodes, seed=0, n_envs=3, **kwargs):
    """Return who plays in each episode of each copy, and check that it does not change within one."""
    env = ConventionEpisodeVecEnv(n_envs, rollout_steps=4, **kwargs)
    env.seed(seed)
    env.reset()
    met = []
    for _ in range(n_episodes):
        told = [[info["partner"] for info in env.step({"follower": np.zeros(n_envs, int)})[3]] for _ in range(4)]
        assert all(row == told[0] for row in told)
        met.append(told[0])
    return np.array(met).T


def test_each_copy_draws_anew_in_each_episode():
    met = partners_by_episode(200)
    assert (met[0] != met[1]).mean() > 0.8 and (met[:, 1:] != met[:, :-1]).mean() > 0.8
    names, counts = np.unique(met, return_counts=True)
    assert len(names) == 24 and counts.max() < 2.5 * 600 / 24
    # Draws are those of the partners' seed and of the copy's, so that a copy in a batch meets whom it meets alone
    assert (partners_by_episode(20, seed=1)[:2] == met[1:, :20]).all()
    assert (partners_by_episode(20, partner_seed=1) != met[:, :20]).mean() > 0.8


def test_a_leader_stays_as_long_as_asked_for():
    met = partners_by_episode(30, redraw_every=3)
    assert (met.reshape(3, 10, 3) == met.reshape(3, 10, 3)[:, :, :1]).all()
    assert (met[:, 3::3] != met[:, :-3:3]).mean() > 0.8
    assert len(np.unique(partners_by_episode(10, redraw_every=None), axis=1).T) == 1
    together = partners_by_episode(40, redraw_every=2, redraw_unit="rollouts", per_copy=False)
    assert (together == together[0]).all() and len(set(together[0])) > 5


def test_a_reset_in_the_middle_of_an_episode_brings_the_next_convention():
    env = ConventionEpisode(rollout_steps=8)
    met = []
    for seed in (3, None, None, 3, None):
        env.reset(seed=seed)
        met.append(env.partner)
        env.step({"follower": 0})
        assert env.partner == met[-1]
    assert len(set(met[:3])) == 3 and met[3:] == met[:2]


@pytest.mark.parametrize("kwargs", VARIANTS)
def test_a_batch_equals_single_copies_bit_for_bit(kwargs):
    env = ConventionEpisodeVecEnv(3, **kwargs)
    general = make_team_env(ConventionEpisode, n_envs=3, seed=7, env_kwargs=kwargs)
    env.seed(7)
    assert env.observation_space == general.observation_space
    np.testing.assert_array_equal(env.reset()["follower"], general.reset()["follower"])
    generator = np.random.default_rng(0)
    for _ in range(40):
        assert env.get_attr("partner") == general.get_attr("partner")
        actions = {"follower": generator.integers(env.config.m, size=3)}
        (obs, rewards, dones, infos), (obs2, rewards2, dones2, infos2) = env.step(actions), general.step(actions)
        np.testing.assert_array_equal(obs["follower"], obs2["follower"])
        np.testing.assert_array_equal(rewards, rewards2)
        np.testing.assert_array_equal(dones, dones2)
        for info, info2 in zip(infos, infos2, strict=True):
            assert info["partner"] == info2["partner"] and "agent_infos" not in {**info, **info2}
            np.testing.assert_array_equal(info["scripted_actions"], info2["scripted_actions"])
            if "terminal_observation" in info:
                last, last2 = (each["terminal_observation"]["follower"] for each in (info, info2))
                np.testing.assert_array_equal(last, last2)
    general.close()


@pytest.mark.parametrize("reveal_partner", [False, True])
def test_only_with_the_oracle_a_learner_is_told_who_leads(reveal_partner):
    def transitions(partner_seed):
        kwargs = {"partner_seed": partner_seed, "reveal_partner": reveal_partner, "leader_visible": False}
        env = make_team_env("convention-episode", 4, seed=0, env_kwargs={**kwargs, "rollout_steps": 5})
        loop, obs = JointLoop(env), env.reset()["follower"]
        with pytest.raises(AttributeError, match="not 'partner'"):
            loop.agent_envs["follower"].get_attr("partner")
        seen, met = [obs], []
        for _ in range(12):
            actions = {"follower": np.zeros(4, int)}
            step = env.step(actions)
            ((obs, _, dones, infos),) = loop._splitter.split(actions, step)
            assert not any("partner" in info for info in infos)
            met.append([info["partner"] for info in step[3]])
            seen += [obs, dones, *(info["others_actions"] for info in infos)]
        return np.concatenate([np.ravel(each) for each in seen]), met

    (seen, met), (seen2, met2) = transitions(0), transitions(1)
    assert met != met2 and np.array_equal(seen, seen2) != reveal_partner


def test_the_oracle_observes_the_number_of_the_convention():
    env = ConventionEpisode(m=3, reveal_partner=True, rollout_steps=2)
    assert env.observation_space("follower") == spaces.MultiDiscrete([3, 6])
    told: dict[str, int] = {}
    for seed in range(40):
        observation: Any = env.reset(seed=seed)[0]["follower"]
        cue, number = observation
        assert told.setdefault(env.partner, number) == number and cue == env.game.cue[0]
    assert sorted(told) == ["0-1-2", "0-2-1", "1-0-2", "1-2-0", "2-0-1", "2-1-0"]
    assert [told[name] for name in sorted(told)] == list(range(6))


# PettingZoo allows infos of no agent, and its test warns of them all the same
@pytest.mark.filterwarnings("ignore:Agent was given info but was dead")
@pytest.mark.parametrize("kwargs", VARIANTS)
def test_pettingzoo_api_and_seeds(kwargs):
    parallel_api_test(ConventionEpisode(**kwargs), num_cycles=50)
    parallel_seed_test(lambda: ConventionEpisode(**kwargs), num_cycles=50)


@pytest.mark.parametrize("kwargs", VARIANTS)
def test_state_resumes_exactly(kwargs):
    def play(env, n_steps):
        steps = [env.step({"follower": np.array([0, 1])}) for _ in range(n_steps)]
        return [
            (obs["follower"].tolist(), rewards.tolist(), [i["partner"] for i in infos]) for obs, rewards, _, infos in steps
        ]

    env, other = ConventionEpisodeVecEnv(2, **kwargs), ConventionEpisodeVecEnv(2, **kwargs)
    env.seed(1)
    env.reset()
    play(env, 8)
    states = pickle.loads(pickle.dumps(env.get_state()))
    expected = play(env, 30)
    other.reset()
    other.set_state(states)
    assert play(other, 30) == expected


def test_reference_followers():
    n_envs = 32
    env = ConventionEpisodeVecEnv(n_envs)
    assert (reference_returns(KnowingFollower(), env, 2) == 64).all()
    blind = reference_returns(BlindFollower(), env, 12)
    assert abs(blind.mean() - 16) < 4 * blind.std() / np.sqrt(blind.size) < 1
    remembers = reference_returns(RememberingFollower(n_envs), env, 12)
    ideal = ideal_convention_return()
    assert ideal == pytest.approx(62.08, abs=0.01)
    assert abs(remembers.mean() - ideal) < 4 * remembers.std() / np.sqrt(remembers.size) < 0.4


def test_the_ideal_return_of_short_games():
    # One step is a guess, and with two cues the first step shows both
    assert ideal_convention_return(4, 1) == 0.25
    assert ideal_convention_return(2, 5) == 4.5
    # In a second step, the same cue is known and another one is a guess among m - 1
    assert ideal_convention_return(3, 2) == pytest.approx(1 / 3 + 1 / 3 + 2 / 3 * 1 / 2)


@pytest.mark.parametrize(
    "kwargs, says",
    [
        ({"redraw_every": 0}, "redraw_every=0.*must be an integer >= 1"),
        ({"redraw_unit": "steps"}, "redraw_unit='steps'.*is not one of"),
        ({"per_copy": False}, "needs per_copy=True"),
        ({"partner_seed": -1}, "partner_seed=-1.*>= 0"),
        ({"reveal_partner": 1}, "reveal_partner=1 must be True or False"),
        ({"reveal_partner": True, "m": 7}, "Use m <= 6"),
        ({"rollout_steps": 0}, "rollout_steps=0 must be an integer >= 1"),
    ],
)
def test_arguments_that_are_refused(kwargs, says):
    for make in (lambda: ConventionEpisode(**kwargs), lambda: ConventionEpisodeVecEnv(2, **kwargs)):
        with pytest.raises(ValueError, match=says):
            make()


def test_id():
    single, batched = make_parallel_env("convention-episode", m=3), make_batched_env("convention-episode", 2, m=3)
    assert isinstance(single, ConventionEpisode) and isinstance(batched, ConventionEpisodeVecEnv)
    assert single.config == batched.config and single.config.rollout_steps == 64
