"""RODE where two roles can be told apart by what actions do, and have to be swapped at half-time."""

import pytest
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_belief import make_team_env
from sb3_belief.references.joint_vec_env import JointVecEnv
from sb3_belief.references.rode import RODE
from sb3_belief.zoo.config import load_config
from tests.games.seeds import SEEDS


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_finds_the_roles_and_plays_them(seed):
    config = load_config("rode", "levers")
    env = JointVecEnv(make_team_env("levers", n_envs=config.n_envs, seed=seed))
    model = RODE(config.policy, env, seed=seed, **config.algo_kwargs)
    model.learn(config.n_timesteps)
    assert model.policy.role_actions.tolist() == [[True] * 3 + [False] * 3, [False] * 3 + [True] * 3]
    returned, _ = evaluate_policy(model, env, 8)
    assert isinstance(returned, float) and returned >= 9.5
