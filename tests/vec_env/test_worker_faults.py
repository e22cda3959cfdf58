"""What fails in an environment is told alike in this process and in workers, and a worker that hangs is never waited for."""

import os
import pickle
import signal
import subprocess
import sys
import time
import uuid
from functools import partial
from multiprocessing import Pipe
from typing import Any

import pytest

from sb3_belief.common.processes import WorkerError, WorkerTimeoutError
from sb3_belief.common.sent_errors import rebuilt_error
from sb3_belief.vec_env import worker_line, worker_loop
from tests.team.helpers import make_team_env
from tests.team.toy_envs import ToyEnv
from tests.vec_env import faulty_envs
from tests.vec_env.faulty_envs import OwnError, Troubled
from tests.vec_env.scripts import LINUX, gone_within, marked, run_script

ACTIONS = {"agent_0": [0, 0], "agent_1": [0, 0]}


@pytest.fixture(autouse=True)
def no_test_hangs():
    """End a test that takes far too long: all waits here can be interrupted."""

    def raise_error(*_):
        raise AssertionError("the test hangs")

    old = signal.signal(signal.SIGALRM, raise_error), signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.alarm(100)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, old[0])
    signal.signal(signal.SIGINT, old[1])


def notes(error):
    return " ".join(getattr(error, "__notes__", []))


def use(env, place):
    """Use an environment up to the place of its fault, and return what was raised there and how long that took."""
    env.reset()
    for _ in range(2):
        env.step(ACTIONS)
    started = time.monotonic()
    with pytest.raises(Exception) as caught:
        if place == "reset":
            env.reset()
        elif place == "step":
            env.step(ACTIONS)
        elif place == "render":
            env.get_images()
        elif place == "method":
            env.env_method("method")
        elif place == "attribute":
            env.get_attr("attribute")
        elif place == "close":
            env.close()
    return caught.value, time.monotonic() - started


def made(place, fault="own", **kwargs):
    """Two copies with a fault, where the first reset is good."""
    maker = partial(Troubled, place, fault, 2 if place == "reset" else 3, render_mode="rgb_array")
    return make_team_env(maker, n_envs=2, **kwargs)


SAID = {
    "reset": "reset() in environment copy 0 at reset",
    "step": "step() in environment copy 0 at step 3",
    "render": "render() in environment copy 0 at step 2",
    "method": "method() in environment copy 0 at step 2",
    "attribute": "attribute 'attribute' in environment copy 0 at step 2",
    "close": "close() in environment copy 0 at step 2",
}


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("place", SAID)
def test_an_error_is_the_same_from_a_worker(place):
    errors = {}
    for vec_env in ("dummy", "subproc"):
        env = made(place, vec_env=vec_env)
        errors[vec_env], _ = use(env, place)
        if place != "close":
            # Whoever has raised an error lives on
            assert env.get_attr("t") == [2, 2]
            env.close()
        if vec_env == "subproc":
            assert not any(process.is_alive() for process in env.venv.processes)
    for error in errors.values():
        assert type(error) is faulty_envs.OwnError and str(error) == "broken, 1 of 2"
        assert f"Raised by the environment's {SAID[place]}." in notes(error)
    assert errors["dummy"].__notes__ == errors["subproc"].__notes__
    cause = str(errors["subproc"].__cause__)
    assert "faulty_envs.py" in cause and "in maybe" in cause and "OwnError: broken, 1 of 2" in cause


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
@pytest.mark.parametrize(("place", "kind"), [("constructor", faulty_envs.OwnError), ("space", ValueError)])
def test_an_error_at_the_start(place, kind, vec_env):
    with pytest.raises(kind, match="broken, 1 of 2") as caught:
        made(place, vec_env=vec_env)
    assert "Raised when environment copy 0 was made." in notes(caught.value)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_an_error_in_the_second_copy_only(tmp_path):
    """The first copy's answer is not taken for that to a later command."""
    env = make_team_env(
        partial(Troubled, "method", copies=1, folder=str(tmp_path), limit=50), n_envs=3, vec_env="subproc", seed=0
    )
    actions = {agent: [0, 0, 0] for agent in env.possible_agents}
    env.reset()
    (faulty,) = [copy for copy, is_faulty in enumerate(env.get_attr("is_faulty")) if is_faulty]
    for t in range(1, 4):
        env.step(actions)
        with pytest.raises(faulty_envs.OwnError) as caught:
            env.env_method("method")
        assert f"in environment copy {faulty} at step {t}" in notes(caught.value)
        assert env.get_attr("t") == [t] * 3
        assert env.env_method("method", indices=[copy for copy in range(3) if copy != faulty]) == [t] * 2
    env.close()


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
def test_the_environment_can_go_on_after_an_error(vec_env):
    env = made("step", vec_env=vec_env, seed=3)
    first = env.reset()
    for _ in range(2):
        env.step(ACTIONS)
    with pytest.raises(faulty_envs.OwnError):
        env.step(ACTIONS)
    env.seed(3)
    again = env.reset()
    assert all((first[agent] == again[agent]).all() for agent in first)
    env.step(ACTIONS)
    assert env.get_attr("t") == [1, 1]
    env.close()


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize(
    ("fault", "kind", "message"),
    [
        ("key", KeyError, "'fuel'"),
        ("two parts", RuntimeError, "TwoPartsError: smoke at the rear"),
        ("code", RuntimeError, "CodeError: code 7"),
        ("lock", RuntimeError, "OwnError: with a lock"),
    ],
)
def test_errors_that_cannot_be_rebuilt_are_named(fault, kind, message):
    env = made("step", fault, vec_env="subproc")
    error, _ = use(env, "step")
    assert type(error) is kind and str(error) == message
    assert SAID["step"] in notes(error) and "faulty_envs.py" in str(error.__cause__)
    env.close()


def test_an_error_is_never_taken_for_a_row():
    """Rows are known by their length."""

    class Packer:
        size = 0

        def pack(self, *_):
            raise OwnError("as long as a row")

    env = make_team_env(ToyEnv).venv.envs[0]
    env.reset()
    channel: Any = worker_loop._Channel(Pipe()[0], env)
    channel._packer = Packer()
    message = worker_loop.STEP + pickle.dumps((0, 0))
    Packer.size = len(channel._step(message))
    answer = channel._step(message)
    assert len(answer) != Packer.size and answer.endswith(worker_loop.FAILED)
    assert str(rebuilt_error(pickle.loads(answer))) == "as long as a row"


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_errors_of_the_users_script_keep_their_class(tmp_path):
    """Classes of a script are another's in a worker, which imports the script under another name."""
    script = """
        class Mine(Exception): pass
        class Env(ToyEnv):
            def step(self, actions): raise Mine("of the script")
        if __name__ == "__main__":
            env = make_team_env(Env, vec_env="subproc")
            env.reset()
            try:
                env.step({"agent_0": [0], "agent_1": [0]})
            except Mine as error:
                print("caught", error)
            env.close()
    """
    assert run_script(script, tmp_path).communicate(timeout=40)[0] == "caught of the script\n"


COMMANDS = {"reset": "reset() within 0.5 s", "step": "step() within 0.5 s", "render": "render() within 0.5 s"}
COMMANDS |= {"method": "env_method() within 0.5 s", "attribute": "get_attr() within 0.5 s"}


@pytest.mark.parametrize("place", COMMANDS)
def test_a_worker_that_hangs_is_ended(place):
    env = made(place, "hang", vec_env="subproc", step_timeout=0.5)
    processes = list(env.venv.processes)
    error, seconds = use(env, place)
    assert isinstance(error, WorkerTimeoutError) and isinstance(error, WorkerError) and isinstance(error, TimeoutError)
    assert 0.5 <= seconds < 1.5
    at = {"reset": "at reset", "step": "at step 3"}.get(place, "at step 2")
    for copy in (0, 1) if place in ("reset", "step") else (0,):
        told = f"worker process {copy} did not answer {COMMANDS[place]} and was ended in environment copy {copy} {at}"
        assert told in str(error)
    assert not any(process.is_alive() for process in processes)
    with pytest.raises(RuntimeError, match="the environment is closed"):
        env.step(ACTIONS)
    env.close()


def test_a_slow_start_is_no_fault(monkeypatch):
    """A worker's first answer has a limit of its own."""

    def make():
        time.sleep(0.6)
        return Troubled("nowhere")

    env = make_team_env(make, n_envs=2, vec_env="subproc", step_timeout=0.3)
    env.reset()
    env.close()
    monkeypatch.setattr(worker_line, "START_TIMEOUT", 0.5)
    with pytest.raises(WorkerTimeoutError, match=r"did not answer get_spaces\(\) within 0.5 s"):
        make_team_env(partial(Troubled, "constructor", "hang"), n_envs=2, vec_env="subproc", step_timeout=0.3)


def interrupted(seconds):
    """Send Ctrl-C to this process after a while."""
    code = f"import os, signal, time; time.sleep({seconds}); os.kill({os.getpid()}, signal.SIGINT)"
    return subprocess.Popen([sys.executable, "-c", code])


@pytest.mark.parametrize("fault", ["hang", "busy"])
@pytest.mark.parametrize("place", ["step", "reset", "method"])
def test_ctrl_c_and_close_do_not_wait_for_a_worker_that_hangs(place, fault):
    env = made(place, fault, vec_env="subproc")
    processes = list(env.venv.processes)
    with interrupted(0.5), pytest.raises(KeyboardInterrupt):
        use_until_it_hangs(env, place)
    started = time.monotonic()
    env.close()
    assert time.monotonic() - started < 3
    assert not any(process.is_alive() for process in processes)


def use_until_it_hangs(env, place):
    env.reset()
    for _ in range(2):
        env.step(ACTIONS)
    {"step": lambda: env.step(ACTIONS), "reset": env.reset, "method": lambda: env.env_method("method")}[place]()


def test_a_hang_that_was_interrupted_is_not_waited_for_again():
    """Whoever asks the environment something else after Ctrl-C does not have to press it again."""
    env = made("step", "hang", vec_env="subproc")
    with interrupted(0.5), pytest.raises(KeyboardInterrupt):
        use_until_it_hangs(env, "step")
    started = time.monotonic()
    with pytest.raises(WorkerTimeoutError, match=r"did not answer step\(\) in time"):
        env.get_attr("t")
    assert time.monotonic() - started < 3.5
    assert not any(process.is_alive() for process in env.venv.processes)


def test_an_environment_that_hangs_in_close():
    env = made("close", "hang", vec_env="subproc")
    env.reset()
    started = time.monotonic()
    env.close()
    assert 2.5 < time.monotonic() - started < 4.5
    assert not any(process.is_alive() for process in env.venv.processes)


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="Windows has no such signals")
def test_workers_leave_signals_to_the_main_process():
    """A scheduler sends them to all processes, and the main process needs its workers to end well."""
    env = made("nowhere", vec_env="subproc")
    env.reset()
    for process in env.venv.processes:
        for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
            os.kill(process.pid, number)
        assert os.getpgid(process.pid) == process.pid
    env.step(ACTIONS)
    assert env.get_attr("t") == [1, 1]
    env.close()


@pytest.mark.parametrize("value", [0, -1, float("nan"), float("inf"), True, "1"])
def test_step_timeout_is_a_time(value):
    with pytest.raises(ValueError, match="positive number of seconds"):
        make_team_env(Troubled, vec_env="subproc", step_timeout=value)


def test_step_timeout_needs_workers():
    with pytest.raises(ValueError, match="needs vec_env='subproc'"):
        make_team_env(Troubled, step_timeout=1.0)


# Whole processes


SCRIPTS: dict[str, Any] = {
    "steps": ("Troubled, 'nowhere'", "while True: env.step(actions)", ["SIGKILL"]),
    "sleeps in a step": ("Troubled, 'step', 'hang'", "while True: env.step(actions)", ["SIGKILL", "SIGINT"]),
    "hangs in C": ("WithChild, 'step', 'busy'", "while True: env.step(actions)", ["SIGKILL", "SIGINT"]),
    "is idle": ("WithChild, 'nowhere'", "time.sleep(1000)", ["SIGTERM"]),
    "hangs in close": ("Troubled, 'close', 'hang'", "env.close()", ["SIGINT"]),
}


@LINUX
@pytest.mark.parametrize(("case", "name"), [(case, name) for case, (_, _, names) in SCRIPTS.items() for name in names])
def test_no_process_stays(case, name, tmp_path):
    """Whatever ends the main process, and whatever its workers and what these have started are at."""
    maker, what, _ = SCRIPTS[case]
    marker = uuid.uuid4().hex
    script = f"""
        if __name__ == "__main__":
            signal.signal(signal.SIGINT, signal.default_int_handler)
            env = make_team_env(partial({maker}), n_envs=2, vec_env="subproc")
            actions = {{agent: [0, 0] for agent in env.possible_agents}}
            env.reset()
            print("ready", flush=True)
            {what}
    """
    process = run_script(script, tmp_path, marker)
    try:
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
        time.sleep(0.3)
        assert len(marked(marker)) >= 3
        process.send_signal(getattr(signal, name))
        started = time.monotonic()
        process.wait(timeout=10)
        assert time.monotonic() - started < 5
        assert gone_within(30.0, marker) == []
    finally:
        for pid, _ in marked(marker):
            os.kill(pid, signal.SIGKILL)
        process.stdout.close()
