"""The returns that policies with and without a memory reach in the switching conventions."""

import numpy as np
import pytest

from sb3_belief.envs.switching_convention.vec_env import SwitchingConventionVecEnv


class Lookup:
    """Policy that does at each cue what the leader did at it in the last rollout, and acts at random at other cues."""

    def __init__(self, m, seed=0):
        self.m, self.generator = m, np.random.default_rng(seed)
        self.known: dict[int, int] = {}
        self.rollout: dict[int, int] = {}

    def act(self, env, cues):
        guesses = self.generator.integers(self.m, size=len(cues))
        return np.array([self.known.get(cue, guess) for cue, guess in zip(cues.tolist(), guesses, strict=True)])

    def watch(self, cues, infos):
        codes = np.array([info["scripted_actions"] for info in infos])
        self.rollout.update(zip(cues.tolist(), codes.argmax(axis=1).tolist(), strict=True))

    def rollout_ends(self):
        self.known, self.rollout = self.rollout, {}


class Knowing(Lookup):
    """Policy that knows the current convention."""

    def act(self, env, cues):
        return env.game.conventions[np.arange(len(cues)), cues]


class Constant(Lookup):
    """Policy that always does the same."""

    def act(self, env, cues):
        return np.ones(len(cues), int)


def rewards_by_rollout(follower, n_rollouts, **kwargs):
    """Return the mean reward of each rollout of 32 copies."""
    env = SwitchingConventionVecEnv(32, **kwargs)
    env.seed(0)
    cues = env.reset()["follower"]
    means = []
    for _ in range(n_rollouts):
        rewards = []
        for _ in range(env.config.rollout_steps):
            obs, reward, _, infos = env.step({"follower": follower.act(env, cues)})
            follower.watch(cues, infos)
            cues = obs["follower"]
            rewards.append(reward.mean())
        follower.rollout_ends()
        means.append(float(np.mean(rewards)))
    return np.array(means)


@pytest.mark.parametrize("kwargs", [{"m": 4, "K": 5}, {"m": 3, "K": 1}, {"K": None}])
def test_who_knows_the_convention_gets_all(kwargs):
    assert (rewards_by_rollout(Knowing(4), 12, **kwargs) == 1.0).all()


def test_who_never_looks_gets_one_in_m():
    means = rewards_by_rollout(Constant(4), 400, m=4, K=1)
    # A constant action is right at a quarter of the cues, whatever the convention
    assert abs(means.mean() - 0.25) < 5 * means.std() / np.sqrt(len(means)) < 0.02


@pytest.mark.parametrize("K", [2, 5])
def test_who_looks_up_the_last_rollout_gets_the_optimum(K):
    means = rewards_by_rollout(Lookup(4), 150 * K, m=4, K=K).reshape(-1, K)
    # What was learned of the previous convention says little about this one, and is right no more often than a guess
    first = means[:, 0]
    assert abs(first.mean() - 0.25) < 4 * first.std() / np.sqrt(len(first)) < 0.1
    assert (means[:, 1:] == 1.0).all()
    assert means.mean() == pytest.approx((K - 1 + 1 / 4) / K, abs=0.1 / K)


def test_who_looks_up_the_last_rollout_gets_all_in_the_second_of_watch_then_act():
    means = rewards_by_rollout(Lookup(4), 40, m=4, K=2, rewarded="last").reshape(-1, 2)
    assert (means == [0.0, 1.0]).all()


def test_negative_control_a_new_convention_in_each_rollout():
    means = rewards_by_rollout(Lookup(4), 400, m=4, K=1)
    assert abs(means.mean() - 0.25) < 4 * means.std() / np.sqrt(len(means)) < 0.1
