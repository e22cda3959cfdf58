"""Processes in which agents learn: none that hangs is waited for, and agents that are lost with one are not hidden."""

import multiprocessing
import os
import signal
import time
import uuid
from contextlib import suppress

import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import CheckpointCallback

from sb3_belief.common.processes import WorkerError
from sb3_belief.team.parallel import workers
from tests.team.helpers import PPO_KWARGS, Team, parameters
from tests.team.parallel.test_jobs import no_processes_stay, notes, toy_team
from tests.team.toy_envs import ToyEnv
from tests.vec_env.scripts import LINUX, WITH_WORKERS, gone_within, marked, run_script
from tests.vec_env.test_worker_faults import no_test_hangs  # noqa: F401 (a fixture)

SMALL = {**PPO_KWARGS, "batch_size": 16}
pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")


class Fails(PPO):
    """
    Does something in an update.

    :param at: Number of the update; None for never
    :param what: "kill" to kill the process, "hang" to send Ctrl-C to the main process and hang, "slow" to take a second then
    """

    def __init__(self, *args, at=None, what="kill", **kwargs):
        self.at, self.what, self.updates = at, what, 0
        super().__init__(*args, **kwargs)

    def train(self):
        self.updates += 1
        if self.updates == self.at:
            if self.what == "kill":
                os.kill(os.getpid(), signal.SIGKILL)
            # Ctrl-C, while it does not answer
            parent = multiprocessing.parent_process()
            assert parent is not None and parent.pid is not None
            os.kill(parent.pid, signal.SIGINT)
            time.sleep(1000 if self.what == "hang" else 1.0)
        super().train()


def failing(what, at=2, **kwargs):
    """A team of two, whose first agent learns in another process and fails there in its second update."""
    return toy_team(Fails, 2, **SMALL, agent_kwargs={"agent_0": {"at": at, "what": what}}, **kwargs)


def test_agents_that_are_behind_are_named_and_not_saved(tmp_path):
    team = failing("kill")
    before = parameters(team.agents["agent_0"])
    with pytest.raises(WorkerError, match=r"process 0 .* died while it was busy with agent_0") as caught:
        team.learn(64)
    said = "as they were before are 'agent_0' at step 0; as far as they came are 'agent_1' at step 32"
    assert said in notes(caught.value)
    assert th.equal(before, parameters(team.agents["agent_0"]))
    refused = [lambda: team.save(tmp_path / "team"), lambda: team.learn(16, reset_num_timesteps=False)]
    for call in refused:
        with pytest.raises(ValueError, match="not equally far") as error:
            call()
        assert said in str(error.value) and "load the last checkpoint" in str(error.value)
        assert "reset_num_timesteps=True" in str(error.value)
    assert list(tmp_path.iterdir()) == []
    team.agents["agent_0"].at = None
    # It may begin a new training
    team.learn(32)
    team.save(tmp_path / "team")
    loaded = Team.load(tmp_path / "team", allow_packages=("tests",))
    assert [model.num_timesteps for model in loaded.agents.values()] == [32, 32]


def test_all_agents_of_a_dead_worker_are_named():
    team = toy_team(Fails, 2, env_id=three_agents, **SMALL, agent_kwargs={"agent_0": {"at": 2}})
    with pytest.raises(WorkerError, match=r"process 0 .* died while it was busy with agent_0, agent_2") as caught:
        team.learn(64)
    assert "'agent_0' at step 0, 'agent_2' at step 0; as far as they came are 'agent_1' at step 32" in notes(caught.value)
    assert no_processes_stay()


def three_agents():
    return ToyEnv(3)


def test_agents_are_behind_only_since_their_models_were_last_here(tmp_path):
    """A checkpoint brings them here, so the step of the checkpoint is what is left of them."""
    team = failing("kill", at=3)
    with pytest.raises(WorkerError) as caught:
        team.learn(96, callback=CheckpointCallback(16, str(tmp_path)))
    assert "'agent_0' at step 32; as far as they came are 'agent_1' at step 48" in notes(caught.value)


def test_a_team_that_lost_nothing_is_saved(tmp_path, monkeypatch):
    """A worker that dies before it has learned anything, and an error that travels with the models."""
    team = failing("kill", at=None)
    whole = workers.Workers.send

    def dies(self, number, content, agents):
        os.kill(self._all[number].process.pid, signal.SIGKILL)
        self._all[number].process.join(5)
        whole(self, number, content, agents)

    monkeypatch.setattr(workers.Workers, "send", dies)
    with pytest.raises(WorkerError) as caught:
        team.learn(16)
    assert "not equally far" not in notes(caught.value)
    monkeypatch.undo()
    team.save(tmp_path / "team")
    team.learn(16, reset_num_timesteps=False)


def test_an_update_that_hangs_is_not_waited_for_after_ctrl_c(tmp_path):
    team, sent = failing("hang"), list[float]()

    def interrupt(*_):
        sent.append(time.monotonic())
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, interrupt)
    with pytest.raises(KeyboardInterrupt) as caught:
        team.learn(64)
    assert time.monotonic() - sent[0] < 3.5
    assert no_processes_stay()
    assert "'agent_0' at step 0" in notes(caught.value)
    with pytest.raises(ValueError, match="not equally far"):
        team.save(tmp_path / "team")


def test_an_update_that_takes_its_time_is_waited_for_after_ctrl_c(tmp_path):
    team = failing("slow")
    with pytest.raises(KeyboardInterrupt):
        team.learn(64)
    assert no_processes_stay()
    assert team.agents["agent_0"].updates == 2 and team.agents["agent_0"].num_timesteps == 32
    team.save(tmp_path / "team")


def test_how_long_a_worker_is_waited_for():
    """Thrice as long as it took at most, and at least two seconds."""
    team = toy_team(PPO, 2, **SMALL).learn(32)
    (worker,) = team._parallel._workers._all
    assert 0 < worker.longest < 0.6
    now = time.monotonic()
    assert now + 1.9 < team._parallel._workers.deadline() < now + 2.5
    worker.longest = 20.0
    assert now + 59 < team._parallel._workers.deadline() < now + 61


SCRIPTS = {
    "learns": ("ToyEnv", "PPO"),
    "hangs in a step": ("partial(Troubled, 'step', 'hang')", "PPO"),
    "hangs in an update": ("ToyEnv", "Hangs"),
}


@LINUX
@pytest.mark.parametrize("case", SCRIPTS)
def test_no_process_stays_after_kill_9(case, tmp_path):
    maker, algorithm = SCRIPTS[case]
    marker = uuid.uuid4().hex
    script = f"""
        from stable_baselines3 import PPO
        class Hangs(PPO):
            def train(self): time.sleep(1000)
        if __name__ == "__main__":
            env = make_team_env({maker}, n_envs=2, vec_env="subproc")
            team = Team({algorithm}, "MlpPolicy", env, jobs=2, n_steps=8, batch_size=8, device="cpu")
            print("ready", flush=True)
            team.learn(10**9)
    """
    process = run_script(script, tmp_path, marker, head=WITH_WORKERS)
    assert process.stdout is not None
    try:
        assert process.stdout.readline() == "ready\n"
        deadline = time.monotonic() + 120
        # This process, two copies, one worker, and those of multiprocessing
        while len(marked(marker)) < 6 and time.monotonic() < deadline:
            time.sleep(0.1)
        time.sleep(1.0)
        assert len(marked(marker)) >= 6
        process.kill()
        process.wait(timeout=10)
        assert gone_within(30.0, marker) == []
    finally:
        for pid, _ in marked(marker):
            with suppress(OSError):
                os.kill(pid, signal.SIGKILL)
        process.stdout.close()
