"""Action masks that an environment gives and nobody uses: a warning says so, and what to use."""

import warnings
from functools import partial
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from sb3_contrib import MaskablePPO
from sb3_contrib.common.maskable.callbacks import MaskableEvalCallback
from sb3_contrib.common.maskable.evaluation import evaluate_policy as evaluate_masked
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.callbacks import CallbackList, EvalCallback, EveryNTimesteps
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_belief import BeliefPPO, MaskableBeliefPPO
from sb3_belief.baselines import AMFPPO
from sb3_belief.team.masks import _possible
from tests.team.helpers import PPO_KWARGS, Team, make_team_env
from tests.team.toy_envs import MaskedEnv, ToyEnv

KWARGS = {**PPO_KWARGS, "n_steps": 16, "batch_size": 16}


class Lenient(ToyEnv):
    """Only action t mod 3 is possible: it earns 1, others cost 1. Agents ``but`` are given no mask."""

    def __init__(self, but=()):
        super().__init__()
        self.but = but

    def infos(self):
        mask = np.arange(3) == self.t % 3
        return {agent: {} if agent in self.but else {"action_mask": mask} for agent in self.agents}

    def step(self, actions):
        possible = self.t % 3
        obs, _, terminations, truncations, infos = super().step(actions)
        return obs, {agent: 1.0 if a == possible else -1.0 for agent, a in actions.items()}, terminations, truncations, infos


class MultiDiscrete(Lenient):
    def action_space(self, agent):
        return spaces.MultiDiscrete([2, 2])

    def infos(self):
        return {agent: {"action_mask": np.array([1, 0, 1, 1])} for agent in self.agents}

    def step(self, actions):
        return super().step({agent: 0 for agent in actions})


def masked_team(**kwargs):
    return Team(MaskablePPO, "MlpPolicy", make_team_env(Lenient, n_envs=2, seed=0), seed=0, **KWARGS, **kwargs)


@pytest.mark.parametrize(
    "algorithm, policy, kwargs, instead",
    [
        (PPO, "MlpPolicy", KWARGS, "PPO takes none and .* Use MaskablePPO,"),
        (BeliefPPO, "BeliefPolicy", {**KWARGS, "belief": "none"}, "BeliefPPO takes none and .* Use MaskableBeliefPPO,"),
        (AMFPPO, "MlpPolicy", {**KWARGS, "policy_kwargs": {"hidden_dim": 8}}, "AMFPPO takes none and .* Use MaskableAMFPPO,"),
        (A2C, "MlpPolicy", {}, "A2C takes none and .* Use MaskablePPO or MaskableBeliefPPO,"),
    ],
)
@pytest.mark.parametrize("env", [Lenient, MultiDiscrete])
def test_an_algorithm_without_masks(algorithm, policy, kwargs, instead, env):
    team = Team(algorithm, policy, make_team_env(env, n_envs=2), seed=0, **kwargs)
    with pytest.warns(UserWarning, match=rf"action masks of \['agent_.*\] are not heeded: {instead}.*MaskableEvalCallback"):
        team.learn(32)


def test_only_those_who_are_given_masks_are_named():
    classes = {"agent_0": PPO, "agent_1": MaskablePPO}
    team = Team(classes, "MlpPolicy", make_team_env(Lenient), seed=0, **KWARGS)
    with pytest.warns(UserWarning, match=r"action masks of \['agent_0'\] are not heeded"):
        team.learn(16)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Team(classes, "MlpPolicy", make_team_env(partial(Lenient, but=["agent_0"])), seed=0, **KWARGS).learn(16)
        Team(PPO, "MlpPolicy", make_team_env(ToyEnv), seed=0, **KWARGS).learn(16)


def test_masks_of_those_out_of_play_concern_nobody():
    """In Traffic Junction only slots without a car are masked."""
    env = make_team_env("traffic-junction-easy", n_envs=2, env_kwargs={"arrival_rate": 0.3})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Team(PPO, "MlpPolicy", env, seed=0, **KWARGS).learn(64)


def test_an_environment_that_refuses_what_is_impossible():
    team = Team(PPO, "MlpPolicy", make_team_env(MaskedEnv), seed=0, **KWARGS)
    with pytest.raises(ValueError, match=r"agent_0 did \d at step") as caught:
        team.learn(32)
    assert "Use MaskablePPO," in "".join(getattr(caught.value, "__notes__", []))


@pytest.mark.parametrize(
    "space, actions, masks",
    [
        (spaces.Discrete(3), [0, 2], [[1, 0, 0], [1, 1, 0]]),
        (spaces.Discrete(3, start=5), [5, 7], [[1, 0, 0], [1, 1, 0]]),
        (spaces.MultiDiscrete([2, 3]), [[1, 2], [1, 2]], [[0, 1, 0, 0, 1], [1, 0, 1, 1, 1]]),
        (spaces.MultiDiscrete(np.array([[2], [3]])), [[[1], [2]], [[1], [2]]], [[0, 1, 0, 0, 1], [0, 1, 1, 1, 0]]),
        (spaces.MultiBinary(2), [[1, 0], [0, 0]], [[0, 1, 1, 0], [1, 1, 0, 1]]),
    ],
)
def test_what_a_mask_allows(space, actions, masks):
    assert _possible(space, np.array(actions), np.array(masks, dtype=bool)).tolist() == [True, False]


@pytest.mark.parametrize("kind", [MaskablePPO, MaskableBeliefPPO])
def test_evaluation_without_masks_warns_once_and_with_masks_does_not(kind):
    env = partial(make_team_env, Lenient, n_envs=2, seed=1)
    team = Team(kind, "MlpPolicy", env(), seed=0, **KWARGS)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert evaluate_masked(team, env(), n_eval_episodes=4)[0] == 7
        assert team.predict(env().reset(), action_masks=env().action_masks() or {})
    with pytest.warns(UserWarning, match=r"predicts without any.*sb3_contrib.common.maskable") as caught:
        mean: Any = evaluate_policy(team, env(), n_eval_episodes=4)[0]
    assert mean < 7 and len(caught) == 1


def test_callbacks_that_evaluate_without_masks_are_told_before_training():
    def evaluation(kind):
        return kind(make_team_env(Lenient), n_eval_episodes=1, eval_freq=1000, verbose=0)

    team = masked_team()
    for callback in (evaluation(EvalCallback), CallbackList([EveryNTimesteps(8, evaluation(EvalCallback))])):
        with pytest.warns(UserWarning, match=r"EvalCallback evaluates without action masks, and so \['agent_0', 'agent_1'\]"):
            team.learn(32, callback=callback)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        team.learn(32, callback=evaluation(MaskableEvalCallback))
