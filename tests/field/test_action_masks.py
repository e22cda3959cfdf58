"""Action masks in every form in which environments give them."""

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from sb3_contrib import MaskablePPO

from sb3_belief.envs import check_team_env
from tests.field.walkers import Walkers
from tests.team.helpers import Team, make_team_env

# Of three and of two values; the second of the first component and the first of the second are possible
ALLOWED = [False, True, False, True, False]


class Chooses(Walkers):
    """Each walker chooses two numbers, of which only one pair is possible at a time; its masks are in the infos."""

    act_space = spaces.MultiDiscrete([3, 2])
    form: Any = staticmethod(list)

    def masks(self):
        return {agent: self.form([np.array(ALLOWED[:3]), np.array(ALLOWED[3:])]) for agent in self.agents}

    def reset(self, seed=None, options=None):
        obs, _ = super().reset(seed, options)
        return obs, {agent: {"action_mask": mask} for agent, mask in self.masks().items()}

    def change(self, obs, rewards, terminations, truncations, infos):
        masks = self.masks()
        return obs, rewards, terminations, truncations, {agent: {"action_mask": masks[agent]} for agent in masks}


class AsTuples(Chooses):
    form = staticmethod(tuple)


class AsRows(Chooses):
    form = staticmethod(np.concatenate)


class AsListsOfNumbers(Chooses):
    @staticmethod
    def form(parts):
        return [int(flag) for part in parts for flag in part]


class OnRequest(Walkers):
    """Has a method ``action_masks()``, as environments for sb3-contrib's algorithms have, and nothing in its infos."""

    act_space = spaces.MultiDiscrete([3, 2])

    def action_masks(self):
        return {agent: (np.array(ALLOWED[:3]), ALLOWED[3:]) for agent in self.agents}


class OnRequestByNumber(OnRequest):
    """Its agents are numbers."""

    def __init__(self):
        super().__init__()
        self.possible_agents = list(range(2))


class OneForAll(OnRequest):
    """Gives one mask instead of one for each agent."""

    def action_masks(self):
        return np.array(ALLOWED)


ALL: list[Any] = [Chooses, AsTuples, AsRows, AsListsOfNumbers, OnRequest, OnRequestByNumber]


@pytest.mark.parametrize("env_class", ALL)
@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
def test_masks_reach_the_models(env_class, vec_env):
    env = make_team_env(env_class, n_envs=2, vec_env=vec_env)
    team = Team(MaskablePPO, "MlpPolicy", env, seed=0, n_steps=8, batch_size=8, device="cpu")
    team.learn(32)
    for model in team.agents.values():
        assert model.rollout_buffer.action_masks.reshape(-1, 5).tolist() == [ALLOWED] * 16
        assert set(map(tuple, model.rollout_buffer.actions.reshape(-1, 2).tolist())) == {(1.0, 0.0)}
    env.close()


@pytest.mark.parametrize("env_class", ALL)
def test_the_checker_knows_them_too(env_class):
    report = check_team_env(env_class, n_steps=20)
    assert not report.failures and "mask" in str(report)


def test_one_mask_for_all_is_refused():
    with pytest.raises(ValueError, match=r"action_masks\(\) returned a ndarray.*\{agent: mask\}"):
        make_team_env(OneForAll).reset()
