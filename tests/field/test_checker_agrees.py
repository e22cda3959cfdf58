"""What the environment checker says agrees with what training does, on environments good and bad."""

import re
from functools import partial

import numpy as np
import pytest
from gymnasium import spaces

from sb3_belief import BeliefPPO, envs
from sb3_belief.envs import env_checker
from tests.field import test_own_infos, test_success_at_some_ends, test_unusual_returns, test_who_is_in_play
from tests.field.test_names import NUMBERS, TUPLES, Named
from tests.field.unusual import CLEAR, InfoOfTheGame
from tests.field.walkers import Walkers
from tests.team.helpers import PPO_KWARGS, Team, make_team_env

Shifts = test_who_is_in_play.Shifts


def with_fault(fault):
    class Faulty(test_unusual_returns.Wrong):
        pass

    Faulty.fault = staticmethod(fault)
    return Faulty


class Square(Walkers):
    obs_space = spaces.Box(0, 1, (), np.float32)
    act_space = spaces.MultiDiscrete(np.array([[2, 3], [4, 2]]))

    def observe(self, agent):
        return np.float32(0.5)


class Doubles(Walkers):
    """float64 where the space says float32."""

    def observe(self, agent):
        return super().observe(agent).astype(np.float64)


class Unbounded(Walkers):
    act_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)


class FromOne(Walkers):
    act_space = spaces.Discrete(3, start=1)


class CountsFromOne(Walkers):
    obs_space = spaces.Discrete(3, start=1)

    def observe(self, agent):
        return 2


class TooLarge(Walkers):
    """A choice that there is not, at the second step."""

    obs_space = spaces.Discrete(2)

    def observe(self, agent):
        return self.t


class Words(Walkers):
    act_space = spaces.Text(5)


class Nobody(Walkers):
    def reset(self, seed=None, options=None):
        result = super().reset()
        self.agents = []
        return result


class ShortMask(Walkers):
    def reset(self, seed=None, options=None):
        obs, infos = super().reset()
        return obs, {agent: {"action_mask": np.ones(2)} for agent in infos}


class Stranger(Walkers):
    def change(self, obs, *parts):
        return {**obs, "stranger": 0}, *parts


class NarrowSight(Walkers):
    def visibility(self):
        return {agent: [True, True] for agent in self.possible_agents}


class TwoRewards(Walkers):
    def team_reward(self, rewards):
        return np.ones(2)


class Late(Walkers):
    """A fault far beyond the first episodes."""

    steps = 0

    def change(self, obs, rewards, *parts):
        self.steps += 1
        return obs, dict.fromkeys(rewards, np.nan if self.steps == 10 else 1.0), *parts


GOOD = {
    **{kind.__name__: kind for kind in CLEAR},
    "walkers": Walkers,
    "relay": partial(Shifts, ["0", "0", "1", "1", ""]),
    "relay by limits": partial(Shifts, ["0", "1", "1", ""], cut=True),
    "one list": test_who_is_in_play.OneList,
    "infos": test_own_infos.Fuel,
    "taken infos": test_own_infos.Greedy,
    "successes": test_success_at_some_ends.Sometimes,
    "numbers": partial(Named, NUMBERS),
    "tuples": partial(Named, TUPLES),
    "paths": partial(Named, ["../up", "a/b"]),
    "square": Square,
    "doubles": Doubles,
}
BAD = {
    **{name: with_fault(fault) for name, (fault, _) in test_unusual_returns.FAULTS.items()},
    "no last words": test_who_is_in_play.NoLastWords,
    "unbounded": Unbounded,
    "from one": FromOne,
    "counts from one": CountsFromOne,
    "too large": TooLarge,
    "words": Words,
    "nobody": Nobody,
    "short mask": ShortMask,
    "stranger": Stranger,
    "narrow sight": NarrowSight,
    "two rewards": TwoRewards,
    "same text": partial(Named, [1, "1"]),
    "late": Late,
    "impostor": test_unusual_returns.Impostor,
    "nothing": lambda: None,
    "no environment": dict,
}


def train(make):
    """Train a small team as a user does, with the random numbers of another seed than the checker's."""
    env = make_team_env(make, n_envs=2, seed=5)
    Team(BeliefPPO, "BeliefPolicy", env, seed=5, **PPO_KWARGS).learn(48)


def test_there_are_more_than_forty():
    assert len(GOOD) >= 30 and len(BAD) >= 30


@pytest.mark.parametrize("make", GOOD.values(), ids=GOOD)
@pytest.mark.filterwarnings("ignore")
def test_no_failures_and_a_training_that_ends_well(make):
    report = envs.check_team_env(make, n_steps=12)
    assert report.failures == [], str(report)
    assert "ok    training: a small team of BeliefPPO learns" in str(report)
    train(make)


@pytest.mark.parametrize("make", BAD.values(), ids=BAD)
@pytest.mark.filterwarnings("ignore")
def test_failures_and_a_training_that_is_refused_with_agent_and_step(make):
    assert envs.check_team_env(make, n_steps=12).failures
    with pytest.raises((ValueError, TypeError)) as error:
        train(make)
    message = str(error.value)
    at_work = re.search(r"in environment copy \d at (reset|step \d+)", message)
    # What is wrong from the beginning is refused when the environment is made
    at_once = re.match(r"(The (action|observation) space of 'walker_0' is|A team needs a|Two agents of)", message)
    assert at_work or at_once, message


@pytest.mark.parametrize("fault", [TypeError("raw"), KeyError("raw")])
def test_what_only_a_training_finds_is_a_failure(monkeypatch, fault):
    def trial(make, n_steps, seed):
        raise fault

    monkeypatch.setattr(env_checker, "load_attribute", lambda name: trial)
    [finding] = envs.check_team_env(Walkers, n_steps=12).failures
    assert finding.topic == "training" and finding.text.startswith(f"a small team fails with {type(fault).__name__}: ")


def test_the_trial_is_left_out_where_there_are_failures():
    assert "note  training: not tried before the failures are mended" in str(envs.check_team_env(Late, n_steps=12))


class Revived(Walkers):
    """PettingZoo's own test asserts that no agent comes back, which a team can live with."""

    def observation_space(self, agent):
        return spaces.Box(-1e6, 1e6, (3,), np.float32)


def test_pettingzoos_own_test_is_run():
    text = str(envs.check_team_env(Revived, n_steps=12))
    assert "note  pettingzoo: parallel_api_test() fails with AssertionError: observation_space should return the exact" in text
    assert "ok    pettingzoo: parallel_api_test() passes" in str(envs.check_team_env(Walkers, n_steps=12))
    text = str(envs.check_team_env(InfoOfTheGame, n_steps=12))
    assert "note  pettingzoo: parallel_api_test() warns: Agent was given info but was dead last turn" in text
