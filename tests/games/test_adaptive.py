"""Does an adaptive belief follow within a rollout? Where a convention lasts for one rollout, or for one episode of a copy."""

from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_belief.envs.switching_convention.policies import ideal_convention_return
from sb3_belief.team import observing
from sb3_belief.zoo.config import load_config
from sb3_belief.zoo.train import TrainOptions, make_env, make_team
from studies.games import play

PARAMS = ["belief:adaptive", "action_loss:cross_entropy"]


@pytest.mark.slow
def test_a_convention_of_one_rollout_is_followed_within_it():
    curve = play("redraw-each", "adaptive", 0, rollouts=150).curve
    # By chance it is 1/4, and at best 1 but for the first steps. The paper's belief stays at chance (test_games)
    assert curve[-40:].mean() >= 0.8


@pytest.mark.slow
def test_a_convention_of_one_episode_is_followed_in_each_copy_with_frozen_weights():
    config = load_config("belief_ppo", "convention-episode", params=PARAMS, env_kwargs=["partner_seed:0"])
    env = make_env(config, config.n_envs, 0)
    # Typed as Any, since SB3 takes a team for a model
    team: Any = make_team(config, TrainOptions(verbose=0), env, 0)
    team.learn(50_000)
    blind = np.mean(evaluate_policy(team, env, n_eval_episodes=64, return_episode_rewards=True)[0])
    with observing(team, env) as watched:
        adapted = np.mean(evaluate_policy(team, watched, n_eval_episodes=64, return_episode_rewards=True)[0])
    # Without what happens in these episodes every convention is as likely
    assert blind == pytest.approx(64 / 4, abs=2.5)
    assert adapted >= 0.6 * ideal_convention_return()
