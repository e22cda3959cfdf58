"""What all worker processes of a team have in common."""

import multiprocessing
import signal
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


def await_message(connection: Connection, process: Any) -> None:
    """
    Wait until there is something to receive. Whether the death of a process closes its pipe depends on the start method
    (forked siblings hold copies of it), so a plain ``recv()`` could wait for ever.

    :param connection: to a worker
    :param process: the worker
    :raises EOFError: if it is dead and has left nothing
    """
    while not connection.poll(1.0):
        if not process.is_alive() and not connection.poll(0):
            raise EOFError
