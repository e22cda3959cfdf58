"""``Team.predict`` in PettingZoo's own loop: observations of those who are still in play, actions for them."""

import numpy as np
import pytest
from sb3_contrib import MaskablePPO, RecurrentPPO
from stable_baselines3 import PPO

from tests.team.helpers import PPO_KWARGS, Team, make_team_env
from tests.team.toy_envs import MaskedEnv, ScriptedEnv, ToyEnv

RECURRENT = {**PPO_KWARGS, "policy_kwargs": {"net_arch": [8], "lstm_hidden_size": 4}}


@pytest.mark.parametrize(
    "algorithm, policy, kwargs", [(PPO, "MlpPolicy", PPO_KWARGS), (RecurrentPPO, "MlpLstmPolicy", RECURRENT)]
)
def test_pettingzoos_loop(algorithm, policy, kwargs):
    team, env = Team(algorithm, policy, make_team_env(ScriptedEnv), seed=0, **kwargs), ScriptedEnv()
    observations, _ = env.reset(seed=0)
    state, in_play = None, []
    while env.agents:
        in_play.append(len(env.agents))
        actions, state = team.predict({agent: observations[agent] for agent in env.agents}, state)
        assert list(actions) == env.agents
        observations, *_ = env.step(actions)
    assert in_play == [4] * 5 + [3] + [2] * 2


def test_the_action_of_one_does_not_depend_on_who_is_there():
    team = Team(PPO, "MlpPolicy", make_team_env(ToyEnv, n_envs=2), seed=0, **PPO_KWARGS)
    obs = make_team_env(ToyEnv, n_envs=3, seed=1).reset()
    everyone, _ = team.predict(obs, deterministic=True)
    for agent in obs:
        alone, _ = team.predict({agent: obs[agent]}, deterministic=True)
        assert list(alone) == [agent] and np.array_equal(alone[agent], everyone[agent])
    assert team.predict({}) == ({}, None)


def test_who_is_absent_keeps_its_state():
    team = Team(RecurrentPPO, "MlpLstmPolicy", make_team_env(ToyEnv), seed=0, **RECURRENT)
    obs = {agent: np.ones(2, np.float32) for agent in team.possible_agents}
    _, both = team.predict(obs)
    _, after = team.predict({"agent_0": obs["agent_0"]}, both)
    assert after["agent_1"] is both["agent_1"] and not np.array_equal(after["agent_0"][0], both["agent_0"][0])
    # Who comes later begins without a state
    _, first = team.predict({"agent_0": obs["agent_0"]})
    assert first["agent_1"] is None
    _, second = team.predict(obs, first)
    assert np.array_equal(second["agent_1"][0], both["agent_1"][0])


def test_masks_of_those_who_are_there():
    team, env = Team(MaskablePPO, "MlpPolicy", make_team_env(MaskedEnv), seed=0, **PPO_KWARGS), make_team_env(MaskedEnv)
    obs = env.reset()
    agent = team.possible_agents[0]
    mask = np.zeros_like(env.action_masks()[agent])
    mask[:, -1] = True
    for masks in ({agent: mask}, env.action_masks() | {agent: mask}, [{agent: mask[0]}]):
        assert team.predict({agent: obs[agent]}, action_masks=masks)[0][agent] == [mask.shape[1] - 1]


def test_unknown_names_are_refused():
    team = Team(PPO, "MlpPolicy", make_team_env(ToyEnv), seed=0, **PPO_KWARGS)
    with pytest.raises(ValueError, match=r"observation has entries for unknown agents \['agent_7'\]; the agents are"):
        team.predict({"agent_0": np.zeros(2), "agent_7": np.zeros(2)})
    with pytest.raises(TypeError, match=r"from \{agent: observation\}, not from ndarray"):
        team.predict(np.zeros(2))
