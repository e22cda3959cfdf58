"""Where teams are made and learn: unseeded after global seeds, in threads, in the workers of a pool."""

import multiprocessing
import threading
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import set_random_seed

from sb3_belief.team.agent_models import env_seed
from tests.team.helpers import PPO_KWARGS, Team, make_team_env, parameters
from tests.team.toy_envs import ToyEnv


def unseeded(algorithm=PPO, **kwargs):
    return Team(algorithm, "MlpPolicy", make_team_env(ToyEnv, n_envs=2, seed=3), **kwargs)


def weights(team):
    return th.cat([parameters(model) for model in team.agents.values()])


def test_global_seeds_make_an_unseeded_team_repeat_itself(tmp_path):
    def run(seed):
        set_random_seed(seed)
        return unseeded(**PPO_KWARGS).learn(48)

    first, again, other = run(0), run(0), run(1)
    assert th.equal(weights(first), weights(again)) and not th.equal(weights(first), weights(other))
    # Two teams after one seed differ, and so do the agents of one
    set_random_seed(0)
    assert not th.equal(weights(unseeded(**PPO_KWARGS)), weights(unseeded(**PPO_KWARGS)))
    agents = first.agents.values()
    assert len({float(parameters(model).sum()) for model in agents}) == len(agents)
    # So it is for those that are loaded
    first.save(tmp_path / "team")
    runs = []
    for _ in range(2):
        set_random_seed(5)
        loaded = Team.load(tmp_path / "team", env=make_team_env(ToyEnv, n_envs=2, seed=3))
        runs.append(weights(loaded.learn(48)))
    assert th.equal(*runs)


def test_each_global_generator_counts_by_itself():
    th.manual_seed(0)
    first = weights(unseeded(**PPO_KWARGS))
    th.manual_seed(0)
    np.random.seed()
    assert th.equal(first, weights(unseeded(**PPO_KWARGS)))
    # Without a seed in between the stream goes on
    assert not th.equal(first, weights(unseeded(**PPO_KWARGS)))


def test_a_seeded_team_neither_reads_nor_moves_the_global_generators():
    runs, states = [], []
    for seed in (0, 1):
        set_random_seed(seed)
        runs.append(weights(Team(PPO, "MlpPolicy", make_team_env(ToyEnv), seed=0, **PPO_KWARGS).learn(16)))
        states.append((float(np.random.rand()), float(th.rand(()))))
        set_random_seed(seed)
        assert states[-1] == (float(np.random.rand()), float(th.rand(())))
    assert th.equal(*runs)


def test_neighbouring_seeds_have_no_episodes_in_common(tmp_path):
    def first(team):
        obs = team.get_env().reset()
        return {tuple(row) for row in obs["agent_0"].tolist()}

    def make(seed):
        return Team(PPO, "MlpPolicy", make_team_env(ToyEnv, n_envs=8), seed=seed, **PPO_KWARGS)

    rows = [first(make(seed)) for seed in (0, 1, 2)]
    assert all(len(each) == 8 for each in rows) and len(set.union(*rows)) == 24
    assert first(make(1)) == rows[1]
    make(1).save(tmp_path / "team")
    assert first(Team.load(tmp_path / "team", env=make_team_env(ToyEnv, n_envs=8))) == rows[1]
    # Evaluations have others; a thousand seeds and their copies do not meet
    starts = sorted(env_seed(seed, purpose) for seed in range(1000) for purpose in (0, 1))
    assert min(np.diff(starts)) > 64 and starts[0] >= 0 and starts[-1] < 2**30
    # By hand it is SB3's rule, also after the team was made
    team = make(0)
    team.get_env().seed(5)
    by_hand = [make_team_env(ToyEnv, n_envs=8, seed=seed).reset()["agent_0"] for seed in (5, 6)]
    assert first(team) == {tuple(row) for row in by_hand[0].tolist()}
    assert np.array_equal(by_hand[0][1:], by_hand[1][:-1])


def in_thread(call):
    """Return what a call raises in another thread, and what it returns there."""
    raised: list[Exception] = []
    returned: list[Any] = []

    def work():
        try:
            returned.append(call())
        except Exception as error:
            raised.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    return next(iter(raised), None), next(iter(returned), None)


def test_a_team_that_learns_does_not_predict_in_another_thread():
    team, errors = unseeded(PPO, n_steps=8, batch_size=8), []
    observations = {agent: space.sample() for agent, space in team.observation_space.spaces.items()}

    class Predicts(BaseCallback):
        def _on_step(self):
            errors.append(in_thread(lambda: team.predict(observations))[0])
            # In the thread that learns it may
            team.predict(observations)
            return True

    team.learn(16, callback=Predicts())
    assert errors and all(isinstance(error, RuntimeError) and "Another thread" in str(error) for error in errors)
    assert in_thread(lambda: team.predict(observations))[0] is None


@pytest.mark.parametrize("algorithm, kwargs", [(PPO, PPO_KWARGS), (DQN, {"learning_starts": 4})])
def test_two_teams_in_threads_are_refused(algorithm, kwargs, tmp_path):
    second = unseeded(algorithm, log_dir=str(tmp_path / "second"), **kwargs)
    before = weights(second)
    errors = []

    class OtherThread(BaseCallback):
        def _on_step(self):
            errors.append(in_thread(lambda: second.learn(16))[0])
            errors.append(in_thread(lambda: unseeded(algorithm, **kwargs))[0])
            return self.n_calls < 2

    unseeded(algorithm, **kwargs).learn(16, callback=OtherThread())
    assert len(errors) == 4
    for error in errors:
        assert isinstance(error, RuntimeError) and "a process for each" in str(error)
    # Nothing was begun, and the way is free afterwards, for a thread, too
    assert th.equal(before, weights(second)) and not (tmp_path / "second").exists() and second.num_timesteps == 0
    error, team = in_thread(lambda: second.learn(16))
    assert error is None and team.num_timesteps == 16
    second.learn(16)


def test_an_error_frees_the_generators():
    def fails(locals_, globals_):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        unseeded(**PPO_KWARGS).learn(16, callback=fails)
    assert in_thread(lambda: unseeded(**PPO_KWARGS).learn(16))[0] is None


def _in_a_pool(kind):
    try:
        if kind == "jobs":
            Team(PPO, "MlpPolicy", make_team_env(ToyEnv, n_envs=2), jobs=2, **PPO_KWARGS)
        elif kind == "subproc":
            make_team_env(ToyEnv, vec_env="subproc")
        else:
            Team(PPO, "MlpPolicy", make_team_env(ToyEnv, n_envs=2), seed=0, **PPO_KWARGS).learn(16)
    except Exception as error:
        return type(error).__name__, str(error)
    return None


def test_a_worker_of_a_pool_is_told_that_it_can_have_no_workers():
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        jobs, subproc, plain = pool.map(_in_a_pool, ["jobs", "subproc", "plain"])
    assert jobs[0] == subproc[0] == "ValueError" and plain is None
    assert jobs[1].startswith("jobs=2 starts processes") and "use jobs=1 in it" in jobs[1]
    assert subproc[1].startswith('vec_env="subproc" starts processes') and "ProcessPoolExecutor" in subproc[1]
