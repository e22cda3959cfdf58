"""Teams whose agents adapt while they play: resumed, in worker processes, and while they are evaluated."""

from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_belief import BeliefPPO
from sb3_belief import team as sb3_team
from sb3_belief.team.checkpoints import Checkpoints
from tests.team.helpers import PPO_KWARGS, Team, make_team_env, parameters
from tests.team.toy_envs import BlinkingEnv

observing: Any = sb3_team.observing
ADAPTIVE: dict[str, Any] = {
    **PPO_KWARGS,
    "belief": "adaptive",
    "history_length": 40,
    "n_own": 4,
    "n_pool": 4,
    "history_dropout": 0.2,
    "prediction_steps": 2,
    "critic_sees_others": True,
    "belief_replay": 2,
    "policy_kwargs": {"net_arch": [8], "embedding_dim": 8, "latent_dim": 4},
}


def learned(steps, jobs=1, **kwargs):
    env = make_team_env(BlinkingEnv, n_envs=2, seed=0)
    return Team(BeliefPPO, "BeliefPolicy", env, seed=0, jobs=jobs, **{**ADAPTIVE, **kwargs}).learn(steps)


def same(a, b):
    return all(np.array_equal(parameters(a.agents[name]), parameters(b.agents[name])) for name in a.agents)


def histories(team):
    return {
        (name, field): rows.numpy().tobytes()
        for name, model in team.agents.items()
        for field, rows in model.policy.history._asdict().items()
    }


def test_agents_in_worker_processes_learn_the_same():
    here, there = learned(96), learned(96, jobs=2)
    assert same(here, there) and histories(here) == histories(there)


def test_a_training_goes_on_exactly(tmp_path):
    whole = learned(96)
    # Within an episode of six steps, whose beginning is in the memory
    half = learned(32)
    assert half.agents["arrow"].policy.history.stamps[:, 2].max() == 12
    half.save(tmp_path / "half.zip", exact=True)
    env = make_team_env(BlinkingEnv, n_envs=2, seed=0)
    resumed = Team.load(tmp_path / "half.zip", env=env, exact=True)
    resumed.learn(64, reset_num_timesteps=False)
    assert same(whole, resumed) and histories(whole) == histories(resumed)


def test_a_checkpoint_holds_what_is_in_the_workers(tmp_path):
    # A callback of the library's, as others keep all agents in the main process
    whole = Team(BeliefPPO, "BeliefPolicy", make_team_env(BlinkingEnv, n_envs=2, seed=0), seed=0, jobs=2, **ADAPTIVE)
    whole.learn(96, callback=Checkpoints(str(tmp_path), save_freq=32, keep=10))
    assert same(whole, learned(96))
    for steps in (32, 64):
        env = make_team_env(BlinkingEnv, n_envs=2, seed=0)
        resumed = Team.load(tmp_path / f"team_{steps}_steps.zip", env=env, exact=True)
        resumed.learn(96 - steps, reset_num_timesteps=False)
        assert same(whole, resumed) and histories(whole) == histories(resumed)


@pytest.mark.parametrize("normalize", [False, True])
def test_what_is_observed_goes_into_the_memory_of_its_copy(normalize):
    team = learned(48, normalize=normalize)
    before = histories(team)
    env = make_team_env(BlinkingEnv, n_envs=3, seed=5)
    got: dict[str, set[float]] = {agent: set() for agent in team.agents}

    def note(local: dict[str, Any], _: Any) -> None:
        for k, agent in enumerate(env.possible_agents):
            rewards = np.array([local["infos"][local["i"]]["agent_rewards"][k]])
            got[agent].add(float(np.float32(team.rewarded_by(agent, rewards)[0])))

    with observing(team, env) as watched:
        evaluate_policy(team, watched, n_eval_episodes=6, callback=note)
        for agent, model in team.agents.items():
            rows = model.policy.history
            own = rows.own[rows.valid & (rows.stamps[:, 1] < 0)]
            stamps = rows.stamps[rows.valid & (rows.stamps[:, 1] < 0)]
            assert set(stamps[:, 1].tolist()) == {-1, -2, -3}
            # Several episodes of each copy, each by its beginning
            assert all(len(set(stamps[stamps[:, 1] == copy, 2].tolist())) > 1 for copy in (-1, -2, -3))
            assert own[:, :-1].any(dim=1).all() and own[:, -1].any()
            # In the unit of the training
            assert set(own[:, -1].tolist()) <= got[agent]
        # An episode that is cut off by a reset is over, too
        obs = watched.reset()
        for _ in range(3):
            obs = watched.step(team.predict(obs)[0])[0]
        watched.reset()
        for model in team.agents.values():
            rows = model.policy.history
            for _, place, began in model.policy.features_extractor.present_stamps(3).tolist():
                assert began not in rows.stamps[rows.valid & (rows.stamps[:, 1] == place), 2]
    assert histories(team) == before
