"""Copies that are made anew after a fault: what becomes of the broken episode, how often, and with which seed."""

import warnings
from functools import partial

import numpy as np
import pytest

from sb3_belief.common.processes import WorkerError, WorkerTimeoutError
from tests.team.helpers import make_team_env
from tests.team.toy_envs import MaskedEnv, PartneredEnv, ScriptedEnv, ToyEnv
from tests.vec_env.faulty_envs import OwnError, Troubled, Troubling
from tests.vec_env.test_worker_faults import no_test_hangs  # noqa: F401 (a fixture)

ACTIONS = {"agent_0": [2, 0], "agent_1": [1, 1]}
pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")


def restart_seed(seed, n):
    return int(np.random.SeedSequence((seed, n)).generate_state(1)[0] % 2**31)


def flaky(folder, fault="own", place="step", at=3, times=1, **kwargs):
    """Two copies, the first of which (by a file) has a fault at step 3."""
    maker = partial(Troubled, place, fault, at, folder=str(folder), times=times)
    return make_team_env(maker, n_envs=2, seed=10, **kwargs)


WAYS = [("dummy", "own"), ("subproc", "own"), ("subproc", "exit"), ("subproc", "hang"), ("subproc", "busy")]


@pytest.mark.parametrize(("vec_env", "fault"), WAYS)
def test_the_broken_episode_is_cut(vec_env, fault, tmp_path):
    timeout = {"step_timeout": 0.7} if vec_env == "subproc" else {}
    env = flaky(tmp_path, fault, vec_env=vec_env, restart_workers=1, **timeout)
    env.start_monitor(str(tmp_path / "monitor"))
    env.reset()
    env.step(ACTIONS)
    before = env.step(ACTIONS)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        obs, rewards, dones, infos = env.step(ACTIONS)
    (broken,) = np.flatnonzero(dones)
    sound = 1 - broken
    (message,) = [str(w.message) for w in caught if "made anew" in str(w.message)]
    cause = {"own": "OwnError: broken, 1 of 2", "exit": "(exit code 3) died during step()"}
    assert f"failed in environment copy {broken} at step 3" in message and "(restart 1 of 1)" in message
    assert cause.get(fault, "did not answer step() within 0.7 s") in message
    info = infos[broken]
    assert info["worker_restarted"] is True and info["TimeLimit.truncated"] is True
    assert "worker_restarted" not in infos[sound] and rewards[sound] != 0
    assert rewards[broken] == 0 and info["agent_rewards"].tolist() == [0, 0]
    assert info["active"].tolist() == [True, True] == info["truncated"].tolist()
    assert not info["life_end"].any() and not info["visible"].any()
    for agent in env.possible_agents:
        assert info["terminal_observation"][agent].tolist() == before[0][agent][broken].tolist()
    assert info["episode"]["l"] == 3
    # The new copy has a seed that follows from the old one's
    first, _ = ToyEnv().reset(seed=restart_seed(10 + broken, 1))
    assert all(obs[agent][broken].tolist() == first[agent].tolist() for agent in obs)
    assert env.n_restarts == 1
    env.step(ACTIONS)
    assert env.get_attr("t")[broken] == 1 and env.get_attr("t")[sound] == 4
    env.close()
    rows = (tmp_path / "monitor" / "monitor.csv").read_text().splitlines()
    assert len(rows) == 3 and rows[2].split(",")[1] == "3"


def test_a_copy_here_and_in_a_worker_break_alike(tmp_path):
    runs = []
    for vec_env in ("dummy", "subproc"):
        folder = tmp_path / vec_env
        folder.mkdir()
        maker = partial(Troubling, ScriptedEnv, 7, str(folder))
        env = make_team_env(maker, n_envs=1, seed=0, vec_env=vec_env, restart_workers=1)
        env.reset()
        runs.append([env.step({agent: [0] for agent in env.possible_agents}) for _ in range(9)])
        env.close()
    for (obs, rewards, dones, (info,)), (obs2, rewards2, dones2, (info2,)) in zip(*runs, strict=True):
        assert all((obs[agent] == obs2[agent]).all() for agent in obs)
        assert (rewards == rewards2).all() and (dones == dones2).all()
        assert info.keys() == info2.keys()
        for key in ("active", "life_end", "truncated", "visible", "agent_rewards"):
            assert info[key].dtype == info2[key].dtype and (info[key] == info2[key]).all()
    info = runs[0][6][3][0]
    assert info["worker_restarted"] and info["episode"]["l"] == 7
    # Two of the four have left before
    assert info["active"].tolist() == info["truncated"].tolist() == [True, False, False, True]
    assert info["terminal_observation"]["last"].tolist() == [6, 10]
    assert info["terminal_observation"]["dies"].tolist() == [0, 0]


@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
def test_the_first_step_of_an_episode_breaks(vec_env, tmp_path):
    env = flaky(tmp_path, at=1, vec_env=vec_env, restart_workers=1)
    first = env.reset()
    _, _, dones, infos = env.step(ACTIONS)
    (broken,) = np.flatnonzero(dones)
    assert infos[broken]["active"].all() and infos[broken]["episode"]["l"] == 1
    assert infos[broken]["terminal_observation"]["agent_0"].tolist() == first["agent_0"][broken].tolist()
    env.close()


@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
def test_masks_and_scripted_others_of_the_new_copy(vec_env, tmp_path):
    masked, partnered = tmp_path / "masked", tmp_path / "partnered"
    masked.mkdir()
    partnered.mkdir()
    env = make_team_env(partial(Troubling, MaskedEnv, 2, str(masked)), vec_env=vec_env, restart_workers=1)
    env.reset()
    for t in range(4):
        # At step t agent 0 may only do t modulo 3; the second step breaks off, and a new episode begins
        allowed = [0, 1, 0, 1][t]
        assert env.action_masks()["agent_0"].tolist() == [[i == allowed for i in range(3)]]
        _, _, dones, _ = env.step({"agent_0": [allowed], "agent_1": [0]})
        assert dones.tolist() == [t == 1]
    env.close()
    env = make_team_env(partial(Troubling, PartneredEnv, 2, str(partnered)), vec_env=vec_env, restart_workers=1)
    env.reset()
    actions = {"arrow": [0], "ball": [[0.0]]}
    infos = [env.step(actions)[3][0] for _ in range(3)]
    assert [info["scripted_actions"].tolist() for info in infos] == [[1, -1, 1, 0, 0, 0], [0] * 6, [1, -1, 1, 0, 0, 0]]
    assert infos[1]["visible"].shape == (2, 3)
    env.close()


class NoChoice(ToyEnv):
    """Its second agent is never in play, and has masks that allow no action."""

    def infos(self):
        return {"agent_0": {}, "agent_1": {"action_mask": np.zeros(3, dtype=bool), "active": False}}


def test_an_agent_without_a_choice_when_the_step_breaks_off(tmp_path):
    """Nobody knows whether it would have been in play."""
    env = make_team_env(partial(Troubling, NoChoice, 1, str(tmp_path)), restart_workers=1)
    env.reset()
    actions = {"agent_0": [0], "agent_1": [0]}
    assert [env.step(actions)[2].tolist() for _ in range(3)] == [[True], [False], [False]]


@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
def test_no_more_restarts_than_allowed(vec_env, tmp_path):
    """Counted for each copy, over all episodes; then the error is raised as without them."""
    env = flaky(tmp_path, times=None, vec_env=vec_env, restart_workers=2)
    env.reset()
    for n in (1, 2):
        for _ in range(2):
            env.step(ACTIONS)
        obs, _, dones, _ = env.step(ACTIONS)
        assert dones.tolist() == [True, True]
        firsts = [ToyEnv().reset(seed=restart_seed(10 + copy, n))[0]["agent_0"].tolist() for copy in (0, 1)]
        assert obs["agent_0"].tolist() == firsts
    assert env.n_restarts == 4
    for _ in range(2):
        env.step(ACTIONS)
    with pytest.raises(OwnError, match="broken, 1 of 2"):
        env.step(ACTIONS)
    assert env.n_restarts == 4
    env.close()


def test_no_more_restarts_after_hangs_than_allowed(tmp_path):
    env = flaky(tmp_path, "hang", times=None, vec_env="subproc", restart_workers=1, step_timeout=0.7)
    env.reset()
    for _ in range(5):
        env.step(ACTIONS)
    with pytest.raises(WorkerTimeoutError, match="worker process 0 did not answer step"):
        env.step(ACTIONS)
    assert env.n_restarts == 2 and not any(process.is_alive() for process in env.venv.processes)
    env.close()


@pytest.mark.parametrize(("vec_env", "fault"), WAYS[:3])
def test_a_reset_that_fails(vec_env, fault, tmp_path):
    """There is no episode to cut."""
    env = flaky(tmp_path, fault, "reset", at=1, vec_env=vec_env, restart_workers=2)
    obs = env.reset()
    assert env.n_restarts == 1
    seeds = [restart_seed(10, 1), 11], [10, restart_seed(11, 1)]
    firsts = [[ToyEnv().reset(seed=seed)[0]["agent_0"].tolist() for seed in each] for each in seeds]
    assert obs["agent_0"].tolist() in firsts
    env.step(ACTIONS)
    env.close()


@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
def test_a_new_copy_that_fails_too(vec_env, tmp_path):
    """Its failures count as well."""
    env = flaky(tmp_path, "own", "reset", at=1, times=2, vec_env=vec_env, restart_workers=2)
    env.reset()
    assert env.n_restarts == 2
    env.close()


def test_faults_elsewhere_restart_nothing(tmp_path):
    env = flaky(tmp_path, "exit", "method", vec_env="subproc", restart_workers=5)
    env.reset()
    with pytest.raises(WorkerError, match=r"died during env_method\(\)"):
        env.env_method("method")
    assert env.n_restarts == 0


def test_restarts_are_off_by_default(tmp_path):
    env = flaky(tmp_path)
    env.reset()
    for _ in range(2):
        env.step(ACTIONS)
    with pytest.raises(OwnError):
        env.step(ACTIONS)


def test_the_exact_state_knows_of_restarts(tmp_path):
    env = flaky(tmp_path, times=1, restart_workers=3)
    env.reset()
    steps = [env.step(ACTIONS) for _ in range(4)]
    state = env.venv.restarts.state()
    other = flaky(tmp_path, times=1, restart_workers=3)
    other.reset()
    other.venv.restarts.set_state(state)
    assert other.n_restarts == 1 and other.venv.restarts.seeds == [10, 11]
    last = other.venv.restarts.last
    assert (last.observations["agent_0"] == steps[-1][0]["agent_0"]).all() and not last.dones.any()
    assert last.infos[0]["active"].tolist() == [True, True]


@pytest.mark.parametrize("value", [-1, 1.0, True, None])
def test_restart_workers_is_a_number(value):
    with pytest.raises(ValueError, match="restart_workers must be a number of restarts"):
        make_team_env(ToyEnv, restart_workers=value)


def test_batched_environments_are_stepped_copy_by_copy():
    """Only so can one of them be made anew."""
    assert hasattr(make_team_env("traffic-junction-easy", restart_workers=1), "venv")
    assert not hasattr(make_team_env("traffic-junction-easy"), "venv")
