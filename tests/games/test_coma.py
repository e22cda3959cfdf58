"""COMA in games whose best play is known: whom to thank, and agreeing on one of two."""

import pytest
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_belief import make_team_env
from sb3_belief.references.coma import COMA
from sb3_belief.references.joint_vec_env import JointVecEnv
from sb3_belief.zoo.config import load_config
from tests.games.seeds import SEEDS


@pytest.mark.slow
@pytest.mark.parametrize(("game", "least"), [("cues", 4.8), ("coordination", 0.95)])
@pytest.mark.parametrize("seed", SEEDS)
def test_learns(game, least, seed):
    config = load_config("coma", game)
    env = JointVecEnv(make_team_env(game, n_envs=config.n_envs, seed=seed))
    model = COMA(config.policy, env, seed=seed, **config.algo_kwargs).learn(config.n_timesteps)
    returned, _ = evaluate_policy(model, env, 200, deterministic=False)
    assert isinstance(returned, float) and returned >= least
