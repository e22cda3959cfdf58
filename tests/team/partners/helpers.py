"""Partners and teams that the tests of partners share."""

from typing import Any

import numpy as np

from sb3_belief.team import PartnerPool, PartnersVecEnv
from tests.team.fixed_partners.helpers import one, toy, zero
from tests.team.helpers import PPO_KWARGS, Team, make_team_env

BELIEF: dict[str, Any] = {
    **PPO_KWARGS,
    "history_length": 16,
    "policy_kwargs": {"net_arch": [8], "embedding_dim": 8, "latent_dim": 4},
}
ZERO_ONE: dict[str, Any] = {"zero": zero, "one": one}


def noisy(obs):
    """Do a random action of three, as a partner."""
    return np.random.randint(3)


def partnered(partners, n_agents=2, n_envs=2, seed=0, **kwargs: Any) -> PartnersVecEnv:
    """Return a vectorised ``ToyEnv`` with partners."""
    return PartnersVecEnv(make_team_env(toy(n_agents), n_envs=n_envs, seed=seed), partners, **kwargs)


def pool_of(n_members=2, **kwargs: Any) -> PartnerPool:
    """Return a pool of partners that do the action which is their name, modulo 3."""
    return PartnerPool({str(k): (lambda obs, k=k: k % 3) for k in range(n_members)}, **kwargs)


def saved_team(path, algo, policy="MlpPolicy", seed=0, n_agents=2, **kwargs):
    """Save a team of an algorithm that has learned a little."""
    env = make_team_env(toy(n_agents), n_envs=1)
    Team(algo, policy, env, seed=seed, **{**PPO_KWARGS, **kwargs}).learn(16).save(path)
    return str(path)


def partner_did(infos) -> list[int]:
    """Return which action of three the first partner has done in each copy."""
    return [int(info["scripted_actions"][:3].argmax()) for info in infos]


def play(env, n_steps, begin=False):
    """Return for each step the partner's actions and ``info["partner"]`` of all copies; the learners do action 1."""
    if begin:
        env.reset()
    actions = {agent: np.ones(env.num_envs, int) for agent in env.possible_agents}
    steps = []
    for _ in range(n_steps):
        infos = env.step(actions)[3]
        steps.append((partner_did(infos), [info.get("partner") for info in infos]))
    return steps
