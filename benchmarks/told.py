"""A process of its own that does something each time it is told."""

from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from benchmarks.measure import Loop
from sb3_belief.common.processes import start_context


class Told:
    """
    :param make: called there, once; what it returns is done each time
    :param args: of it
    """

    def __init__(self, make: Callable[..., Loop], *args: Any) -> None:
        context = start_context()
        self._connection, there = context.Pipe()
        self._process = context.Process(target=_do_when_told, args=(there, make, args), daemon=True)
        self._process.start()
        there.close()

    def tell(self) -> None:
        """Let it begin."""
        self._connection.send_bytes(b"go")

    def steps(self) -> int:
        """
        :return: how many it has done, when it is done
        """
        return int(self._connection.recv_bytes())

    def end(self) -> None:
        """End the process."""
        self._connection.close()
        self._process.join()


def _do_when_told(connection: Connection, make: Callable[..., Loop], args: tuple) -> None:
    loop = make(*args)
    try:
        while True:
            connection.recv_bytes()
            connection.send_bytes(b"%d" % loop())
    except EOFError:
        pass
