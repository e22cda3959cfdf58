"""SB3's wrappers around a team whose agents leave, die and see pictures."""

from functools import partial
from typing import Any

import numpy as np
import pytest
import supersuit
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import (
    VecCheckNan,
    VecExtractDictObs,
    VecFrameStack,
    VecMonitor,
    VecTransposeImage,
)

from tests.team.helpers import Team, make_team_env
from tests.team.toy_envs import ToyEnv

KWARGS: dict[str, Any] = {"n_steps": 8, "batch_size": 8, "n_epochs": 1, "device": "cpu"}


class Lives(ToyEnv):
    """
    A ``ToyEnv`` in which ``agent_0`` begins a new life after step 3, and ``agent_1`` leaves at step 4.

    :param pictures: Whether the agents see the time as a picture, its channels last, instead of their places
    """

    def __init__(self, pictures=False, render_mode=None):
        super().__init__(n_agents=3, limit=6, render_mode=render_mode)
        self.pictures = pictures

    def observation_space(self, agent):
        return spaces.Box(0, 255, (36, 40, 3), np.uint8) if self.pictures else super().observation_space(agent)

    def observations(self):
        seen = super().observations()
        return {agent: np.full((36, 40, 3), 10 * self.t, np.uint8) for agent in seen} if self.pictures else seen

    def step(self, actions):
        obs, rewards, terminations, truncations, infos = super().step(actions)
        if self.t == 3:
            infos["agent_0"] = {"life_end": True}
        if self.t == 4:
            terminations["agent_1"], self.agents = True, [agent for agent in self.agents if agent != "agent_1"]
        return obs, rewards, terminations, truncations, infos


@pytest.mark.parametrize(
    ("wrapper", "says"),
    [
        (partial(VecFrameStack, n_stack=2), r"wrapped in VecFrameStack, .*for each agent: .*supersuit.frame_stack_v2"),
        (VecTransposeImage, "wrapped in VecTransposeImage, which is not needed"),
        (partial(VecExtractDictObs, key="agent_0"), "wrapped in VecExtractDictObs, .*AgentEnv"),
    ],
)
def test_wrappers_that_take_the_team_for_one_agent_are_refused(wrapper, says):
    env = make_team_env(partial(Lives, pictures=True), n_envs=2)
    for wrapped in (wrapper(env), VecMonitor(wrapper(env))):
        with pytest.raises(ValueError, match=says):
            Team(PPO, "MlpPolicy", wrapped)
    team = Team(PPO, "MlpPolicy", env)
    with pytest.raises(ValueError, match=says):
        team.set_env(wrapper(env))


def test_what_check_nan_does_a_team_does_itself():
    with pytest.raises(NotImplementedError, match="dict action spaces"):
        VecCheckNan(make_team_env(Lives))


def test_frames_are_stacked_for_each_agent():
    env = make_team_env(Lives, n_envs=2, seed=0, wrapper=partial(supersuit.frame_stack_v2, stack_size=3))
    plain: Any = make_team_env(Lives, n_envs=2, seed=0)
    obs, seen = env.reset(), plain.reset()
    frames: dict[str, list[np.ndarray]] = {agent: [seen[agent]] * 3 for agent in seen}
    for t in range(1, 9):
        obs, _, _, infos = env.step(dict.fromkeys(obs, np.ones(2, int)))
        seen, _, _, plain_infos = plain.step(dict.fromkeys(obs, np.ones(2, int)))
        for agent, own in frames.items():
            if t == 6:
                own[:] = [seen[agent]] * 2
            own.append(seen[agent])
            gone = agent == "agent_1" and t in (4, 5)
            expected = np.zeros((2, 6)) if gone else np.concatenate(own[-3:], axis=1)
            np.testing.assert_array_equal(obs[agent], expected)
        if t == 4:
            # The last observation of who left is stacked, too
            last = infos[0]["terminal_observation"]["agent_1"]
            np.testing.assert_array_equal(last[-2:], plain_infos[0]["terminal_observation"]["agent_1"])
            assert last[:-2].any()
    Team(PPO, "MlpPolicy", env, seed=0, **KWARGS).learn(32)


@pytest.mark.parametrize("stacked", [False, True])
def test_each_model_puts_the_channels_of_its_images_first(stacked, tmp_path):
    wrapper = partial(supersuit.frame_stack_v2, stack_size=2) if stacked else None
    env = make_team_env(partial(Lives, pictures=True), n_envs=2, wrapper=wrapper)
    team = Team(PPO, "CnnPolicy", env, seed=0, **KWARGS).learn(32)
    channels = 6 if stacked else 3
    assert team.agents["agent_0"].observation_space.shape == (channels, 36, 40)
    # Flattened by now, one row for each step and copy
    assert team.agents["agent_0"].rollout_buffer.observations.shape == (16, channels, 36, 40)
    team.save(tmp_path / "team.zip")
    obs = env.reset()
    loaded = Team.load(tmp_path / "team.zip", env=env)
    for agent, actions in team.predict(obs, deterministic=True)[0].items():
        np.testing.assert_array_equal(actions, loaded.predict(obs, deterministic=True)[0][agent])
