"""The worker processes of a team: started when they are needed, ended with it."""

import os
import weakref
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

from sb3_belief.team.jobs.messages import receive, send
from sb3_belief.team.jobs.worker import serve
from sb3_belief.team.processes import Inbox, start_context


class _Worker(NamedTuple):
    """
    :param process: itself
    :param connection: to it
    :param inbox: of that connection
    :param waiting: agents whose jobs it has been given, in order
    :param arrived: {agent: result that has been read before it was asked for}
    :param posted: {agent: small job that is to be sent with others}
    """

    process: Any
    connection: Connection
    inbox: Inbox
    waiting: list[str]
    arrived: dict[str, Any]
    posted: dict[str, Any]


class Workers:
    """Processes that update agents and choose their actions, ended with the last reference to this."""

    def __init__(self) -> None:
        self._all: list[_Worker] = []
        weakref.finalize(self, _end, self._all, os.getpid())

    def __len__(self) -> int:
        return len(self._all)

    def start(self, n: int) -> bool:
        """
        :param n: how many there are to be
        :return: whether any was started
        """
        if any(not worker.process.is_alive() for worker in self._all):
            self.end()
        context = start_context()
        missing = range(len(self._all), n)
        for i in missing:
            here, there = context.Pipe()
            process = context.Process(target=serve, args=(there,), name=f"team-worker-{i}", daemon=True)
            process.start()
            there.close()
            self._all.append(_Worker(process, here, Inbox(here, process), [], {}, {}))
        return len(missing) > 0

    def send(self, number: int, agent: str, job: Any) -> None:
        """
        :param number: of the worker
        :param agent: whose job it is; it has no other one at the time
        :param job: to do after those it has
        :raises RuntimeError: if the worker is dead
        """
        self._all[number].waiting.append(agent)
        self._send(number, agent, job)

    def _send(self, number: int, agent: str | None, content: Any) -> None:
        try:
            send(self._all[number].connection, agent, content)
        except OSError as error:
            raise self._death(number) from error

    def post(self, number: int, agent: str, job: Any) -> None:
        """
        As ``send``, with the next ``flush``: each message wakes a process, which costs as much as a small job.

        :param number: of the worker
        :param agent: whose job it is; it has no other one at the time
        :param job: to do, small and without tensors
        """
        self._all[number].posted[agent] = job

    def flush(self) -> None:
        """
        Send what was posted.

        :raises RuntimeError: if a worker is dead
        """
        for number, worker in enumerate(self._all):
            if worker.posted:
                worker.waiting.extend(worker.posted)
                jobs = dict(worker.posted)
                worker.posted.clear()
                self._send(number, None, jobs)

    def receive(self, number: int, agent: str) -> Any:
        """
        :param number: of the worker
        :param agent: whose job it was given
        :return: the result
        :raises RuntimeError: if the worker died over it
        """
        worker = self._all[number]
        while agent not in worker.arrived:
            try:
                worker.inbox.wait()
                whose, result = receive(worker.connection)
            except (EOFError, OSError) as error:
                raise self._death(number) from error
            results = result if whose is None else {whose: result}
            for name in results:
                worker.waiting.remove(name)
            worker.arrived.update(results)
        return worker.arrived.pop(agent)

    def _death(self, number: int) -> RuntimeError:
        worker = self._all[number]
        # It may need a moment to end
        worker.process.join(1.0)
        return RuntimeError(
            f"Worker process {number} (exit code {worker.process.exitcode}) died while it was busy with"
            f" {', '.join(worker.waiting)}; see its own error above, if it could write one. The next learn() starts new ones;"
            " with jobs=1 there are none. A script that uses them needs the line 'if __name__ == \"__main__\":' before what it"
            " does."
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
