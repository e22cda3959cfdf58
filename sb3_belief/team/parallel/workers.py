"""The worker processes of a team: started when they are needed, ended with it."""

import os
import time
import weakref
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

from sb3_belief.common.processes import (
    Inbox,
    WorkerError,
    WorkerTimeoutError,
    is_dead,
    kill_workers,
    patience,
    start_context,
    start_worker,
)
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
    :param asked: When it was sent, by ``time.monotonic()``
    :param longest: Seconds that the worker took at most for an answer so far, beside the first, before which it imports much
    """

    process: Any
    connection: Connection
    inbox: Inbox
    busy_with: str = ""
    asked: float = 0.0
    longest: float | None = None


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
        if any(is_dead(worker.process) for worker in self._all):
            self.end()
        for i in range(len(self._all), n):
            here, there = start_context().Pipe()
            process = start_worker(serve, (there,), f"team-worker-{i}")
            there.close()
            self._all.append(_Worker(process, here, Inbox(here, process)))

    def send(self, number: int, content: Any, agents: str) -> None:
        """
        Send a command to a worker.

        :param number: Number of the worker
        :param content: The command
        :param agents: Names of the agents that it is about
        :raises WorkerError: If the worker is dead
        """
        worker = self._all[number]
        worker.busy_with, worker.asked = agents, time.monotonic()
        try:
            send(worker.connection, content)
        except OSError as error:
            raise self._death(number) from error
        except BaseException:
            self._lose(number)
            raise

    def deadline(self) -> float:
        """
        Return when to give up a worker after an error, by ``time.monotonic()``.

        It may hang in an update, or only take its time: so it gets some, and the more the longer its answers took so far.
        """
        return time.monotonic() + patience(max((worker.longest or 0.0 for worker in self._all), default=0.0))

    def wait(self, number: int, deadline: float | None = None) -> None:
        """
        Wait for a worker's answer.

        :param number: Number of the worker
        :param deadline: When to give up, by ``time.monotonic()``; None to wait without a limit
        :raises WorkerError: If the worker died, or has not answered by then
        """
        worker = self._all[number]
        try:
            is_there = worker.inbox.wait(deadline)
        except (EOFError, OSError) as error:
            raise self._death(number) from error
        if not is_there:
            kill_workers([worker.process])
            raise WorkerTimeoutError(
                f"Worker process {number} was still busy with {worker.busy_with} when the team had been stopped for a while,"
                " and was ended."
            )
        worker.longest = 0.0 if worker.longest is None else max(worker.longest, time.monotonic() - worker.asked)

    def receive(self, number: int) -> Any:
        """
        Receive a worker's answer, which is there.

        :param number: Number of the worker
        :return: The answer
        :raises WorkerError: If the worker died
        """
        worker = self._all[number]
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
        kill_workers([self._all[number].process])

    def _death(self, number: int) -> WorkerError:
        worker = self._all[number]
        # It may need a moment to end
        worker.process.join(1.0)
        return WorkerError(
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
        kill_workers(worker.process for worker in workers)
    workers.clear()
