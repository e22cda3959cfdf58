"""The worker processes of a team: started when they are needed, ended with it."""

import os
import weakref
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

from sb3_belief.common.processes import Inbox, start_context
from sb3_belief.team.parallel.messages import receive, send
from sb3_belief.team.parallel.worker_server import serve


@dataclass
class _Worker:
    """
    A worker process as the main process knows it.

    :param process: The process
    :param connection: To the process
    :param inbox: Of that connection
    :param busy_with: The agents of the last command, for messages
    """

    process: Any
    connection: Connection
    inbox: Inbox
    busy_with: str = ""


class Workers:
    """Processes in which agents learn. They end with the last reference to this object."""

    def __init__(self) -> None:
        self._all: list[_Worker] = []
        weakref.finalize(self, _end, self._all, os.getpid())

    def start(self, n: int) -> None:
        """
        Start workers, if there are not enough.

        :param n: How many are needed
        """
        if any(not worker.process.is_alive() for worker in self._all):
            self.end()
        context = start_context()
        for i in range(len(self._all), n):
            here, there = context.Pipe()
            process = context.Process(target=serve, args=(there,), name=f"team-worker-{i}", daemon=True)
            process.start()
            there.close()
            self._all.append(_Worker(process, here, Inbox(here, process)))

    def send(self, number: int, content: Any, agents: str) -> None:
        """
        Send a command to a worker.

        :param number: Number of the worker
        :param content: The command
        :param agents: Names of the agents that it is about
        :raises RuntimeError: If the worker is dead
        """
        worker = self._all[number]
        worker.busy_with = agents
        try:
            send(worker.connection, content)
        except OSError as error:
            raise self._death(number) from error
        except BaseException:
            self._lose(number)
            raise

    def receive(self, number: int) -> Any:
        """
        Wait for a worker's answer.

        :param number: Number of the worker
        :return: The answer
        :raises RuntimeError: If the worker died
        """
        worker = self._all[number]
        try:
            worker.inbox.wait()
        except (EOFError, OSError) as error:
            raise self._death(number) from error
        try:
            return receive(worker.connection)
        except (EOFError, OSError) as error:
            raise self._death(number) from error
        except BaseException:
            self._lose(number)
            raise

    def _lose(self, number: int) -> None:
        """
        Give up a worker after a message was cut off, by Ctrl-C for instance: the next one could not be found in the pipe.
        """
        self._all[number].connection.close()
        self._all[number].process.terminate()

    def _death(self, number: int) -> RuntimeError:
        worker = self._all[number]
        # It may need a moment to end
        worker.process.join(1.0)
        return RuntimeError(
            f"Worker process {number} (exit code {worker.process.exitcode}) died while it was busy with {worker.busy_with};"
            " see its own error above, if it could write one. Models that learned in it are what they were before learn(),"
            " or when they were last saved or evaluated. The next learn() starts new workers; with jobs=1 there are none. A"
            " script that uses them needs the line 'if __name__ == \"__main__\":' before what it does."
        )

    def end(self) -> None:
        """End all workers, whatever they do."""
        _end(self._all, os.getpid())


def _end(workers: list[_Worker], pid: int) -> None:
    # A forked child has a copy of the list, but must not end its parent's workers
    if os.getpid() == pid:
        for worker in workers:
            worker.connection.close()
            worker.process.terminate()
        for worker in workers:
            worker.process.join(5.0)
    workers.clear()
