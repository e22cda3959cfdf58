"""Recurrent agents start anew at each life of their own, in evaluation as in training."""

import copy
import pickle
import warnings
from functools import partial

import numpy as np
import pytest
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnvWrapper, VecMonitor

from sb3_belief.team.predictor import Predictor
from tests.team.helpers import Team, make_team_env
from tests.team.toy_envs import ScriptedEnv, ToyEnv

KWARGS = {"n_steps": 8, "batch_size": 8, "n_epochs": 1, "policy_kwargs": {"net_arch": [8], "lstm_hidden_size": 8}}
ENVS = {
    "cars, batched": partial(make_team_env, "traffic-junction-easy", env_kwargs={"arrival_rate": 0.5}),
    "cars": partial(make_team_env, "traffic-junction-easy", env_kwargs={"arrival_rate": 0.5}, vec_env="subproc"),
    "every kind of end": partial(make_team_env, ScriptedEnv),
}


def make_team(env):
    return Team(RecurrentPPO, "MlpLstmPolicy", env, seed=0, **KWARGS)


class Evaluation:
    """What ``evaluate_policy`` and ``EvalCallback`` have done, step by step."""

    def __init__(self):
        self.steps = []

    def __call__(self, locals_, globals_):
        if locals_["i"] == 0:
            names = ("observations", "actions", "states", "dones", "infos")
            self.steps.append({name: copy.deepcopy(locals_[name]) for name in names})


def as_in_training(team, steps):
    """Return each step's actions and states, where each agent's model is given its own dones."""
    n_envs = len(steps[0]["dones"])
    results = []
    state = dict.fromkeys(team.possible_agents)
    starts = {agent: np.ones(n_envs, dtype=bool) for agent in team.possible_agents}
    for step in steps:
        actions = {}
        for i, agent in enumerate(team.possible_agents):
            predictor = Predictor(team.agents[agent], team.agents[agent].get_vec_normalize_env())
            actions[agent], state[agent] = predictor.predict(step["observations"][agent], state[agent], starts[agent], True)
            ended = [info["life_end"][i] or info["truncated"][i] for info in step["infos"]]
            starts[agent] = step["dones"] | np.array(ended)
        results.append((actions, dict(state)))
    return results


@pytest.mark.parametrize("kind", ENVS)
def test_evaluation_gives_the_actions_of_training(kind):
    make, evaluation = partial(ENVS[kind], n_envs=3), Evaluation()
    team, env = make_team(make()), VecMonitor(make(seed=7))
    team.learn(48)
    evaluate_policy(team, env, n_eval_episodes=4, callback=evaluation)
    n_lives = 0
    for step, (actions, state) in zip(evaluation.steps, as_in_training(team, evaluation.steps), strict=True):
        for agent in team.possible_agents:
            assert np.array_equal(step["actions"][agent], actions[agent])
            assert all(np.array_equal(a, b) for a, b in zip(step["states"][agent], state[agent], strict=True))
        n_lives += sum(info["life_end"].any() and not done for info, done in zip(step["infos"], step["dones"], strict=True))
    assert n_lives > 3
    team.get_env().close()
    env.close()


def test_an_eval_callback(monkeypatch):
    evaluation = Evaluation()
    callback = EvalCallback(make_team_env(ScriptedEnv), n_eval_episodes=2, eval_freq=8, verbose=0)
    monkeypatch.setattr(callback, "_log_success_callback", evaluation)
    team = make_team(make_team_env(ScriptedEnv))
    team.learn(8, callback=callback)
    assert len(evaluation.steps) == 16
    # In the last step of the rollout, before the update
    frozen = make_team(make_team_env(ScriptedEnv))
    for step, (actions, _) in zip(evaluation.steps, as_in_training(frozen, evaluation.steps), strict=True):
        assert all(np.array_equal(step["actions"][agent], actions[agent]) for agent in actions)


def test_where_lives_have_ended():
    env = make_team_env(ScriptedEnv, n_envs=2)
    assert all(env.reset().life_ends(agent) is None for agent in env.possible_agents)
    actions = {agent: np.zeros(2, int) for agent in env.possible_agents}
    ends: dict[str, list[int]] = {agent: [] for agent in env.possible_agents}
    for t in range(1, 10):
        obs, *_ = env.step(actions)
        for agent, steps in ends.items():
            for kept in (copy.deepcopy(obs), pickle.loads(pickle.dumps(obs))):
                assert np.array_equal(kept.life_ends(agent), obs.life_ends(agent))
            if obs.life_ends(agent)[1]:
                steps.append(t)
    # "dies" and "cut" have left before the team's end at step 8
    assert ends == {"stays": [3, 8], "dies": [5], "cut": [6], "last": [8]}


def test_a_users_own_starts():
    team = make_team(make_team_env(ToyEnv, n_envs=2))
    obs = dict(make_team_env(ToyEnv, n_envs=2, seed=1).reset())
    _, first = team.predict(obs)
    _, second = team.predict(obs, first, {"agent_0": np.array([True, False]), "agent_1": np.array([False, False])})
    assert np.array_equal(second["agent_0"][0][:, 0], first["agent_0"][0][:, 0])
    assert not np.allclose(second["agent_0"][0][:, 1], first["agent_0"][0][:, 1])
    assert not np.allclose(second["agent_1"][0], first["agent_1"][0])


class Doubles(VecEnvWrapper):
    """A wrapper of the user's own, which makes observations anew."""

    def _doubled(self, obs):
        return {agent: 2 * each for agent, each in obs.items()}

    def reset(self):
        return self._doubled(self.venv.reset())

    def step_wait(self):
        obs, *rest = self.venv.step_wait()
        return self._doubled(obs), *rest


def test_what_does_not_know_says_so():
    env = Doubles(make_team_env(ToyEnv, n_envs=2, seed=0))
    team = make_team(env)
    with pytest.warns(
        UserWarning, match=r"start anew only with the team's episode here.*episode_start=\{agent: bool"
    ) as caught:
        evaluate_policy(team, env, n_eval_episodes=2)
    assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        feed_forward = Team(PPO, "MlpPolicy", env, seed=0, n_steps=8, batch_size=8)
        evaluate_policy(feed_forward, env, n_eval_episodes=2)
        evaluate_policy(make_team(make_team_env(ToyEnv, n_envs=2)), make_team_env(ToyEnv), n_eval_episodes=2)
