"""Team follows SB3's model protocol: construction, prediction, evaluation, callbacks and normalisation."""

from functools import partial

import numpy as np
import pytest
import torch as th
from mpe2 import simple_spread_v3
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.callbacks import (
    CallbackList,
    CheckpointCallback,
    EvalCallback,
    EveryNTimesteps,
    LogEveryNTimesteps,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from sb3_belief.team.agent_models import agent_seed, env_seed
from tests.team.helpers import PPO_KWARGS, Record, Team, make_team_env, parameters
from tests.team.toy_envs import MixedEnv, ScriptedEnv, ToyEnv


def make_team(n_envs=2, env=None, **kwargs):
    """Return a team of PPO agents, by default in copies of a ``ToyEnv``."""
    return Team(PPO, "MlpPolicy", env or make_team_env(ToyEnv, n_envs=n_envs), **{"seed": 0, **PPO_KWARGS, **kwargs})


def test_seeds():
    team, same, other = make_team(), make_team(), make_team(seed=1)
    assert team.agents["agent_0"].seed == agent_seed(0, 0) != agent_seed(0, 1)
    assert len({agent_seed(s, k) for s in range(5) for k in range(5)}) == 25
    assert th.equal(parameters(team.agents["agent_1"]), parameters(same.agents["agent_1"]))
    assert not th.equal(parameters(team.agents["agent_1"]), parameters(team.agents["agent_0"]))
    assert not th.equal(parameters(team.agents["agent_1"]), parameters(other.agents["agent_1"]))
    # The environment is given a seed that follows from the team's
    env = make_team_env(ToyEnv, n_envs=2, seed=env_seed(0))
    assert np.array_equal(team.get_env().reset()["agent_1"], env.reset()["agent_1"])
    unseeded = [make_team(seed=None) for _ in range(2)]
    assert not th.equal(*(parameters(team.agents["agent_0"]) for team in unseeded))
    assert unseeded[0].agents["agent_0"].seed is None


def test_agents_share_nothing():
    policy_kwargs = {"net_arch": [8]}
    team = Team({"agent_0": A2C, "agent_1": PPO}, "MlpPolicy", make_team_env(ToyEnv), seed=0, policy_kwargs=policy_kwargs)
    # A2C writes its optimizer's class into policy_kwargs
    assert "optimizer_class" in team.agents["agent_0"].policy_kwargs
    assert "optimizer_class" not in team.agents["agent_1"].policy_kwargs and policy_kwargs == {"net_arch": [8]}
    spaces = [model.action_space for model in team.agents.values()]
    assert spaces[0] == spaces[1] and spaces[0] is not spaces[1]


def test_kwargs_of_single_agents():
    team = make_team(agent_kwargs={"agent_1": {"n_steps": 16, "gamma": 0.5}})
    assert [(model.n_steps, model.gamma) for model in team.agents.values()] == [(8, 0.99), (16, 0.5)]


@pytest.mark.parametrize(
    "change, error, says",
    [
        ({"env": ToyEnv()}, TypeError, r"make_team_env\(lambda: your_env"),
        ({"env": "CartPole-v1"}, TypeError, "needs a TeamVecEnv"),
        ({"env": VecNormalize(make_team_env(ToyEnv))}, ValueError, "normalize=True"),
        ({"algo_class": {"agent_0": PPO}}, ValueError, r"algo_class has no entry for \['agent_1'\]"),
        ({"algo_class": {"agent_0": PPO, "agent_1": PPO, "x": PPO}}, ValueError, r"unknown agents \['x'\]"),
        ({"algo_class": "PPO"}, TypeError, "'agent_0' must be a class"),
        ({"policy": {"agent_0": "MlpPolicy"}}, ValueError, "policy has no entry"),
        ({"agent_kwargs": {"agent_3": {}}}, ValueError, r"agent_kwargs has entries for unknown agents \['agent_3'\]"),
        ({"no_such_argument": 1}, TypeError, "no_such_argument"),
    ],
)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_what_is_refused(change, error, says):
    arguments = {"algo_class": PPO, "policy": "MlpPolicy", "env": make_team_env(ToyEnv), **change}
    with pytest.raises(error, match=says):
        Team(**arguments)


def test_unknown_agent_callback():
    with pytest.raises(ValueError, match="agent_callbacks has entries for unknown agents"):
        make_team().learn(8, agent_callbacks={"nobody": Record()})


def test_predict_batched_single_and_other_numbers_of_copies():
    team = make_team()
    for n in (2, 5):
        obs = make_team_env(ToyEnv, n_envs=n, seed=1).reset()
        actions, state = team.predict(obs, deterministic=True)
        assert state is None and {agent: part.shape for agent, part in actions.items()} == {"agent_0": (n,), "agent_1": (n,)}
        single, _ = team.predict({agent: part[0] for agent, part in obs.items()}, deterministic=True)
        assert all(single[agent] == actions[agent][0] and np.ndim(single[agent]) == 0 for agent in single)
        assert np.array_equal(actions["agent_1"], team.agents["agent_1"].predict(obs["agent_1"], deterministic=True)[0])


def test_evaluate_policy():
    team = make_team()
    rewards, lengths = evaluate_policy(team, make_team_env(ToyEnv, n_envs=3, seed=0), 6, return_episode_rewards=True)
    assert lengths == [7] * 6 and np.isfinite(rewards).all()
    # SB3's VecMonitor counts the same returns as the built-in monitor
    mean, _ = evaluate_policy(team, make_team_env(ToyEnv, n_envs=3, seed=0), 6)
    monitored, _ = evaluate_policy(team, VecMonitor(make_team_env(ToyEnv, n_envs=3, seed=0)), 6)
    assert mean == pytest.approx(np.mean(rewards)) and mean == pytest.approx(monitored, rel=1e-5)


def test_eval_checkpoint_and_threshold_callbacks(tmp_path):
    team = make_team(verbose=0)
    stop = StopTrainingOnRewardThreshold(reward_threshold=-1e6)
    evaluate = EvalCallback(
        make_team_env(ToyEnv, n_envs=2, seed=9),
        callback_on_new_best=stop,
        n_eval_episodes=4,
        eval_freq=10,
        log_path=str(tmp_path / "eval"),
        best_model_save_path=str(tmp_path / "best"),
        verbose=0,
    )
    checkpoint = CheckpointCallback(save_freq=4, save_path=str(tmp_path / "checkpoints"), name_prefix="team")
    record = Record()
    team.learn(1000, callback=[checkpoint, evaluate, record])
    # The first evaluation, at the 10th step, is above the threshold
    assert record.steps == 10 and team.num_timesteps == 20
    names = sorted(path.name for path in (tmp_path / "checkpoints").iterdir())
    assert names == ["team_16_steps.zip", "team_8_steps.zip"]
    assert Team.load(tmp_path / "checkpoints" / "team_8_steps").num_timesteps == 8
    results = np.load(tmp_path / "eval" / "evaluations.npz")
    assert results["timesteps"].tolist() == [20] and results["results"].shape == (1, 4)
    best = Team.load(tmp_path / "best" / "best_model.zip")
    again, _ = evaluate_policy(best, make_team_env(ToyEnv, n_envs=2, seed=9), 4, return_episode_rewards=True)
    assert again == pytest.approx(results["results"][0])


def test_evaluating_does_not_change_what_is_learned():
    runs = []
    for n_eval_episodes in (0, 3):
        team = make_team()
        env = make_team_env(ToyEnv, seed=1)
        callback = EvalCallback(env, n_eval_episodes=n_eval_episodes, eval_freq=3, deterministic=False, verbose=0)
        team.learn(48, callback=callback if n_eval_episodes else None)
        runs.append([parameters(model) for model in team.agents.values()])
    assert all(th.equal(a, b) for a, b in zip(*runs, strict=True))


def test_further_callbacks_and_progress_bar(capsys):
    team = make_team()
    calls, every = [], Record()

    def function(locals_, globals_):
        calls.append((locals_["self"] is team, len(locals_["infos"])))
        return True

    callbacks = CallbackList([EveryNTimesteps(8, every), LogEveryNTimesteps(8), StopTrainingOnMaxEpisodes(1)])
    team.learn(1000, callback=callbacks, progress_bar=True)
    assert team.num_timesteps == 14 and every.steps == 1
    assert "14/1,000" in capsys.readouterr().out
    team.learn(16, callback=function)
    assert calls == [(True, 2)] * 8


def test_normalisation_is_each_agents_own():
    env = make_team_env(ScriptedEnv, n_envs=2)
    team = Team(PPO, "MlpPolicy", env, seed=0, normalize={"clip_obs": 3.0}, **{**PPO_KWARGS, "gamma": 0.5})
    assert team.get_vec_normalize_env() is None
    team.learn(64)
    statistics = {agent: model.get_vec_normalize_env() for agent, model in team.agents.items()}
    assert all(s.clip_obs == 3.0 and s.gamma == 0.5 for s in statistics.values())
    assert len({s.obs_rms.mean[0] for s in statistics.values()}) == 4  # All are out of play at other times
    assert statistics["last"].obs_rms.mean[0] == pytest.approx(3.5, abs=0.2)  # The mean of the steps 0 to 7
    assert len({float(s.ret_rms.var) for s in statistics.values()}) == 4
    # Predictions use the statistics without updating them
    obs = env.reset()
    before = {agent: s.obs_rms.mean.copy() for agent, s in statistics.items()}
    actions, _ = team.predict(obs, deterministic=True)
    for agent, s in statistics.items():
        normalised = np.clip((obs[agent] - before[agent]) / np.sqrt(s.obs_rms.var + s.epsilon), -3, 3).astype(np.float32)
        assert np.array_equal(actions[agent], team.agents[agent].predict(normalised, deterministic=True)[0])
        assert np.array_equal(s.obs_rms.mean, before[agent])


def test_normalisation_leaves_discrete_observations():
    env = make_team_env(MixedEnv)
    team = Team(PPO, "MlpPolicy", env, seed=0, normalize=True, **PPO_KWARGS)
    team.learn(16)
    flags = {agent: model.get_vec_normalize_env().norm_obs for agent, model in team.agents.items()}
    assert flags == {"zeta": True, "box": True, "multi": False, "binary": True}
    assert all(model.get_vec_normalize_env().norm_reward for model in team.agents.values())


def test_normalised_agents_act_on_when_finished():
    own_kwargs = {"agent_0": {"n_steps": 4}, "agent_1": {"n_steps": 16}}
    team = make_team(normalize=True, agent_kwargs=own_kwargs)
    seen = []
    model = team.agents["agent_0"]
    predict = model.predict

    def noted(obs, *args, **kwargs):
        seen.append(obs.copy())
        return predict(obs, *args, **kwargs)

    model.predict = noted
    record = Record(keep=("new_obs",))
    team.learn(24, callback=record)
    del model.predict
    count = model.get_vec_normalize_env().obs_rms.count
    assert len(seen) == 4 and count == pytest.approx(2 * (12 + 1), abs=1e-3)
    raw = record.kept[-2]["new_obs"]["agent_0"]
    assert np.array_equal(seen[-1], model.get_vec_normalize_env().normalize_obs(raw))


def test_set_env():
    team = make_team(normalize=True)
    team.learn(16)
    new = make_team_env(partial(ToyEnv, limit=3), n_envs=2)
    team.set_env(new)
    assert team.get_env() is new
    record = Record(keep=("dones",))
    team.learn(16, reset_num_timesteps=False, callback=record)
    assert [bool(kept["dones"][0]) for kept in record.kept] == [False, False, True] * 2 + [False, False]
    assert team.num_timesteps == 32
    with pytest.raises(ValueError, match="buffers are for 2 copies, the environment has 3"):
        team.set_env(make_team_env(ToyEnv, n_envs=3))
    with pytest.raises(ValueError, match="has the agents"):
        team.set_env(make_team_env(partial(ToyEnv, n_agents=3), n_envs=2))


def test_spaces_are_by_agent():
    team = Team(PPO, "MlpPolicy", make_team_env(MixedEnv), **PPO_KWARGS)
    assert team.possible_agents == list(team.agents) == ["zeta", "box", "multi", "binary"]
    assert team.observation_space["multi"].n == 4 and team.action_space["box"].shape == (2,)


def test_dqn_and_ppo_and_a2c_on_simple_spread():
    env = make_team_env(simple_spread_v3.parallel_env, n_envs=2, env_kwargs={"max_cycles": 6})
    classes = {"agent_0": PPO, "agent_1": DQN, "agent_2": A2C}
    own_kwargs = {"agent_0": {"n_steps": 8, "batch_size": 8}, "agent_1": {"learning_starts": 8}}
    team = Team(classes, "MlpPolicy", env, seed=0, agent_kwargs=own_kwargs)
    before = [parameters(model) for model in team.agents.values()]
    team.learn(48)
    assert all(not th.equal(a, parameters(model)) for a, model in zip(before, team.agents.values(), strict=True))
