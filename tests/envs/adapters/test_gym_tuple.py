"""Gymnasium environments with Tuple spaces as PettingZoo ones: what is passed on, what is refused, and how episodes end."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from pettingzoo.test import parallel_api_test

from sb3_belief import make_team_env
from sb3_belief.envs.adapters.gym_tuple import GymTupleEnv
from tests.envs.adapters.tuple_helpers import check_advantages, train_save_load_evaluate

BOX = spaces.Box(-np.inf, np.inf, (2,), np.float32)


class Toy(gym.Env):
    """
    Environment of two agents that observe, as plain lists, the number of steps so far and a random number of the episode.

    :param ends_at: Steps at which the episodes terminate, used in turn
    :param reward: What ``step`` returns as reward
    :param actions: Action spaces of the two agents. None for Discrete ones
    :param render_mode: Gymnasium's argument
    """

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(self, ends_at=(5,), reward: Any = (1, 2), actions=None, render_mode=None):
        self.observation_space = spaces.Tuple([BOX, BOX])
        self.action_space = spaces.Tuple(actions or [spaces.Discrete(3), spaces.Discrete(2)])
        self.ends_at, self.reward, self.render_mode = ends_at, reward, render_mode
        self.episode, self.truncated = -1, False
        self.got: list[Any] = []

    def _obs(self):
        return [[self.t, self.number], [self.t, -self.number]]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t, self.number, self.options = 0, int(self.np_random.integers(100)), options
        self.episode += 1
        return self._obs(), {}

    def step(self, action):
        self.t += 1
        self.got.append(action)
        return (
            self._obs(),
            self.reward,
            self.t == self.ends_at[self.episode % len(self.ends_at)],
            self.truncated,
            {"t": self.t},
        )

    def render(self):
        return np.full((4, 4, 3), self.t, np.uint8)


class Full(GymTupleEnv):
    """Adapter that overrides every hook: the second agent is active at even times only, and an end at step 3 is a limit."""

    def _visible(self, observations):
        return np.array([[observations[0][0] == 2], [False]])

    def _masks(self):
        return [np.array([True, self.game.t > 0, True]), np.array([True, True])]

    def _active(self):
        return np.array([True, self.game.t % 2 == 0])

    def _is_success(self):
        return self.info["t"] == 4

    def _is_time_limit(self):
        return self.game.t == 3


def play(env, n_steps=100, seed=0, actions=(0, 0)):
    """Play at most ``n_steps`` steps of one episode, and return what ``step`` returned at each of them."""
    env.reset(seed=seed)
    steps: list[Any] = []
    while env.agents and len(steps) < n_steps:
        steps.append(env.step(dict(zip(env.possible_agents, actions, strict=True))))
    return steps


def test_pettingzoo_s_own_test():
    parallel_api_test(GymTupleEnv(Toy()), num_cycles=50)


def test_spaces_and_observations():
    env = GymTupleEnv(Toy(), name="toy")
    assert env.possible_agents == ["agent_0", "agent_1"] and env.metadata["name"] == "toy"
    assert [env.action_space(agent) for agent in env.possible_agents] == [spaces.Discrete(3), spaces.Discrete(2)]
    assert env.observation_space("agent_0") == BOX
    # The package has one space object for both agents. The adapter copies it, so that seeding one does not seed the other
    assert env.observation_space("agent_0") is not env.observation_space("agent_1")
    first, infos = env.reset(seed=3, options={"level": 1})
    assert infos == {"agent_0": {}, "agent_1": {}} and env.game.options == {"level": 1}
    obs, rewards, _, _, infos = env.step({"agent_0": 1, "agent_1": np.int64(1)})
    assert all(part.dtype == np.float32 and part.shape == (2,) for part in (*first.values(), *obs.values()))
    assert obs["agent_1"].tolist() == [1, -env.game.number] and rewards == {"agent_0": 1.0, "agent_1": 2.0}
    assert all(type(action) is int for action in env.game.got[0]) and infos == {"agent_0": {}, "agent_1": {}}
    again, _ = env.reset(seed=3)
    assert all(np.array_equal(first[agent], again[agent]) for agent in first)
    unseeded, _ = env.reset()
    assert not np.array_equal(unseeded["agent_0"], first["agent_0"])


@pytest.mark.parametrize(
    ("reward", "own"), [(3, [3.0, 3.0]), (np.float32(3), [3.0, 3.0]), (np.array([1, 2]), [1.0, 2.0]), ([-1.5, 0], [-1.5, 0.0])]
)
def test_rewards(reward, own):
    (step,) = play(GymTupleEnv(Toy(reward=reward)), 1)
    assert list(step[1].values()) == own and all(type(value) is float for value in step[1].values())


@pytest.mark.parametrize(
    ("env", "length", "terminated"),
    [
        (GymTupleEnv(Toy()), 5, True),
        (GymTupleEnv(Toy(), max_episode_steps=4), 4, False),
        # The last step terminates too, so there is nothing to bootstrap
        (GymTupleEnv(Toy(), max_episode_steps=5), 5, True),
        (GymTupleEnv(TimeLimit(Toy(), 2)), 2, False),
        (GymTupleEnv(TimeLimit(Toy(), 5)), 5, True),
        (Full(Toy((3,))), 3, False),  # The environment itself reports a termination
        (Full(Toy((4,))), 4, True),
    ],
)
def test_termination_and_truncation_are_told_apart(env, length, terminated):
    for _ in range(2):
        steps = play(env)
        assert len(steps) == length and not env.agents
        for t, (_, _, terminations, truncations, _) in enumerate(steps, 1):
            assert set(terminations.values()) == {t == length and terminated}
            assert set(truncations.values()) == {t == length and not terminated}


def test_what_a_subclass_says():
    env = Full(Toy((4,)))
    _, infos = env.reset()
    assert infos["agent_0"]["action_mask"].tolist() == [True, False, True] and "active" not in infos["agent_1"]
    assert env.visibility()["agent_0"].tolist() == [False]
    steps, seen = [], []
    for _ in range(4):
        steps.append(env.step({"agent_0": 0, "agent_1": 0}))
        seen.append([row.tolist() for row in env.visibility().values()])
    assert seen == [[[False], [False]], [[True], [False]], [[False], [False]], [[False], [False]]]
    first, second = ([step[4][agent] for step in steps] for agent in env.possible_agents)
    # "active" says whether the agent was in play when it acted, not whether it is now
    assert [info.get("active", True) for info in second] == [True, False, True, False]
    assert all(info.get("active", True) for info in first)
    assert [info.get("is_success") for info in second] == [None, None, None, True]
    assert all(info["action_mask"].all() for info in first)


def test_other_action_spaces():
    box = spaces.Box(-1, 1, (2,), np.float32)
    env = GymTupleEnv(Toy(actions=[box, spaces.MultiDiscrete([2, 3])]))
    play(env, 1, actions=(np.array([0.5, 7.0]), [1, 2]))
    sent, several = env.game.got[0]
    assert sent.dtype == np.float32 and sent.tolist() == [0.5, 7.0] and several.tolist() == [1, 2]
    with pytest.raises(ValueError, match=r"'agent_1' is \[1, 3\], which is not in its space MultiDiscrete"):
        env.step({"agent_0": np.zeros(2), "agent_1": [1, 3]})


@pytest.mark.parametrize("action", [3, -1, 0.5, None, "up", np.array([0, 1])])
def test_actions_that_are_refused(action):
    env = GymTupleEnv(Toy())
    env.reset()
    with pytest.raises(ValueError, match=r"The action of 'agent_0' is .*, which is not in its space Discrete\(3\)"):
        env.step({"agent_0": action, "agent_1": 0})
    assert not env.game.got


def test_wrong_use():
    env = GymTupleEnv(Toy((1,)))
    with pytest.raises(ValueError, match=r"call reset\(\)"):
        env.step({"agent_0": 0, "agent_1": 0})
    env.reset()
    with pytest.raises(ValueError, match=r"No action for \['agent_1'\]; got actions for \['agent_0'\]"):
        env.step({"agent_0": 0})
    env.step({"agent_0": 0, "agent_1": 0})
    with pytest.raises(ValueError, match=r"call reset\(\)"):
        env.step({"agent_0": 0, "agent_1": 0})
    single: Any = gym.make("CartPole-v1")
    with pytest.raises(TypeError, match="two Tuple spaces with one entry for each agent"):
        GymTupleEnv(single)
    lopsided = Toy()
    lopsided.observation_space = spaces.Tuple([BOX])
    with pytest.raises(TypeError, match="two Tuple spaces"):
        GymTupleEnv(lopsided)
    with pytest.raises(ValueError, match="max_episode_steps=0 must be at least 1"):
        GymTupleEnv(Toy(), max_episode_steps=0)


def test_environments_that_return_something_else():
    with pytest.raises(ValueError, match="Toy returned 3 rewards for 2 agents"):
        play(GymTupleEnv(Toy(reward=[1, 2, 3])))
    toy = Toy()
    toy.truncated = [False, True]  # type: ignore[assignment]
    with pytest.raises(ValueError, match=r"truncated=\[False, True\]: they must be single values"):
        play(GymTupleEnv(toy))
    toy = Toy()
    toy._obs = lambda: [[0, 0]]  # type: ignore[method-assign]
    with pytest.raises(ValueError, match="Toy returned 1 observations for 2 agents"):
        GymTupleEnv(toy).reset()


def test_a_team_of_them():
    env: Any = make_team_env(lambda: Full(Toy((3, 4), render_mode="rgb_array")), n_envs=2)
    env.reset()
    zeros = {agent: np.zeros(2, int) for agent in env.possible_agents}
    dones, infos = [], []
    for _ in range(7):
        _, rewards, done, info = env.step(zeros)
        assert rewards.tolist() == [1.5, 1.5]
        dones.append(done[0])
        infos.append(info[0])
    assert dones == [False, False, True, False, False, False, True]
    assert infos[2]["truncated"].tolist() == [True, True] and infos[2]["TimeLimit.truncated"] is True
    assert infos[6]["life_end"].tolist() == [True, True] and infos[6]["TimeLimit.truncated"] is False
    assert (infos[2]["is_success"], infos[6]["is_success"]) == (False, True)
    assert [info["visible"].tolist() for info in infos[:3]] == [[[False], [False]], [[False], [False]], [[False], [False]]]
    assert [info["active"].tolist() for info in infos[:3]] == [[True, True], [True, False], [True, True]]
    assert infos[2]["terminal_observation"]["agent_0"][0] == 3
    assert env.action_masks()["agent_0"].tolist() == [[True, False, True]] * 2
    assert env.get_images()[0].shape == (4, 4, 3)
    env.close()


def test_advantages_over_terminations_and_limits():
    # Episodes of 3 steps terminate, those of 5 are truncated at step 4
    ends = check_advantages(lambda: GymTupleEnv(Toy((3, 5)), max_episode_steps=4), lambda obs: bool(obs[0] == 3), n_steps=16)
    assert set(ends) == {True, False}


def test_training(tmp_path):
    returns = train_save_load_evaluate(lambda: GymTupleEnv(Toy((4,))), tmp_path)
    assert returns == [6.0, 6.0]
