"""What all worker processes of a team have in common."""

import multiprocessing
import select
import signal
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any


def start_context() -> Any:
    """
    :return: how processes are started: as SB3 does it. One that has trained must not be forked, since autograd has threads
    """
    return multiprocessing.get_context("forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn")


def leave_interrupts_to_main() -> None:
    """To be called in a worker: the terminal sends Ctrl-C to the whole group, but it is the main process that ends workers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


class Inbox:
    """
    Where the main process waits for what a worker sends.

    :param connection: to the worker
    :param process: the worker
    """

    def __init__(self, connection: Connection, process: Any) -> None:
        self._process = process
        self._arrives_within: Callable[[float], bool] = connection.poll
        if hasattr(select, "poll"):
            # Connection.poll() registers with the system at each call, which takes most of its time
            poll = select.poll()
            poll.register(connection.fileno(), select.POLLIN)
            self._arrives_within = lambda seconds: bool(poll.poll(1000 * seconds))

    def wait(self) -> None:
        """
        Wait until there is something to receive. Whether the death of a process closes its pipe depends on who else holds a
        copy of that (a process that the worker has started, say), so a plain ``recv()`` could wait for ever.

        :raises EOFError: if the worker is dead and has left nothing
        """
        while not self._arrives_within(1.0):
            if not self._process.is_alive() and not self._arrives_within(0.0):
                raise EOFError
