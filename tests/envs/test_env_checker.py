"""The environment checker: correct environments pass, and each fault is reported with what to change."""

import threading
from typing import Any, ClassVar

import numpy as np
import pytest
from gymnasium import spaces
from mpe2 import simple_spread_v3
from pettingzoo import ParallelEnv

from sb3_belief.envs import check_team_env, registered_ids
from sb3_belief.envs.env_checker import Report
from tests.team.toy_envs import MaskedEnv, MixedEnv, PartneredEnv, ScriptedEnv, ToyEnv


def failures(env, **kwargs):
    """Return the texts of the failures by topic."""
    return {finding.topic: finding.text for finding in check_team_env(env, n_steps=40, **kwargs).failures}


@pytest.mark.parametrize("env", [*registered_ids(), ToyEnv, MaskedEnv, MixedEnv, PartneredEnv, ScriptedEnv])
def test_what_is_right_passes(env):
    # These two count their episodes in what they return, and a seed does not reset that count
    assert set(failures(env)) == ({"seeding"} if env in (ScriptedEnv, PartneredEnv) else set())


def test_a_report_says_what_was_seen():
    report = check_team_env(MixedEnv, n_steps=40)
    text = str(report)
    assert "visibility: 53.3% of the others' actions are visible, always mutual" in text
    assert "8 episodes of 5 to 5 steps, 8 terminated and 0 truncated; if 5 steps are a time limit, report it by trunc" in text
    assert "note  state: no get_state() and set_state(): its attributes are saved in their place" in text
    assert text.endswith("No failures.")
    masked = str(check_team_env(MaskedEnv, {"n_agents": 3}, n_steps=20))
    assert "masks: of 2 agents, 33% of the actions are possible" in masked
    assert "2 episodes of 7 to 7 steps, 0 terminated and 2 truncated" in masked
    junction = str(check_team_env("traffic-junction-easy", {"arrival_rate": 0.0}, n_steps=20))
    assert "inactive in 100 of 100 actions" in junction and "0.0% of the others' actions are visible" in junction


class Faulty(ToyEnv):
    """
    A ``ToyEnv`` with one fault from step 3 on.

    :param fault: Name of the method that makes the fault
    """

    metadata: ClassVar[dict[str, Any]] = {"name": "faulty"}

    def __init__(self, fault: str):
        super().__init__(n_agents=3, limit=5)
        self.fault = fault

    def step(self, actions):
        result = [dict(part) for part in super().step(actions)]
        if self.t >= 3:
            getattr(self, self.fault)(*result)
        return tuple(result)

    def renames(self, obs, rewards, terminations, truncations, infos):
        obs["agent_7"] = obs.pop("agent_1")

    def plays_a_stranger(self, obs, rewards, terminations, truncations, infos):
        self.agents = [*self.agents[:2], "agent_7"]

    def forgets_an_observation(self, obs, rewards, terminations, truncations, infos):
        del obs["agent_1"]

    def wrong_shape(self, obs, rewards, terminations, truncations, infos):
        obs["agent_1"] = np.zeros(3, np.float32)

    def nan(self, obs, rewards, terminations, truncations, infos):
        obs["agent_1"][1] = np.nan

    def text(self, obs, rewards, terminations, truncations, infos):
        obs["agent_1"] = "here"

    def no_reward(self, obs, rewards, terminations, truncations, infos):
        rewards["agent_1"] = None

    def infinite_reward(self, obs, rewards, terminations, truncations, infos):
        rewards["agent_1"] = np.inf

    def both_ends(self, obs, rewards, terminations, truncations, infos):
        if self.t == 5:
            terminations["agent_1"] = True

    def stays(self, obs, rewards, terminations, truncations, infos):
        terminations["agent_1"] = True

    def sneaks_away(self, obs, rewards, terminations, truncations, infos):
        self.agents = [agent for agent in self.agents if agent != "agent_1"]

    def numbers_for_flags(self, obs, rewards, terminations, truncations, infos):
        terminations["agent_1"] = 0.0

    def no_info(self, obs, rewards, terminations, truncations, infos):
        infos["agent_1"] = [3]

    def odd_life_end(self, obs, rewards, terminations, truncations, infos):
        infos["agent_1"] = {"life_end": "yes"}

    def late_mask(self, obs, rewards, terminations, truncations, infos):
        infos["agent_1"] = {"action_mask": np.ones(3, bool)}

    def raises(self, obs, rewards, terminations, truncations, infos):
        raise ArithmeticError("the toy broke")


@pytest.mark.parametrize(
    ("fault", "topic", "message"),
    [
        ("renames", "names", "observations have 'agent_7' at step 3, which is not in possible_agents"),
        ("plays_a_stranger", "names", "agents have 'agent_7' at step 3"),
        ("forgets_an_observation", "observations", "none for 'agent_1' at step 3"),
        ("wrong_shape", "observations", "that of 'agent_1' at step 3 has the shape (3,) instead of (2,)"),
        ("nan", "observations", "that of 'agent_1' at step 3 holds nan"),
        ("text", "observations", "that of 'agent_1' at step 3 is a str"),
        ("no_reward", "rewards", "that of 'agent_1' at step 3 is None"),
        ("infinite_reward", "rewards", "that of 'agent_1' at step 3 is inf"),
        ("both_ends", "ends", "'agent_1' at step 5 is both terminated and truncated"),
        ("stays", "ends", "'agent_1' at step 3 has ended but is still in agents"),
        ("sneaks_away", "ends", "'agent_1' at step 3 left agents without termination or truncation"),
        ("numbers_for_flags", "ends", "terminations and truncations are [0.0, False] for 'agent_1' at step 3"),
        ("no_info", "play", "The info of 'agent_1' at step 3 is a list of 1"),
        ("odd_life_end", "flags", "infos['agent_1']['life_end'] at step 3 is 'yes'"),
        ("late_mask", "masks", "the first one of 'agent_1' comes at step 3"),
        ("raises", "play", "step 3 fails with ArithmeticError: the toy broke"),
    ],
)
def test_each_fault_is_found_and_says_what_to_change(fault, topic, message):
    found = failures(Faulty, env_kwargs={"fault": fault})
    assert topic in found
    assert message in found[topic] and "Change: " in found[topic]


class Masks(MaskedEnv):
    """
    A ``MaskedEnv`` in which ``agent_0`` has a given mask at step 2.

    :param mask: The mask. None for no mask
    """

    def __init__(self, mask):
        super().__init__(n_agents=2)
        self.mask = mask

    def infos(self):
        infos = super().infos()
        if self.t == 2:
            infos["agent_0"] = {} if self.mask is None else {"action_mask": np.array(self.mask)}
        return infos


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        ([True, False], "that of 'agent_0' at step 2 has 2 entries"),
        ([0.5, 0, 1], "that of 'agent_0' at step 2 has 3 entries, [0.5, 0.0, 1.0]"),
        ([False] * 3, "that of 'agent_0' at step 2 allows no action"),
        (None, "none for 'agent_0' at step 2, though it had one before"),
    ],
)
def test_masks_that_cannot_be(mask, message):
    assert message in failures(Masks, env_kwargs={"mask": mask})["masks"]


class Sight(ToyEnv):
    """
    A ``ToyEnv`` with a given visibility.

    :param rows: What ``visibility()`` returns
    """

    def __init__(self, rows):
        super().__init__(n_agents=3)
        self.rows = rows

    def visibility(self):
        return self.rows


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([[True, True]] * 3, "it returns a list at step 1"),
        ({"agent_0": [True]}, "the entry for 'agent_0' at step 1 is [True] (1)"),
        ({"agent_0": [0.5, 1]}, "the entry for 'agent_0' at step 1 is [0.5, 1.0] (2)"),
        ({"agent_9": [True, True]}, "the entry for 'agent_9' at step 1"),
        ({"agent_0": [True, True]}, "no entry for 'agent_1', which acted at step 1"),
    ],
)
def test_visibility_that_cannot_be(rows, message):
    assert message in failures(Sight, env_kwargs={"rows": rows})["visibility"]


def test_one_sided_visibility_is_told():
    rows = {"agent_0": [True, True], "agent_1": [False, False], "agent_2": [True, False]}
    text = str(check_team_env(Sight, {"rows": rows}, n_steps=20))
    # Of the three pairs only 0 and 1 are one-sided
    assert "50.0% of the others' actions are visible, one-sided in 33.3% of the pairs" in text


class Unseeded(ToyEnv):
    """A ``ToyEnv`` with a reward from a generator that ``reset()`` does not seed."""

    def step(self, actions):
        result = super().step(actions)
        if self.t == 3:
            result[1]["agent_0"] += np.random.default_rng().normal()
        return result


class LeftOver(ToyEnv):
    """A ``ToyEnv`` whose first observations depend on how often it has been reset."""

    start = 0.0

    def reset(self, seed=None, options=None):
        obs, infos = super().reset(seed)
        self.start += 1.0
        return {agent: value + np.float32(self.start) for agent, value in obs.items()}, infos


def test_seeds_that_do_not_decide_all():
    found = failures(Unseeded)["seeding"]
    assert "something else from step 3 on, when the same environment is reset with it again. Change: reset(seed=s)" in found
    assert "something else from the reset on, when the same environment" in failures(LeftOver)["seeding"]


class StateOf(ToyEnv):
    """
    A ``ToyEnv`` with ``get_state()`` and ``set_state()``.

    :param forgets: Whether the state lacks the generators
    """

    def __init__(self, forgets: bool):
        super().__init__()
        self.forgets = forgets

    def get_state(self):
        rngs = {} if self.forgets else {agent: rng.bit_generator.state for agent, rng in self.rngs.items()}
        return self.t, {agent: position.copy() for agent, position in self.positions.items()}, self.agents[:], rngs

    def set_state(self, state):
        self.t, self.positions, self.agents, rngs = state
        for agent, rng_state in rngs.items():
            self.rngs[agent].bit_generator.state = rng_state


def test_a_state_that_lacks_something():
    assert "state" not in failures(StateOf, env_kwargs={"forgets": False})
    found = failures(StateOf, env_kwargs={"forgets": True})["state"]
    assert "after set_state() the same actions give something else. Change: get_state() must return all" in found


class Nested(ToyEnv):
    """A ``ToyEnv`` with a nested observation space that no model takes."""

    def observation_space(self, agent):
        return spaces.Dict({"a": spaces.Tuple([spaces.Text(3)])})


class Fickle(ToyEnv):
    """A ``ToyEnv`` whose observation space changes between calls."""

    calls = 0

    def observation_space(self, agent):
        self.calls += 1
        return spaces.Box(-np.inf, np.inf, (2 + (self.calls > 3),), np.float32)


class ResetsWrong(ToyEnv):
    """A ``ToyEnv`` whose ``reset()`` returns too much."""

    def reset(self, seed=None, options=None):
        return *super().reset(seed), {}


class NobodyPlays(ToyEnv):
    """A ``ToyEnv`` without agents after ``reset()``."""

    def reset(self, seed=None, options=None):
        result = super().reset(seed)
        self.agents = []
        return result


ONE = ToyEnv()


@pytest.mark.parametrize(
    ("env", "topic", "message"),
    [
        (Nested, "spaces", "The observation space of 'agent_0' is Dict('a/0': Text("),
        (Fickle, "spaces", "differ from call to call. Change: make them once"),
        (ResetsWrong, "play", "reset() fails with ValueError: reset() returned a tuple of 3"),
        (NobodyPlays, "play", "agents is empty after reset()"),
        (simple_spread_v3.env, "making", "Change: wrap it: sb3_belief.envs.to_parallel(env)"),
        (dict, "making", "it returns a dict. Change: return an object of a subclass of pettingzoo.ParallelEnv"),
        (lambda: ONE, "making", "returns the same environment each time. Change: make a new one"),
        (lambda: 1 // 0, "making", "it raises ZeroDivisionError"),
    ],
)
def test_environments_that_cannot_be_played(env, topic, message):
    found = failures(env)
    assert list(found) == [topic] and message in found[topic]


def test_what_cannot_be_sent_to_a_worker_process():
    lock = threading.Lock()

    def make():
        with lock:
            return ToyEnv()

    assert "cannot be sent to a worker process: TypeError" in failures(make)["pickling"]


def test_the_checked_environment_is_closed():
    class Closes(ToyEnv):
        closed: ClassVar[list[ParallelEnv]] = []

        def close(self):
            self.closed.append(self)

    check_team_env(Closes, n_steps=10)
    assert len(Closes.closed) >= 2


def test_what_the_checker_refuses():
    with pytest.raises(ValueError, match="Unknown environment id 'zzz'"):
        check_team_env("zzz")
    with pytest.raises(ValueError, match="n_steps=1 must be at least 2"):
        check_team_env(ToyEnv, n_steps=1)


def test_a_report_counts_its_failures():
    report = Report()
    report.add("a", "ok", "fine")
    assert str(report) == "ok    a: fine\nNo failures."
    report.add("b", "FAIL", "bad")
    assert str(report).endswith("FAIL  b: bad\n1 failure.") and [finding.topic for finding in report.failures] == ["b"]


class Generating(MixedEnv):
    """Environment that holds what is no data."""

    def reset(self, seed=None, options=None):
        self.numbers = (i for i in range(3))
        return super().reset(seed, options)


def test_a_state_that_cannot_be_saved_is_said():
    text = str(check_team_env(Generating, n_steps=20))
    assert "a run begins new episodes at each checkpoint, since" in text and "numbers" in text
