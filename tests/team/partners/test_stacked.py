"""The members of a pool that act as one pass act as each does alone."""

from typing import Any

import numpy as np
import pytest
import torch as th
from sb3_contrib import MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, DQN, PPO

from sb3_belief import BeliefPPO
from sb3_belief.team import PartnerPool, PartnersVecEnv
from tests.team.fixed_partners.helpers import toy, zero
from tests.team.helpers import PPO_KWARGS, Team, make_team_env
from tests.team.partners.helpers import BELIEF, saved_team
from tests.team.toy_envs import MaskedEnv, ToyEnv

IPPO = {**BELIEF, "belief": "none"}


def seat_of(members, make_env: Any = ToyEnv, n_envs=6, **kwargs: Any) -> Any:
    """Return where the members of a pool act for ``agent_1``, at the beginning of an episode."""
    env: Any = PartnersVecEnv(make_team_env(make_env, n_envs=n_envs, seed=4), {"agent_1": PartnerPool(members)}, **kwargs)
    env.reset()
    return env._seats[0][0]


def sharpened(path):
    """Make a saved team's agents act more differently from each other, at other observations and from other teams."""
    team = Team.load(path)
    for model in team.agents.values():
        with th.no_grad():
            for weight in model.policy.action_net.parameters():
                weight.mul_(300)
    team.save(path)
    return path


@pytest.mark.parametrize(
    "algo, make_env, kwargs",
    [
        (PPO, ToyEnv, {}),
        (PPO, ToyEnv, {"normalize": True}),
        (A2C, ToyEnv, {}),
        (BeliefPPO, ToyEnv, IPPO),
        (MaskablePPO, MaskedEnv, {}),
    ],
)
def test_each_copy_gets_the_actions_of_its_member(tmp_path, algo, make_env, kwargs):
    policy = "BeliefPolicy" if algo is BeliefPPO else "MlpPolicy"
    kwargs = {**PPO_KWARGS, **kwargs} if algo is not A2C else kwargs
    paths = {}
    for seed in range(3):
        team = Team(algo, policy, make_team_env(make_env), seed=seed, **kwargs).learn(16)
        team.save(tmp_path / f"{seed}.zip")
        paths[str(seed)] = sharpened(str(tmp_path / f"{seed}.zip"))
    seat = seat_of(paths, make_env, deterministic=True)
    assert seat._stacked is not None
    present = np.array([0, 1, 2, 2, 1, 0])
    obs = np.random.default_rng(0).normal(size=(6, *seat.obs.shape[1:])).astype(np.float32)
    seat.observe(obs, np.zeros(6, bool))
    masks = None if make_env is not MaskedEnv else np.array([[True, False, True], [False, True, True]] * 3)
    actions = seat.act(present, masks)
    for i, k in enumerate(present):
        own_masks = None if masks is None else masks[i : i + 1]
        alone, _ = seat._members[k].own_predictor.predict(obs[i : i + 1], deterministic=True, masks=own_masks)
        assert actions[i] == alone[0]
    # The members differ, so that another's actions would not do
    assert any(actions.tolist() != seat.act((present + shift) % 3, masks).tolist() for shift in (1, 2))


def test_samples_have_the_probabilities_of_the_member(tmp_path):
    paths = {str(seed): sharpened(saved_team(tmp_path / f"{seed}.zip", PPO, seed=seed)) for seed in range(2)}
    seat = seat_of(paths, n_envs=2)
    present = np.array([1, 0])
    samples = np.array([seat.act(present, None) for _ in range(2000)])
    for copy, k in enumerate(present):
        policy: Any = seat._members[k].own_predictor.model.policy
        with th.no_grad():
            expected = policy.get_distribution(policy.obs_to_tensor(seat.obs[copy])[0]).distribution.probs[0]
        counted = np.bincount(samples[:, copy], minlength=3) / len(samples)
        # Four standard errors
        assert np.all(np.abs(counted - expected.numpy()) < 4 * np.sqrt(0.25 / len(samples)))


def test_what_differs_in_kind_acts_by_itself(tmp_path):
    ppo = saved_team(tmp_path / "ppo.zip", PPO)
    wide = saved_team(tmp_path / "wide.zip", PPO, policy_kwargs={"net_arch": [16]})
    recurrent = saved_team(tmp_path / "recurrent.zip", RecurrentPPO, "MlpLstmPolicy", policy_kwargs={"lstm_hidden_size": 4})
    belief = saved_team(tmp_path / "belief.zip", BeliefPPO, "BeliefPolicy", **BELIEF)
    env = make_team_env(toy(2))
    Team(DQN, "MlpPolicy", env, seed=0).save(tmp_path / "dqn.zip")
    live = Team(PPO, "MlpPolicy", env, seed=0).agents["agent_1"]
    for other in (zero, wide, recurrent, belief, str(tmp_path / "dqn.zip"), live):
        assert seat_of({"a": ppo, "b": other})._stacked is None
    assert seat_of({"a": belief, "b": belief})._stacked is None
    assert seat_of({"a": ppo})._stacked is None
    assert seat_of({"a": ppo, "b": ppo})._stacked is not None
