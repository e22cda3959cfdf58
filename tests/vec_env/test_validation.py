"""Errors of an environment or of whoever acts in it are reported with the agent, the environment copy and the step."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from tests.team.helpers import make_team_env
from tests.team.toy_envs import MaskedEnv, MixedEnv, PartneredEnv, ToyEnv

ACTIONS: dict[str, Any] = {f"agent_{i}": np.zeros(2, int) for i in range(3)}


class Faulty(ToyEnv):
    """
    A ``ToyEnv`` of three agents, of which every second copy has one fault.

    The fault occurs at step 3 of the second episode, or at the reset before it where its name begins with ``reset_``.

    :param fault: Name of the method that makes the fault
    """

    made = 0

    def __init__(self, fault: str):
        super().__init__(n_agents=3, limit=4)
        self.fault, self.episode = fault, 0
        self.number = Faulty.made % 2
        Faulty.made += 1

    def reset(self, seed=None, options=None):
        self.episode += 1
        obs, infos = super().reset(seed)
        if self.number and self.episode == 2 and self.fault.startswith("reset_"):
            getattr(self, self.fault)(obs)
        return obs, infos

    def step(self, actions):
        result = super().step(actions)
        if self.number and self.episode == 2 and self.t == 3 and not self.fault.startswith("reset_"):
            getattr(self, self.fault)(*result)
        return result

    def visibility(self):
        rows = {agent: [True, True] for agent in self.possible_agents}
        if self.number and self.episode == 2 and self.t == 3:
            rows |= {"rows": {"agent_1": [True]}, "stranger": {"agent_7": [True, True]}}.get(self.fault, {})
            if self.fault == "no_dict":
                return list(rows.values())
        return rows

    def rows(self, *parts):
        pass

    stranger = no_dict = no_fault = rows

    def reset_nan(self, obs):
        obs["agent_1"][0] = np.nan

    def reset_shape(self, obs):
        obs["agent_1"] = np.zeros((2, 1), np.float32)

    def reset_missing(self, obs):
        del obs["agent_1"]

    def reset_renamed(self, obs):
        self.agents[1] = "agent_7"

    def nan(self, obs, rewards, terminations, truncations, infos):
        obs["agent_1"][1] = np.nan

    def infinite(self, obs, rewards, terminations, truncations, infos):
        obs["agent_1"][1] = -np.inf

    def nan_reward(self, obs, rewards, terminations, truncations, infos):
        rewards["agent_1"] = np.nan

    def nan_at_the_end(self, obs, rewards, terminations, truncations, infos):
        obs["agent_1"][1] = np.nan
        truncations.update(dict.fromkeys(truncations, True))
        self.agents = []

    def nan_of_who_leaves(self, obs, rewards, terminations, truncations, infos):
        obs["agent_1"][1] = np.nan
        truncations["agent_1"] = True
        self.agents = ["agent_0", "agent_2"]

    def shape(self, obs, rewards, terminations, truncations, infos):
        obs["agent_1"] = np.zeros(3, np.float32)

    def nothing(self, obs, rewards, terminations, truncations, infos):
        obs["agent_1"] = None

    def missing(self, obs, rewards, terminations, truncations, infos):
        del obs["agent_1"]

    def no_reward(self, obs, rewards, terminations, truncations, infos):
        del rewards["agent_1"]

    def renamed(self, obs, rewards, terminations, truncations, infos):
        obs["agent_7"] = obs.pop("agent_1")

    def renamed_reward(self, obs, rewards, terminations, truncations, infos):
        rewards["agent_7"] = rewards.pop("agent_1")

    def renamed_agent(self, obs, rewards, terminations, truncations, infos):
        self.agents[1] = "agent_7"


def run(env):
    """Reset, and make nine steps: two episodes and the first step of the third."""
    env.reset()
    for _ in range(9):
        env.step(ACTIONS)


FAULTS = [
    ("reset_nan", "The observation of 'agent_1' in environment copy 1 at reset holds nan (index 0)"),
    ("reset_shape", "The observation of 'agent_1' in environment copy 1 at reset has the shape (2, 1)"),
    ("reset_missing", "The environment's observations lack 'agent_1' in environment copy 1 at reset"),
    ("reset_renamed", "The environment's agents have 'agent_7' in environment copy 1 at reset"),
    ("nan", "The observation of 'agent_1' in environment copy 1 at step 3 holds nan (index 1)"),
    ("infinite", "The observation of 'agent_1' in environment copy 1 at step 3 holds -inf"),
    ("nan_reward", "The reward of 'agent_1' in environment copy 1 at step 3 holds nan"),
    ("nan_at_the_end", "The observation of 'agent_1' in environment copy 1 at step 3 holds nan"),
    ("nan_of_who_leaves", "The observation of 'agent_1' in environment copy 1 at step 3 holds nan"),
    ("shape", "The observation of 'agent_1' in environment copy 1 at step 3 has the shape (3,)"),
    ("nothing", "The observation of 'agent_1' in environment copy 1 at step 3 has the shape () and type object"),
    ("missing", "The environment's observations lack 'agent_1' in environment copy 1 at step 3"),
    ("no_reward", "The environment's rewards lack 'agent_1' in environment copy 1 at step 3"),
    ("renamed", "The environment's observations have 'agent_7' in environment copy 1 at step 3"),
    ("renamed_reward", "The environment's rewards have 'agent_7' in environment copy 1 at step 3"),
    ("renamed_agent", "The environment's agents have 'agent_7' in environment copy 1 at step 3"),
    ("rows", "visibility() has 1 flags for 'agent_1' in environment copy 1 at step 3"),
    ("stranger", "visibility() has an entry for 'agent_7' in environment copy 1 at step 3"),
    ("no_dict", "visibility() returned a list in environment copy 1 at step 3"),
]


@pytest.mark.parametrize(("fault", "message"), FAULTS)
def test_an_environment_that_goes_wrong(fault, message):
    Faulty.made = 0
    env = make_team_env(partial(Faulty, fault), n_envs=2)
    with pytest.raises(ValueError) as error:
        run(env)
    assert str(error.value).startswith(message)


def test_without_a_fault_it_runs():
    Faulty.made = 0
    run(make_team_env(partial(Faulty, "no_fault"), n_envs=2))


def test_numbers_are_looked_at_in_worker_processes_too():
    # Faulty would not do here: it counts the environments of its own process, and each worker makes only one
    env = make_team_env(partial(AlwaysNaN, 2), n_envs=2, vec_env="subproc")
    env.reset()
    env.step(ACTIONS)
    with pytest.raises(ValueError, match="The observation of 'agent_0' in environment copy 0 at step 2 holds nan"):
        env.step(ACTIONS)
    env.close()


class AlwaysNaN(ToyEnv):
    """
    A ``ToyEnv`` of three agents, one of which observes NaN at a given step.

    :param at: The step
    """

    def __init__(self, at):
        super().__init__(n_agents=3)
        self.at = at

    def observations(self):
        obs = super().observations()
        if self.t == self.at:
            obs["agent_0"][:] = np.nan
        return obs


@pytest.mark.filterwarnings("error")
def test_large_numbers_are_numbers():
    class Large(ToyEnv):
        def observations(self):
            return {agent: np.full(2, 3e38, np.float32) for agent in self.agents}

    env = make_team_env(partial(Large, n_agents=3), n_envs=2)
    run(env)


MIXED: dict[str, Any] = {
    "zeta": np.array([0, 1]),
    "box": np.zeros((2, 2), np.float32),
    "multi": np.zeros((2, 2), int),
    "binary": np.zeros((2, 2), np.int8),
}


@pytest.mark.parametrize(
    ("agent", "actions", "said"),
    [
        ("zeta", [0, 3], "3 (type int64)"),
        ("zeta", [0, -1], "-1 (type int64)"),
        ("zeta", [0.0, 1.5], "0.0 (type float64)"),
        ("box", [[0.0, 0.0], [1.0, 1.1]], "[1.0, 1.1] (type float64)"),
        ("box", [[0.0, 0.0], [0.0, np.nan]], "[0.0, nan] (type float64)"),
        ("multi", [[0, 0], [0, 3]], "[0, 3] (type int64)"),
        ("binary", [[0, 0], [2, 0]], "[2, 0] (type int64)"),
    ],
)
def test_actions_outside_of_their_space(agent, actions, said):
    env = make_team_env(MixedEnv, n_envs=2, seed=0)
    env.reset()
    for _ in range(2):
        env.step(MIXED)
    copy = 0 if "float64" in said and agent == "zeta" else 1
    with pytest.raises(ValueError) as error:
        env.step({**MIXED, agent: np.array(actions)})
    expected = f"The action of {agent!r} in environment copy {copy} at step 3 is {said}, which is not in its action space"
    assert str(error.value).startswith(expected)
    # No copy has been stepped
    assert env.get_attr("t") == [2, 2]


def test_what_rescaling_rounds_is_in_the_space():
    env = make_team_env(PartneredEnv)
    env.reset()
    env.step({"arrow": np.zeros(1, int), "ball": np.full((1, 1), np.nextafter(np.float32(1), np.float32(2)))})


class NoWay(MaskedEnv):
    """
    A ``MaskedEnv`` whose mask of ``agent_1`` allows no action after a given step.

    :param at: The step, 0 for the reset
    :param strict: Whether it raises where an agent does what its mask forbids
    """

    def __init__(self, at, strict=False):
        super().__init__(n_agents=3, limit=5)
        self.at, self.strict = at, strict

    def step(self, actions):
        return super().step(actions) if self.strict else ToyEnv.step(self, actions)

    def infos(self):
        infos = super().infos()
        if self.t == self.at:
            infos["agent_1"] = {"action_mask": np.zeros(3, bool)}
        return infos


@pytest.mark.parametrize(("at", "place"), [(0, "at reset"), (2, "at step 2")])
def test_a_mask_that_allows_nothing(at, place):
    env = make_team_env(partial(NoWay, at), n_envs=2)
    with pytest.raises(ValueError, match=f"The action mask of 'agent_1' in environment copy 0 {place} allows no action"):
        env.reset()
        for _ in range(3):
            env.step({agent: np.argmax(env.action_masks().get(agent, np.ones((2, 3))), axis=1) for agent in ACTIONS})


def test_a_mask_that_allows_nothing_explains_the_error_of_the_environment():
    env = make_team_env(partial(NoWay, 0, strict=True))
    env.reset()
    with pytest.raises(ValueError, match="agent_1 did 0 at step 0") as caught:
        env.step({agent: np.zeros(1, int) for agent in ACTIONS})
    says = "The action mask of 'agent_1' in environment copy 0 at reset allows no action"
    assert any(note.startswith(says) for note in caught.value.__notes__)


def test_a_mask_of_the_wrong_size():
    class Short(MaskedEnv):
        def infos(self):
            return {agent: {"action_mask": np.ones(2, bool)} for agent in self.agents}

    message = "mask of 'agent_0' in environment copy 0 at reset must have 3 entries, one for each action, got 2"
    with pytest.raises(ValueError, match=message):
        make_team_env(Short).reset()


class Wordy(ToyEnv):
    """A ``ToyEnv`` with a Text observation space."""

    def observation_space(self, agent):
        return spaces.Text(5)


def test_observations_of_a_kind_that_no_model_takes():
    with pytest.raises(ValueError, match=r"The observation space of 'agent_0' is Text.*; allowed are Discrete, MultiDiscrete"):
        make_team_env(Wordy)


def test_copies_that_differ():
    sizes = iter([2, 3])
    with pytest.raises(ValueError, match=r"same possible_agents, but those of environment copy 1 are .*agent_2"):
        make_team_env(lambda: ToyEnv(next(sizes)), n_envs=2)
    one = ToyEnv()
    with pytest.raises(ValueError, match="one and the same environment: return a new one at each call"):
        make_team_env(lambda: one, n_envs=2)


# Visibility given by the user


def looks_left(env):
    """Return a visibility with which each agent sees those before it in the list, from the second step on."""
    agents = env.possible_agents
    return {agent: np.array([env.t > 1 and j < i for j in range(len(agents)) if j != i]) for i, agent in enumerate(agents)}


@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
def test_the_user_says_who_is_visible(vec_env):
    env = make_team_env(partial(ToyEnv, n_agents=3, limit=2), n_envs=2, vec_env=vec_env, visibility=looks_left)
    env.reset()
    assert not env.step(ACTIONS)[3][1]["visible"].any()
    # The last step of an episode is included
    _, _, dones, infos = env.step(ACTIONS)
    assert dones.all()
    assert infos[1]["visible"].tolist() == [[False, False], [True, False], [True, True]]
    env.close()


def test_who_has_left_is_not_visible_whatever_the_user_says():
    env = make_team_env(PartneredEnv, visibility=lambda env: {agent: np.ones(3) for agent in env.possible_agents})
    env.reset()
    actions: dict[str, Any] = {"arrow": np.zeros(1, int), "ball": np.zeros((1, 1), np.float32)}
    visible = [env.step(actions)[3][0]["visible"].tolist() for _ in range(4)]
    assert visible[2] == [[True] * 3, [True] * 3] and visible[3] == [[False, True, True], [False] * 3]


def test_what_the_user_says_is_looked_at_too():
    env = make_team_env(ToyEnv, visibility=lambda env: {"agent_1": np.ones(2)})
    env.reset()
    with pytest.raises(ValueError, match=r"visibility\(\) has 2 flags for 'agent_1' in environment copy 0 at step 1"):
        env.step({agent: np.zeros(1, int) for agent in env.possible_agents})


@pytest.mark.parametrize("env", [MixedEnv, "traffic-junction-easy"])
def test_an_environment_that_says_it_itself_is_not_overruled(env):
    with pytest.raises(ValueError, match=r"says by its own visibility\(\) who can observe whom"):
        make_team_env(env, visibility=looks_left)
