"""Starting worker processes and receiving from them, for environment copies and for learning agents alike."""

import multiprocessing
import select
import signal
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any


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


def leave_interrupts_to_main() -> None:
    """
    Ignore Ctrl-C in the calling worker process.

    The terminal sends the signal to all processes of the group, but the main process decides when its workers end.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)


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

    def wait(self) -> None:
        """
        Wait until there is a message to receive.

        The death of a worker does not always close its pipe, since another process, such as one that the worker has started,
        may hold a copy of it. A plain ``recv()`` could therefore wait for ever.

        :raises EOFError: If the worker is dead and all its messages have been received
        """
        while not self._readable_within(1.0):
            # The worker may have sent its last message after the first call and then died, hence the second call
            if not self._process.is_alive() and not self._readable_within(0.0):
                raise EOFError
