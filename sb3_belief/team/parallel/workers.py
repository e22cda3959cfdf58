"""The worker processes of a team: started when they are needed, ended with it."""

import os
import weakref
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

from sb3_belief.common.processes import Inbox, start_context
from sb3_belief.team.parallel.messages import receive, send
from sb3_belief.team.parallel.worker import serve


class _Worker(NamedTuple):
    """
    :param process: itself
    :param connection: to it
    :param inbox: of that connection
    :param waiting: {whose job it has been given, see ``Workers.send``: who that is, in words}, in order
    :param arrived: {whose: result that has been read before it was asked for}
    """

    process: Any
    connection: Connection
    inbox: Inbox
    waiting: dict[str | None, str]
    arrived: dict[str | None, Any]


class Workers:
    """Processes in which agents learn or are updated, ended with the last reference to this."""

    def __init__(self) -> None:
        self._all: list[_Worker] = []
        weakref.finalize(self, _end, self._all, os.getpid())

    def __len__(self) -> int:
        return len(self._all)

    def start(self, n: int) -> None:
        """
        :param n: how many there are to be
        """
        if any(not worker.process.is_alive() for worker in self._all):
            self.end()
        context = start_context()
        for i in range(len(self._all), n):
            here, there = context.Pipe()
            process = context.Process(target=serve, args=(there,), name=f"team-worker-{i}", daemon=True)
            process.start()
            there.close()
            self._all.append(_Worker(process, here, Inbox(here, process), {}, {}))

    def send(self, number: int, agent: str | None, job: Any, whose: str = "") -> None:
        """
        :param number: of the worker
        :param agent: whose job it is; None: of the branch of the team that learns there
        :param job: to do after those it has
        :param whose: who that is, if not an agent
        :raises RuntimeError: if the worker is dead
        """
        worker = self._all[number]
        worker.waiting[agent] = whose or str(agent)
        try:
            send(worker.connection, agent, job)
        except OSError as error:
            raise self._death(number) from error
        except BaseException:
            self._lose(number)
            raise

    def receive(self, number: int, agent: str | None) -> Any:
        """
        :param number: of the worker
        :param agent: whose job it was given, as for ``send``
        :return: the result
        :raises RuntimeError: if the worker died over it
        """
        worker = self._all[number]
        while agent not in worker.arrived:
            try:
                worker.inbox.wait()
            except (EOFError, OSError) as error:
                raise self._death(number) from error
            try:
                whose, result = receive(worker.connection)
            except (EOFError, OSError) as error:
                raise self._death(number) from error
            except BaseException:
                self._lose(number)
                raise
            worker.waiting.pop(whose, None)
            worker.arrived[whose] = result
        return worker.arrived.pop(agent)

    def _lose(self, number: int) -> None:
        """A message is cut off, by Ctrl-C for instance: nobody can tell where the next one begins."""
        self._all[number].connection.close()
        self._all[number].process.terminate()

    def _death(self, number: int) -> RuntimeError:
        worker = self._all[number]
        # It may need a moment to end
        worker.process.join(1.0)
        return RuntimeError(
            f"Worker process {number} (exit code {worker.process.exitcode}) died while it was busy with"
            f" {', '.join(worker.waiting.values())}; see its own error above, if it could write one. Models that learned in it"
            " are what they were before this learn(), or when they were last saved or evaluated. The next learn() starts new"
            " workers; with jobs=1 there are none. A script that uses them needs the line"
            " 'if __name__ == \"__main__\":' before what it does."
        )

    def end(self) -> None:
        """End them all, whatever they do."""
        _end(self._all, os.getpid())


def _end(workers: list[_Worker], pid: int) -> None:
    # Not by a forked child, which has a copy of the list
    if os.getpid() == pid:
        for worker in workers:
            worker.connection.close()
            worker.process.terminate()
        for worker in workers:
            worker.process.join(5.0)
    workers.clear()
