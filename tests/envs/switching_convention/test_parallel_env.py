"""The switching conventions: rewards, what the follower sees of the leader, and when the convention changes."""

import pickle
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from pettingzoo.test import parallel_api_test, parallel_seed_test

from sb3_belief.belief_ppo import BeliefPPO
from sb3_belief.envs import SwitchingConvention, make_batched_env, make_parallel_env
from sb3_belief.envs.switching_convention.vec_env import SwitchingConventionVecEnv
from sb3_belief.team import Team, make_team_env
from sb3_belief.team.lockstep.joint_loop import JointLoop
from tests.envs.switching_convention.variants import VARIANTS


def conventions(n, m=4, K: int | None = 1, rollout_steps=1, **kwargs):
    """Return the first ``n`` conventions that an environment plays."""
    env = SwitchingConvention(m=m, K=K, rollout_steps=rollout_steps, **kwargs)
    found = []
    for _ in range(n):
        found.append(env.convention)
        for _ in range((K or 1) * rollout_steps):
            if not env.agents:
                env.reset()
            env.step({"follower": 0})
    return found


@pytest.mark.parametrize("kwargs", VARIANTS)
def test_pettingzoo_api_and_seeds(kwargs):
    # A warning of PettingZoo's tests would be a deviation from the interface
    parallel_api_test(SwitchingConvention(**kwargs), num_cycles=100)
    parallel_seed_test(lambda: SwitchingConvention(**kwargs), num_cycles=100)


def test_what_the_follower_and_others_are_told():
    env = SwitchingConvention(m=6)
    assert env.possible_agents == ["follower"]
    assert env.observation_space("follower") == env.action_space("follower") == spaces.Discrete(6)
    assert env.scripted_action_spaces == {"leader": spaces.Discrete(6)}
    assert env.visibility()["follower"].tolist() == [True]
    assert SwitchingConvention(leader_visible=False).visibility()["follower"].tolist() == [False]


@pytest.mark.parametrize("kwargs", VARIANTS)
def test_rewards_and_leader_step_by_step(kwargs):
    env = SwitchingConvention(**kwargs)
    rules = env.config
    generator = np.random.default_rng(0)
    obs, _ = env.reset(seed=11)
    n_rewarded = n_switches = 0
    life = (rules.K or 1) * rules.rollout_steps
    for age in range(4 * life + rules.rollout_steps):
        cue, convention = obs["follower"], env.convention
        assert sorted(convention) == list(range(rules.m)) and 0 <= cue < rules.m
        # At every other step the follower does what the leader will do, so that rewards are not rare
        action = int(convention[cue]) if age % 2 else int(generator.integers(rules.m))
        obs, rewards, terminations, truncations, infos = env.step({"follower": action})
        counts = rules.rewarded == "always" or age % life >= life - rules.rollout_steps
        assert rewards == {"follower": float(counts and action == convention[cue])}
        assert env.scripted_actions() == {"leader": convention[cue]}
        assert truncations == {"follower": False} and infos == {"follower": {}}
        over = age % rules.rollout_steps == rules.rollout_steps - 1
        assert terminations == {"follower": over} and env.agents == ([] if over else ["follower"])
        n_rewarded += rewards["follower"] > 0
        if not np.array_equal(env.convention, convention):
            assert rules.K is not None and (age + 1) % life == 0
            n_switches += 1
        if over:
            obs, _ = env.reset()
    assert n_rewarded > 0
    assert (n_switches > 0) == (rules.K is not None)


@pytest.mark.parametrize("env_name", ["convention-swap", SwitchingConvention])
@pytest.mark.parametrize("kwargs", [{"m": 3, "K": 2, "rollout_steps": 4}, {"m": 3, "K": 1, "rollout_steps": 3, "seed": 2}])
@pytest.mark.parametrize("leader_visible", [True, False])
def test_the_followers_history_pairs_cues_with_what_the_leader_did_at_them(env_name, kwargs, leader_visible):
    env = make_team_env(env_name, 2, seed=0, env_kwargs={**kwargs, "leader_visible": leader_visible})
    loop = JointLoop(env)
    assert loop.agent_envs["follower"].get_attr("others_action_spaces") == [{"leader": spaces.Discrete(3)}] * 2
    obs = env.reset()["follower"]
    generator = np.random.default_rng(0)
    for _ in range(20):
        played = [int(convention[cue]) for convention, cue in zip(env.get_attr("convention"), obs, strict=True)]
        actions = {"follower": generator.integers(3, size=2)}
        (transition,) = loop._splitter.split(actions, env.step(actions))
        for i in range(2):
            expected = np.eye(3)[played[i]] if leader_visible else np.zeros(3)
            assert transition[3][i]["others_actions"].tolist() == expected.tolist()
            assert transition[3][i]["others_visible"].tolist() == [leader_visible]
            assert transition[1][i] == (actions["follower"][i] == played[i])
        obs = transition[0]
    env.close()


def test_the_sequence_of_conventions_is_one_of_the_seed():
    first = conventions(50, seed=7)
    assert all(np.array_equal(a, b) for a, b in zip(first, conventions(50, K=3, rollout_steps=2, seed=7), strict=True))
    other = conventions(50, seed=8)
    assert sum(np.array_equal(a, b) for a, b in zip(first, other, strict=True)) < 12
    assert len({tuple(c) for c in conventions(9, K=None, seed=7)}) == 1
    assert np.array_equal(conventions(1, K=None, seed=7)[0], first[0])
    # The seed of the cues does not influence the conventions
    env = SwitchingConvention(K=2, rollout_steps=2, seed=7)
    for seed in (0, 7, 12):
        env.reset(seed=seed)
        assert np.array_equal(env.convention, first[0])


def test_conventions_are_uniformly_drawn():
    drawn = np.array(conventions(600, m=3))
    _, counts = np.unique(drawn, axis=0, return_counts=True)
    assert len(counts) == 6
    # The 99.9 % quantile of chi-squared with 5 degrees of freedom
    assert ((counts - 100) ** 2 / 100).sum() < 20.5
    # Successive conventions are independent
    again = (drawn[1:] == drawn[:-1]).all(axis=1).mean()
    assert abs(again - 1 / 6) < 0.05


def test_a_reset_with_a_seed_begins_life_anew_and_one_without_goes_on():
    def play(env, n_steps):
        record = []
        for _ in range(n_steps):
            obs, rewards, *_ = env.step({"follower": 1})
            record.append((obs, rewards, env.scripted_actions(), env.convention.tolist()))
            if not env.agents:
                record.append(env.reset())
        return record

    env = SwitchingConvention(K=2, rollout_steps=4, seed=5)
    first = [env.reset(seed=1), *play(env, 19)]
    assert [env.reset(seed=1), *play(env, 19)] == first
    assert [env.reset(seed=2), *play(env, 19)] != first
    # The environment is reset in the middle of an episode, after 3 of the 8 steps of the first convention
    env.reset(seed=1)
    start = env.convention
    play(env, 3)
    env.reset()
    assert np.array_equal(env.convention, start)
    ages = []
    for age in range(4, 9):
        play(env, 1)
        ages.append((age, np.array_equal(env.convention, start)))
    assert ages == [(4, True), (5, True), (6, True), (7, True), (8, False)]


def test_state_resumes_exactly_in_another_environment():
    kwargs: dict[str, Any] = {"K": 2, "rollout_steps": 5, "seed": 3}

    def play(env, n_steps):
        record = []
        for k in range(n_steps):
            if not env.agents:
                record.append(env.reset())
            record.append((*env.step({"follower": k % 4}), env.scripted_actions(), env.convention.tolist()))
        return record

    for at in (0, 3, 5, 14):
        env = SwitchingConvention(**kwargs)
        env.reset(seed=4)
        play(env, at)
        state = pickle.loads(pickle.dumps(env.get_state()))
        expected = play(env, 30)
        other = SwitchingConvention(**kwargs)
        other.reset(seed=99)
        play(other, 2)
        other.set_state(state)
        assert play(other, 30) == expected
    with pytest.raises(ValueError, match="with the same arguments"):
        SwitchingConvention(m=3).set_state(state)


@pytest.mark.parametrize(
    "kwargs, says",
    [
        ({"m": 1}, "m=1 must be an integer >= 2"),
        ({"m": 2.0}, "m=2.0 must be an integer"),
        ({"K": 0}, "K=0 must be an integer >= 1: for how many rollouts a convention is valid, or None"),
        ({"K": True}, "K=True must be"),
        ({"rollout_steps": 0}, "rollout_steps=0 must be an integer >= 1"),
        ({"rewarded": "first"}, "rewarded='first' is not one of 'always', 'last'"),
        ({"rewarded": "last", "K": None}, "K=None would never reward.*Give K a number"),
        ({"leader_visible": 1}, "leader_visible=1 must be True or False"),
        ({"seed": -1}, "seed=-1 must be an integer >= 0"),
        ({"seed": None}, "seed=None must be an integer"),
    ],
)
def test_arguments_that_are_refused(kwargs, says):
    with pytest.raises(ValueError, match=says):
        SwitchingConvention(**kwargs)
    with pytest.raises(ValueError, match=says):
        SwitchingConventionVecEnv(2, **kwargs)


def test_wrong_use():
    env = SwitchingConvention(rollout_steps=1)
    with pytest.raises(ValueError, match="call reset"):
        env.step({"follower": 0})
    env.reset()
    with pytest.raises(ValueError, match="No action for 'follower'"):
        env.step({"leader": 0})
    wrong: list[Any] = [4, -1, 0.5]
    for action in wrong:
        with pytest.raises(ValueError, match="allowed are the integers 0 to 3"):
            env.step({"follower": action})
    numpy_integer: Any = np.int64(3)
    env.step({"follower": numpy_integer})
    with pytest.raises(ValueError, match="call reset"):
        env.step({"follower": 0})
    with pytest.raises(ValueError, match="num_envs=0"):
        SwitchingConventionVecEnv(0)
    batched = SwitchingConventionVecEnv(2)
    batched.reset()
    for actions in (np.array([0, 4]), np.array([-1, 0]), np.array([0.0, 1.0])):
        with pytest.raises(ValueError, match="integers from 0 to 3"):
            batched.step({"follower": actions})


def test_ids():
    for env_id, K, rewarded in (
        ("convention-swap", 2, "always"),
        ("convention-watch-act", 2, "last"),
        ("convention-redraw", 5, "always"),
    ):
        single, batched = make_parallel_env(env_id, m=3), make_batched_env(env_id, 2, m=3)
        assert isinstance(single, SwitchingConvention) and isinstance(batched, SwitchingConventionVecEnv)
        assert single.config == batched.config
        assert (single.config.m, single.config.K, single.config.rewarded) == (3, K, rewarded)


def test_a_follower_learns_what_the_leader_does():
    env = make_team_env("convention-swap", n_envs=4, env_kwargs={"rollout_steps": 8})
    policy_kwargs: dict[str, Any] = {"net_arch": [8], "embedding_dim": 8, "latent_dim": 4}
    small: dict[str, Any] = {"n_steps": 8, "batch_size": 32, "history_length": 32, "device": "cpu"}
    team = Team(BeliefPPO, "BeliefPolicy", env, seed=0, policy_kwargs=policy_kwargs, **small).learn(96)
    model: Any = team.agents["follower"]
    # The third rollout plays only the second convention, and the leader's action is visible at every step
    (second,) = {tuple(row) for row in env.get_attr("convention")}
    buffer = model.rollout_buffer
    played = np.array(second)[buffer.observations.astype(int).ravel()]
    np.testing.assert_array_equal(buffer.others_actions.argmax(axis=-1).ravel(), played)
    assert buffer.others_visible.all()
