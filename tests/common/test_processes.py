"""Worker processes: they end with their parent, and signals wait until a message is whole."""

import os
import signal
import sys
import threading
import time
import uuid
from multiprocessing import forkserver

import numpy as np
import pytest

from sb3_belief.common import processes
from sb3_belief.common.processes import Inbox, is_dead, kill_workers, patience, start_context, start_worker, uninterrupted
from tests.vec_env.scripts import LINUX, gone_within, marked, run_script
from tests.vec_env.test_worker_faults import no_test_hangs  # noqa: F401 (a fixture)


@LINUX
@pytest.mark.parametrize("method", ["forkserver", "spawn"])
@pytest.mark.parametrize("way", ["kernel", "thread"])
def test_a_worker_ends_with_its_parent(way, method, tmp_path):
    """The kernel watches the parent and, where it cannot, a thread does."""
    marker = uuid.uuid4().hex
    script = f"""
        import multiprocessing, subprocess
        from sb3_belief.common import processes
        def work():
            if "{way}" == "thread":
                processes.fcntl = object()
            else:
                processes._end_after = lambda sentinel: None
            processes.become_worker()
            subprocess.Popen([sys.executable, "-c", "import time; time.sleep(1000)"])
            print("ready", flush=True)
            time.sleep(1000)
        if __name__ == "__main__":
            multiprocessing.get_context("{method}").Process(target=work, daemon=True).start()
            time.sleep(1000)
    """
    process = run_script(script, tmp_path, marker, head="")
    assert process.stdout is not None
    try:
        assert process.stdout.readline() == "ready\n"
        # The script, the worker, its child, and multiprocessing's own
        assert len(marked(marker)) >= 4
        process.kill()
        process.wait(timeout=10)
        assert gone_within(30.0, marker) == []
    finally:
        for pid, _ in marked(marker):
            os.kill(pid, signal.SIGKILL)
        process.stdout.close()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("by_another_thread", [False, True])
def test_a_signal_waits_until_the_message_is_whole(number, by_another_thread):
    came = []

    def handler(*args):
        came.append(args[0])
        raise KeyboardInterrupt

    old = signal.signal(number, handler)
    stop = threading.Event()
    # Of two threads, either may be the one that takes a signal to the process
    other = threading.Thread(target=stop.wait, daemon=True)
    other.start()
    reached: list[object] = []
    try:
        with pytest.raises(KeyboardInterrupt):
            with uninterrupted():
                if by_another_thread:
                    signal.pthread_kill(other.ident, number)  # type: ignore[arg-type]
                else:
                    os.kill(os.getpid(), number)
                deadline = time.monotonic() + 0.1
                while time.monotonic() < deadline:
                    time.sleep(0.01)
                reached.append(len(came))
            reached.append("after")
        assert reached == [0] and came == [number]
        assert signal.getsignal(number) is handler
    finally:
        stop.set()
        signal.signal(number, old)


def test_in_other_threads_signals_are_left_alone():
    results = []

    def run():
        with uninterrupted():
            results.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert results == [signal.getsignal(signal.SIGINT)]


def answers_late(connection):
    processes.become_worker()
    connection.recv()
    time.sleep(0.3)
    connection.send("late")
    connection.recv()


def draws(connection):
    processes.become_worker()
    connection.send(np.random.random())


def test_workers_do_not_draw_the_same_numbers():
    """Environments that have no seed of their own, or do not use it, would be copies of each other."""
    drawn = []
    for _ in range(2):
        here, there = start_context().Pipe()
        process = start_worker(draws, (there,))
        there.close()
        drawn.append(here.recv())
        process.join()
    assert drawn[0] != drawn[1]


def test_an_inbox_waits_until_a_deadline():
    here, there = start_context().Pipe()
    process = start_worker(answers_late, (there,))
    there.close()
    inbox = Inbox(here, process)
    here.send("go")
    started = time.monotonic()
    assert inbox.wait(started + 10) and here.recv() == "late"
    started = time.monotonic()
    assert not inbox.wait(started + 0.2)
    assert 0.2 <= time.monotonic() - started < 0.6
    kill_workers([process])
    assert is_dead(process)
    with pytest.raises(EOFError):
        # The end of the pipe is readable
        inbox.wait(time.monotonic() + 5)
        here.recv()


@pytest.mark.skipif(sys.platform == "win32", reason="there is no fork server")
def test_workers_live_without_their_fork_server():
    """A signal to the whole process group ends it, and it alone knows when its children end."""
    here, there = start_context().Pipe()
    process = start_worker(answers_late, (there,))
    there.close()
    here.send("go")
    assert here.recv() == "late"
    os.kill(forkserver._forkserver._forkserver_pid, signal.SIGKILL)  # type: ignore[attr-defined]
    deadline = time.monotonic() + 5
    while process.is_alive() and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not process.is_alive() and not is_dead(process)
    here.send("end")
    while not is_dead(process) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert is_dead(process)


def test_patience_grows_with_what_took_long():
    assert patience(0.0) == patience(0.6) == 2.0
    assert patience(20.0) == 60.0


@LINUX
@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_a_process_of_multiprocessing_ends_with_workers_that_it_still_holds(method, tmp_path):
    """It would otherwise ask them to end by a signal that they ignore, and wait for ever."""
    marker = uuid.uuid4().hex
    script = f"""
        import multiprocessing
        from sb3_belief.common import processes
        held = []
        def work(connection):
            # Imported once for all, not by each
            imported = "torch._dynamo" in sys.modules
            processes.become_worker()
            connection.send(imported)
            time.sleep(1000)
        def train():
            here, there = multiprocessing.Pipe()
            held.append(processes.start_worker(work, (there,)))
            assert here.recv() is True
        if __name__ == "__main__":
            process = multiprocessing.get_context("{method}").Process(target=train)
            process.start()
            process.join(60)
            print(process.exitcode, flush=True)
            process.kill()
    """
    process = run_script(script, tmp_path, marker, head="")
    assert process.communicate(timeout=120)[0] == "0\n"
    assert process.returncode == 0
    assert not gone_within(30, marker)
