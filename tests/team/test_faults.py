"""Whatever fails while a team learns: nothing hangs, nothing learned or saved is lost, and the error says what happened."""

import os
import signal
import sys
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

from tests.team.helpers import PPO_KWARGS, Record, Team, make_team_env, parameters
from tests.team.toy_envs import FaultyEnv, ToyEnv
from tests.vec_env.faulty_envs import Troubled


@pytest.fixture(autouse=True)
def ctrl_c_interrupts():
    """Let Ctrl-C interrupt also where the tests run in the background, since a shell has it ignored there."""
    old = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, old)


def make_team(env=None, n_agents=3, **kwargs):
    """Return a team of PPO agents, by default in two copies of a ``ToyEnv``."""
    env = env or make_team_env(partial(ToyEnv, n_agents=n_agents), n_envs=2)
    return Team(PPO, "MlpPolicy", env, seed=0, **{**PPO_KWARGS, **kwargs})


def notes(error):
    """Return the notes that were added to an error."""
    return " ".join(getattr(error, "__notes__", []))


def works_again(team, tmp_path):
    """Assert that the team saves and learns as if nothing had happened."""
    team.save(tmp_path / "after")
    before = {agent: parameters(model) for agent, model in team.agents.items()}
    team.learn(32)
    assert team.num_timesteps == 32
    assert all(not th.equal(before[agent], parameters(model)) for agent, model in team.agents.items())
    loaded = Team.load(tmp_path / "after", allow_packages=["tests"])
    assert all(th.equal(before[agent], parameters(model)) for agent, model in loaded.agents.items())


class Raises(BaseCallback):
    """
    Callback that raises an error, or sends Ctrl-C, at a given step.

    :param at: Number of the step, from 1
    :param error: The error. None for Ctrl-C
    """

    def __init__(self, at, error=None):
        super().__init__()
        self.at, self.error = at, error

    def _on_step(self):
        if self.n_calls == self.at:
            if self.error is not None:
                raise self.error
            os.kill(os.getpid(), signal.SIGINT)
        return True


class Cleans(PPO):
    """PPO that counts how often its ``finally`` block has run."""

    cleaned = 0

    def collect_rollouts(self, *args, **kwargs):
        try:
            return super().collect_rollouts(*args, **kwargs)
        finally:
            Cleans.cleaned += 1


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_an_agent_raises(tmp_path):
    Cleans.cleaned = 0
    env = make_team_env(partial(ToyEnv, n_agents=3), n_envs=2)
    team = Team(Cleans, "MlpPolicy", env, seed=0, **PPO_KWARGS)
    record, state = Record(), (th.get_rng_state(), th.is_grad_enabled())
    with pytest.raises(ZeroDivisionError, match="by hand") as caught:
        team.learn(64, callback=record, agent_callbacks={"agent_1": Raises(5, ZeroDivisionError("by hand"))})
    assert "agent 'agent_1'" in notes(caught.value) and "joint step 5" in notes(caught.value)
    assert record.steps == 4 and team.num_timesteps == 8
    assert Cleans.cleaned == 3
    assert th.equal(state[0], th.get_rng_state()) and state[1] == th.is_grad_enabled()
    works_again(team, tmp_path)


@pytest.mark.parametrize("who", ["agent_0", "agent_2", "team"])
def test_a_callback_stops_all_after_this_step(who, tmp_path):
    team = make_team()
    records = {name: Record(stop_at=11 if name == who else None) for name in ("agent_0", "agent_1", "agent_2", "team")}
    own = {agent: records[agent] for agent in team.possible_agents}
    team.learn(1000, callback=records["team"], agent_callbacks=own)
    assert {name: record.steps for name, record in records.items()} == dict.fromkeys(records, 11)
    assert all(record.events[-1] == "training end" for record in records.values())
    assert team.num_timesteps == 22 and {model.num_timesteps for model in team.agents.values()} == {22}
    # The environment made no further step: 11 steps are an episode of 7 and 4 steps of the next, in both copies
    assert team.get_env().get_attr("t") == [4, 4]
    # SB3 drops the step at which a callback stops, so further learning begins with new episodes
    record = Record(keep=("dones",))
    team.learn(32, reset_num_timesteps=False, callback=record)
    assert team.num_timesteps == 22 + 32
    assert [int(kept["dones"][0]) for kept in record.kept[:14]] == ([0] * 6 + [1]) * 2
    works_again(team, tmp_path)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
@pytest.mark.parametrize("who", ["agent_1", "team"])
def test_ctrl_c(who, vec_env, tmp_path):
    env = make_team_env(partial(ToyEnv, n_agents=3), n_envs=2, vec_env=vec_env)
    team = make_team(env)
    interrupt = Raises(13)
    with pytest.raises(KeyboardInterrupt) as caught:
        team.learn(
            64,
            callback=interrupt if who == "team" else None,
            agent_callbacks={"agent_1": interrupt if who == "agent_1" else None},
        )
    assert "joint step 13" in notes(caught.value)
    works_again(team, tmp_path)
    env.close()


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_ctrl_c_while_workers_step(tmp_path):
    """After Ctrl-C, results that the workers were still computing are not taken for those of a later step."""
    env = make_team_env(ToyEnv, n_envs=2, vec_env="subproc")
    team = make_team(env)
    await_steps, calls = env.venv._await_steps, []

    def interrupted():
        calls.append(1)
        if len(calls) == 6:
            os.kill(os.getpid(), signal.SIGINT)
        await_steps()

    env.venv._await_steps = interrupted
    with pytest.raises(KeyboardInterrupt):
        team.learn(64)
    # After an interruption new episodes begin, even if the number of steps is continued
    record = Record(keep=("infos", "dones"))
    team.learn(32, reset_num_timesteps=False, callback=record)
    assert [int(kept["dones"][0]) for kept in record.kept[:14]] == ([0] * 6 + [1]) * 2
    assert [kept["infos"][0]["episode"]["l"] for kept in record.kept if kept["dones"][0]][:2] == [7, 7]
    works_again(team, tmp_path)
    env.close()


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
def test_the_environment_fails(vec_env, tmp_path):
    env = make_team_env(partial(FaultyEnv, "raise"), n_envs=2, vec_env=vec_env)
    team = make_team(env)
    with pytest.raises(ArithmeticError, match="the toy broke") as caught:
        team.learn(1000)
    assert str(caught.value) == "the toy broke"
    assert "step() in environment copy 0 at step 3" in notes(caught.value)
    # It fails at the third step of the second episode, and the first has 7 steps
    assert "joint step 10" in notes(caught.value) and team.num_timesteps == 18
    env.close()
    team.set_env(make_team_env(ToyEnv, n_envs=2))
    works_again(team, tmp_path)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_a_worker_dies(tmp_path):
    env = make_team_env(ToyEnv, n_envs=2, vec_env="subproc")
    team = make_team(env)

    class Kill(BaseCallback):
        def _on_step(self):
            if self.n_calls == 9:
                os.kill(env.venv.processes[1].pid, signal.SIGKILL)
            return True

    with pytest.raises(RuntimeError, match=r"worker process 1 \(exit code -9\) died") as caught:
        team.learn(1000, callback=Kill())
    assert "joint step 10" in notes(caught.value)
    assert not any(process.is_alive() for process in env.venv.processes)
    team.set_env(make_team_env(ToyEnv, n_envs=2))
    works_again(team, tmp_path)


def test_a_fault_while_saving_keeps_the_old_file(tmp_path, monkeypatch):
    team = make_team()
    team.save(tmp_path / "team")
    old = (tmp_path / "team.zip").read_bytes()

    def fails(*args, **kwargs):
        raise OSError("disk full")

    monkeypatch.setattr(team.agents["agent_2"], "save", fails)
    with pytest.raises(OSError, match="disk full"):
        team.save(tmp_path / "team")
    assert (tmp_path / "team.zip").read_bytes() == old
    assert [path.name for path in tmp_path.iterdir()] == ["team.zip"]


def test_learn_within_learn_is_refused():
    team = make_team()
    errors = []

    class Inside(BaseCallback):
        def _on_step(self):
            for call in (lambda: team.learn(8), lambda: team.set_env(make_team_env(ToyEnv, n_envs=2))):
                try:
                    call()
                except RuntimeError as error:
                    errors.append(str(error))
            return False

    team.learn(64, callback=Inside())
    assert "learning already" in errors[0] and "while it learns" in errors[1]
    team.learn(16)


def test_an_agent_does_not_learn_alone():
    team = make_team()
    with pytest.raises(RuntimeError, match="only together with the others'"):
        team.agents["agent_0"].learn(8)
    team.learn(16)
    with pytest.raises(RuntimeError, match="call learn\\(\\) of the Team"):
        team.agents["agent_0"].learn(8, reset_num_timesteps=False)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_an_algorithm_that_resets_is_refused():
    class Resets(PPO):
        env: Any

        def train(self):
            self.env.reset()

    team = Team(Resets, "MlpPolicy", make_team_env(ToyEnv), seed=0, **PPO_KWARGS)
    with pytest.raises(RuntimeError, match="'agent_0' is reset only together with the others'"):
        team.learn(64)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_an_agent_that_will_not_stop():
    """An agent that acts while it is being stopped gets an error, and the error that is raised remains the first one."""

    class Clings(PPO):
        def collect_rollouts(self, env, *args, **kwargs):
            try:
                return super().collect_rollouts(env, *args, **kwargs)
            finally:
                env.step(np.zeros(2, int))

    env = make_team_env(ToyEnv, n_envs=2)
    classes = {"agent_0": PPO, "agent_1": Clings}
    team = Team(classes, "MlpPolicy", env, seed=0, **PPO_KWARGS)
    with pytest.raises(ZeroDivisionError) as caught:
        team.learn(64, agent_callbacks={"agent_0": Raises(3, ZeroDivisionError())})
    if sys.version_info >= (3, 11):
        assert "'agent_1', stopped because of this, raised RuntimeError" in notes(caught.value)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
def test_a_team_learns_on_when_a_copy_is_made_anew(vec_env, tmp_path):
    """Its agents bootstrap where the episode was cut, and the team's log counts it."""
    maker = partial(Troubled, "step", folder=str(tmp_path), times=2)
    env = make_team_env(maker, n_envs=2, vec_env=vec_env, restart_workers=2)
    team, record = make_team(env, log_dir=str(tmp_path)), Record(keep=("dones", "infos"))
    for model in team.agents.values():
        model.rollout_buffer.gamma = model.gamma = 0.5
    with th.no_grad():
        values = {agent: model.policy.value_net for agent, model in team.agents.items()}
        for net in values.values():
            net.weight.zero_()
            net.bias.fill_(8.0)
    team.learn(16, callback=record)
    broken = [kept["infos"][copy] for kept in record.kept for copy in (0, 1) if "worker_restarted" in kept["infos"][copy]]
    assert len(broken) == 2 and env.n_restarts == 2
    # No reward, and half of the value of the last observation
    rewards = [model.rollout_buffer.rewards for model in team.agents.values()]
    assert all((each == 4.0).sum() == 2 for each in rewards)
    rows = (tmp_path / "progress.csv").read_text().splitlines()
    logged = dict(zip(rows[0].split(","), rows[1].split(","), strict=True))
    assert logged["rollout/worker_restarts"] == "2" and logged["rollout/ep_len_mean"] != ""
    env.close()


def test_no_restarts_are_not_logged(tmp_path):
    make_team(log_dir=str(tmp_path)).learn(16)
    assert "restarts" not in (tmp_path / "progress.csv").read_text()
