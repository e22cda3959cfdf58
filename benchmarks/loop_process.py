"""A process of its own that runs a loop whenever it is asked to."""

from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from benchmarks.measure import Loop
from sb3_belief.common.processes import start_context


class LoopProcess:
    """
    Process in which a loop is made once and then run on request.

    :param make: Called in the process, returns the loop
    :param args: Arguments of ``make``
    """

    def __init__(self, make: Callable[..., Loop], *args: Any) -> None:
        context = start_context()
        self._connection, child_end = context.Pipe()
        self._process = context.Process(target=_serve, args=(child_end, make, args), daemon=True)
        self._process.start()
        child_end.close()

    def start(self) -> None:
        """Start one run of the loop, without waiting for it."""
        self._connection.send_bytes(b"run")

    def steps(self) -> int:
        """Wait for the run that was started, and return what the loop returned."""
        return int(self._connection.recv_bytes())

    def close(self) -> None:
        """End the process."""
        self._connection.close()
        self._process.join()


def _serve(connection: Connection, make: Callable[..., Loop], args: tuple) -> None:
    loop = make(*args)
    try:
        while True:
            connection.recv_bytes()
            connection.send_bytes(b"%d" % loop())
    except EOFError:
        # The other end was closed
        pass
