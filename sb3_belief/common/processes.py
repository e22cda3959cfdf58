"""Starting, ending and hearing from worker processes, for environment copies and for learning agents alike."""

# What signal itself is made of: signal's functions convert to enumerations, which takes ten times as long as all else they do
import _signal
import multiprocessing
import multiprocessing.connection
import multiprocessing.util
import os
import select
import signal
import sys
import threading
import time
import weakref
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

if sys.platform != "win32":
    import fcntl
    from multiprocessing import forkserver

#: Seconds that a worker gets to finish what it is at before it is killed, and how many times what it took at most so far
PATIENCE, PATIENCE_FACTOR = 2.0, 3.0
#: What worker processes import, the second because torch does when the first optimizer is made
WORKERS_NEED = ["sb3_belief.team", "torch._dynamo"]
# Signals that ask a process to end. The main process decides what they mean for its workers
_END_SIGNALS = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
_ASKING = [int(number) for number in (signal.SIGINT, *_END_SIGNALS)]
_started: "weakref.WeakSet[Any]" = weakref.WeakSet()
# Numbers of processes that kill their workers at their end
_kill_at_exit: set[int] = set()


class WorkerError(RuntimeError):
    """A worker process has died, or has been ended because it did not answer."""


class WorkerTimeoutError(WorkerError, TimeoutError):
    """A worker process did not answer in time, and has been ended."""


def start_context() -> Any:
    """
    Return the ``multiprocessing`` context that starts workers, chosen as SB3 chooses it.

    A process that has trained must not be forked, because autograd has started threads in it.

    :return: The context of "forkserver" where the system has it, otherwise of "spawn"
    """
    return multiprocessing.get_context("forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn")


def check_may_have_workers(what: str, instead: str) -> None:
    """
    Check that this process may start others.

    :param what: What needs them, for the message
    :param instead: What needs none
    :raises ValueError: If it is daemonic, as the workers of ``multiprocessing.Pool`` are
    """
    if multiprocessing.current_process().daemon:
        raise ValueError(
            f"{what} starts processes, which a daemonic process, such as a worker of multiprocessing.Pool, may not have: use"
            f" {instead} in it, or start it by concurrent.futures.ProcessPoolExecutor, whose workers may."
        )


def _preload() -> None:
    """
    Have the server from which workers are forked import what they need, beside what the program has it import.

    Otherwise each of them imports that by itself: on two busy cores a short run with eight copies in processes and two jobs
    took 98 s instead of 34, and with two copies it made no difference. A server that runs already stays as it is.
    """
    if sys.platform == "win32":
        return
    modules = getattr(forkserver._forkserver, "_preload_modules", ["__main__"])
    multiprocessing.set_forkserver_preload([*modules, *(name for name in WORKERS_NEED if name not in modules)])


def start_worker(target: Callable[..., None], args: tuple[Any, ...], name: str | None = None) -> Any:
    """
    Start a worker, which is killed at the latest when this process ends.

    :param target: What it runs; it begins with :func:`become_worker`
    :param args: Arguments of ``target``
    :param name: Name of the process
    :return: The ``multiprocessing`` process
    """
    _preload()
    process = start_context().Process(target=target, args=args, name=name, daemon=True)
    process.start()
    _started.add(process)
    _kill_all_at_exit()
    return process


def become_worker() -> None:
    """
    Make the calling process a worker: it leaves signals to its parent, and ends with it.

    A terminal or a scheduler sends signals to all processes of a group or a job, but the parent decides when its workers end:
    it closes their pipe, or kills them. A worker leads a process group of its own, so that what it has started is killed with
    it.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for number in _END_SIGNALS:
        # Not SIG_IGN: processes that the worker starts would inherit that, and could not be ended by the signal either
        signal.signal(number, lambda *_: None)
        if hasattr(signal, "siginterrupt"):
            signal.siginterrupt(number, False)
    if hasattr(os, "setpgrp"):
        os.setpgrp()
    # Those that are forked from one server would all draw the same
    np.random.seed()
    _end_with_parent()


def _end_with_parent() -> None:
    """Have this process and its group killed when its parent has ended, however that ended."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return
    # Of a pipe whose other end the parent holds. Its operating system parent may be another process, the fork server
    sentinel = parent.sentinel
    threading.Thread(target=_end_after, args=(sentinel,), name="ends-with-parent", daemon=True).start()
    if hasattr(os, "setpgrp") and hasattr(os, "O_ASYNC") and hasattr(fcntl, "F_SETSIG"):
        # The thread needs Python's lock, which code that hangs may hold. On Linux the kernel itself can watch the pipe
        with suppress(OSError):
            fcntl.fcntl(sentinel, fcntl.F_SETOWN, -os.getpgrp())
            fcntl.fcntl(sentinel, fcntl.F_SETSIG, signal.SIGKILL)
            fcntl.fcntl(sentinel, fcntl.F_SETFL, fcntl.fcntl(sentinel, fcntl.F_GETFL) | os.O_ASYNC)


def _end_after(sentinel: int) -> None:
    multiprocessing.connection.wait([sentinel])
    if hasattr(os, "killpg") and os.getpgrp() == os.getpid():
        os.killpg(0, signal.SIGKILL)
    os._exit(1)


def kill_workers(processes: Iterable[Any]) -> None:
    """
    Kill workers and what they have started, without a long wait whatever they do.

    :param processes: As :func:`start_worker` returned them
    """
    processes = list(processes)
    for process in processes:
        # Not only of one that lives: what it has started may have outlived it
        if hasattr(os, "killpg"):
            with suppress(OSError):
                os.killpg(process.pid, signal.SIGKILL)
        process.kill()
    deadline = time.monotonic() + 2.0
    for process in processes:
        process.join(max(deadline - time.monotonic(), 0.0))
        _started.discard(process)


def join_workers(processes: Iterable[Any], seconds: float) -> None:
    """
    Wait for workers that have been told to end, and kill those that do not.

    :param processes: As :func:`start_worker` returned them
    :param seconds: How long to wait for all of them together
    """
    deadline = time.monotonic() + seconds
    late = []
    for process in processes:
        process.join(max(deadline - time.monotonic(), 0.0))
        # Nobody tells of the end of one whose fork server is gone
        while not is_dead(process) and time.monotonic() < deadline:
            time.sleep(0.02)
        if is_dead(process):
            _started.discard(process)
        else:
            late.append(process)
    kill_workers(late)


def _kill_all() -> None:
    kill_workers(process for process in list(_started) if not is_dead(process))


def _kill_all_at_exit() -> None:
    """
    Have all workers killed when this process ends.

    At the end ``multiprocessing`` asks its processes to end, which workers ignore, and waits for them without a limit. Its own
    finalisers of a priority run before, also in its processes, where functions of ``atexit`` do not run. A forked child, which
    has a copy of the set, must not end its parent's workers: there they do not run.
    """
    if os.getpid() not in _kill_at_exit:
        _kill_at_exit.add(os.getpid())
        multiprocessing.util.Finalize(None, _kill_all, exitpriority=100)


def patience(longest: float) -> float:
    """
    Return how many seconds to wait for a worker that may be slow, or may hang.

    :param longest: Seconds that it took at most for an answer so far
    """
    return max(PATIENCE, PATIENCE_FACTOR * longest)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """
    Delay what Ctrl-C and signals that ask to end do until the end of the block.

    A mask would not do: another thread, such as one of PyTorch's, would take the signal, and the main thread act upon it.
    """
    if threading.current_thread() is not threading.main_thread():
        # Signals are the main thread's
        yield
        return
    came: list[tuple[int, Any]] = []
    handlers = {number: handler for number in _ASKING if callable(handler := _signal.getsignal(number))}
    for number in handlers:
        _signal.signal(number, lambda *args: came.append(args))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            _signal.signal(number, handler)
        for args in came:
            handlers[args[0]](*args)


class Inbox:
    """
    The main process's end of the pipe to a worker, which can wait for a message without waiting for a dead worker.

    :param connection: Connection to the worker
    :param process: The worker, a ``multiprocessing`` process
    """

    def __init__(self, connection: Connection, process: Any) -> None:
        self._process = process
        self._readable_within: Callable[[float], bool] = connection.poll
        if hasattr(select, "poll"):
            # Connection.poll() spends most of its time on registering the connection anew at each call, so it is registered
            # once here. Windows has no select.poll and keeps Connection.poll()
            poll = select.poll()
            poll.register(connection.fileno(), select.POLLIN)
            self._readable_within = lambda seconds: bool(poll.poll(1000 * seconds))

    def wait(self, deadline: float | None = None) -> bool:
        """
        Wait until there is a message to receive.

        The death of a worker does not always close its pipe, since another process, such as one that the worker has started,
        may hold a copy of it. A plain ``recv()`` could therefore wait for ever.

        :param deadline: When to give up, by ``time.monotonic()``; None to wait without a limit
        :return: Whether there is a message. False at the deadline
        :raises EOFError: If the worker is dead and all its messages have been received
        """
        while not self._readable_within(1.0 if deadline is None else min(1.0, max(deadline - time.monotonic(), 0.0))):
            # The worker may have sent its last message after the first call and then died, hence the second call
            if is_dead(self._process) and not self._readable_within(0.0):
                raise EOFError
            if deadline is not None and time.monotonic() >= deadline:
                return False
        return True


def is_dead(process: Any) -> bool:
    """
    Return whether a worker has ended.

    :param process: As :func:`start_worker` returned it
    """
    if process.is_alive():
        return False
    if process.exitcode != 255 or os.name != "posix":
        return True
    # The fork server, which tells when its children end, may itself have been ended by a signal to the process group
    try:
        os.kill(process.pid, 0)
    except OSError:
        return True
    return False
