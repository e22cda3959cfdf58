"""A team as one environment."""
# mypy: disable-error-code="assignment, call-overload, union-attr, attr-defined"

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import A2C
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_belief.references.joint_learner import check_joint_env
from sb3_belief.references.joint_vec_env import JointVecEnv
from sb3_belief.team import make_team_env
from tests.references.counting_team import CountingTeam, joint_env


def test_spaces():
    env = joint_env()
    assert isinstance(env.observation_space, spaces.Dict)
    assert {key: space.shape for key, space in env.observation_space.spaces.items()} == {
        "obs": (2, 3),
        "state": (2,),
        "active": (2,),
        "mask": (2, 3),
    }
    assert env.action_space == spaces.MultiDiscrete([2, 3])


def test_observations():
    env = joint_env(n_envs=2)
    obs = env.reset()
    assert obs["obs"].dtype == np.float32 and env.observation_space.contains({key: part[0] for key, part in obs.items()})
    # "a" is filled up with a zero, "b" is one-hot
    assert obs["obs"][1].tolist() == [[0, 3, 0], [1, 0, 0]]
    assert obs["state"][1].tolist() == [0, 0] and obs["active"].all()
    assert obs["mask"][1].tolist() == [[1, 1, 0], [1, 1, 0]], "what 'a' does not have is not legal"
    obs, rewards, dones, infos = env.step(np.array([[1, 1], [0, 0]]))
    assert obs["obs"][0].tolist() == [[1, 3, 0], [0, 1, 0]] and obs["state"][0].tolist() == [1, 10]
    assert obs["mask"][0].tolist() == [[1, 0, 0], [1, 1, 0]]
    assert rewards.tolist() == [1.5, 1.0] and not dones.any()
    assert infos[0]["agent_rewards"].tolist() == [1, 2] and infos[0]["in_play"].tolist() == [True, True]


@pytest.mark.parametrize("truncates", [False, True])
def test_the_last_observation_is_that_of_the_episode_that_ended(truncates):
    env = joint_env(truncates=truncates)
    env.reset()
    for _ in range(3):
        obs, _, dones, infos = env.step(np.array([[0, 0]]))
    last = infos[0]["terminal_observation"]
    assert dones.all() and infos[0]["TimeLimit.truncated"] is truncates
    assert last["obs"].tolist() == [[3, 3, 0], [1, 0, 0]] and last["state"].tolist() == [3, 30]
    assert last["mask"].tolist() == [[1, 0, 0], [1, 1, 1]], "legal at the end, not at the beginning of the next episode"
    assert env.observation_space.contains(last) and obs["state"].tolist() == [[0, 0]]
    assert infos[0]["episode"]["r"] == 3 and infos[0]["episode"]["l"] == 3


def test_who_is_out_of_play():
    env = joint_env(dies=1, truncates=True)
    env.reset()
    first, _, _, infos = env.step(np.array([[0, 0]]))
    assert first["active"].tolist() == [[1, 0]] and infos[0]["in_play"].tolist() == [True, True]
    _, _, _, infos = env.step(np.array([[0, 0]]))
    assert infos[0]["in_play"].tolist() == [True, False]
    again, _, dones, infos = env.step(np.array([[0, 0]]))
    assert dones.all() and infos[0]["terminal_observation"]["active"].tolist() == [1, 0] and again["active"].all()


def test_without_masks_everything_is_legal():
    env = joint_env(masks=False)
    assert env.reset()["mask"].tolist() == [[[1, 1, 0], [1, 1, 1]]]
    assert env.action_masks() is None
    for _ in range(3):
        _, _, _, infos = env.step(np.array([[0, 0]]))
    assert infos[0]["terminal_observation"]["mask"].tolist() == [[1, 1, 0], [1, 1, 1]]


def test_masks_side_by_side():
    env = joint_env(n_envs=2)
    env.reset()
    assert env.action_masks().tolist() == [[1, 1, 1, 1, 0]] * 2
    assert [row.tolist() for row in env.env_method("action_masks")] == [[1, 1, 1, 1, 0]] * 2


class BoxTeam(CountingTeam):
    """The same with actions that are numbers, of different shapes."""

    def __init__(self):
        super().__init__(masks=False)
        self._action_spaces = {"a": spaces.Box(-1, 2, (2, 1)), "b": spaces.Box(0, 5, (1,))}
        self.seen = {}

    def step(self, actions):
        self.seen = {agent: np.array(action) for agent, action in actions.items()}
        return super().step({"a": 0})


def test_box_actions_are_rows():
    env = JointVecEnv(make_team_env(BoxTeam, n_envs=1))
    assert env.action_space.low.tolist() == [[-1, -1], [0, -1]] and env.action_space.high.tolist() == [[2, 2], [5, 1]]
    assert "mask" not in env.reset()
    env.step(np.array([[[0.5, 1.5], [4.5, 0.0]]], dtype=np.float32))
    seen = env.get_attr("seen")[0]
    assert seen["a"].tolist() == [[0.5], [1.5]] and seen["b"].tolist() == [4.5]


class MixedTeam(BoxTeam):
    """One agent chooses, the other gives numbers."""

    def __init__(self):
        super().__init__()
        self._action_spaces["a"] = spaces.Discrete(2)


class SeeingTeam(CountingTeam):
    """One agent observes an image."""

    def __init__(self):
        super().__init__()
        self._observation_spaces["b"] = spaces.Box(0, 255, (36, 36, 3), np.uint8)


@pytest.mark.parametrize(("team", "message"), [(MixedTeam, "all Discrete, or all Box"), (SeeingTeam, "'b' observes images")])
def test_what_cannot_be_shown_as_one(team, message):
    with pytest.raises(ValueError, match=message):
        JointVecEnv(make_team_env(team, n_envs=1))


def test_only_of_a_team():
    with pytest.raises(TypeError, match=r"such as make_team_env\(\) makes, not DummyVecEnv"):
        JointVecEnv(DummyVecEnv([lambda: gym.make("CartPole-v1")]))


def test_who_can_learn_in_it():
    check_joint_env(joint_env(), "qmix")
    check_joint_env(JointVecEnv(make_team_env(BoxTeam, n_envs=1)), "maddpg", (spaces.MultiDiscrete, spaces.Box))
    with pytest.raises(ValueError, match="qmix needs agents with Discrete actions, and those of this environment are Box"):
        check_joint_env(JointVecEnv(make_team_env(BoxTeam, n_envs=1)), "qmix")
    with pytest.raises(ValueError, match="shown as one"):
        check_joint_env(make_team_env(CountingTeam, n_envs=1), "qmix")


def test_a_model_of_sb3_learns_in_it():
    A2C("MultiInputPolicy", joint_env(n_envs=2, masks=False), n_steps=4, seed=0).learn(32)
