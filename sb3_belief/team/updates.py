"""
Updates of a team's agents on several cores.

On-policy algorithms collect a rollout and then call ``train()``, in which most of the time goes. Agents are independent, so
these calls can run at once: while a team learns, ``train`` of each such model waits for the others', and is then run in this
process or, with the model as it is, in a worker process. What is learned, drawn and logged is the same, bit for bit.
"""

import multiprocessing
import os
import weakref
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_belief.team.members import UPDATES, UPDATES_HERE
from sb3_belief.team.update_jobs import REPLACED, pack, read_stream, unpack_result, write_stream
from sb3_belief.team.update_messages import Message, receive, send
from sb3_belief.team.update_worker import serve

if TYPE_CHECKING:
    from sb3_belief.team.lockstep import Lockstep


def check_jobs(jobs: Any) -> int:
    """
    :param jobs: given as the number of processes
    :return: the same
    :raises ValueError: if it is none
    """
    if not isinstance(jobs, int) or isinstance(jobs, bool) or jobs < 1:
        raise ValueError(f"jobs is {jobs!r}; it must be a whole number of at least 1: the processes that update the agents.")
    return jobs


class Updates:
    """
    Who updates which agent: the n-th of a round process n modulo the number of processes, the last of which is this one.

    :param models: of the team, by agent; those that are not on-policy train within their own steps, and are left alone
    :param jobs: number of processes, this one among them; more than there are on-policy agents are not used
    :raises ValueError: if there are several, and a model is not on the CPU
    """

    def __init__(self, models: Mapping[str, BaseAlgorithm], jobs: int):
        self._models, self._jobs = models, check_jobs(jobs)
        self._workers = _Workers()
        self._n_processes, self._round, self._submitted = 1, -1, 0
        self._on_policy()

    def _on_policy(self) -> dict[str, OnPolicyAlgorithm]:
        found = {agent: model for agent, model in self._models.items() if isinstance(model, OnPolicyAlgorithm)}
        self._n_processes = min(self._jobs, max(len(found), 1))
        for agent, model in found.items():
            if self._n_processes > 1 and model.device.type != "cpu":
                raise ValueError(
                    f"jobs={self._jobs} is for models on the CPU, but that of {agent!r} is on {model.device}: use jobs=1, or"
                    ' device="cpu".'
                )
        return found

    @contextmanager
    def together(self, hub: "Lockstep") -> Iterator[None]:
        """
        Within the block the models' ``train()`` runs in several processes. Workers go on waiting for the next block, unless an
        error ends this one.

        :param hub: in which the agents learn
        :raises ValueError: if a model cannot be sent to another process
        """
        # A user may have replaced a model's train() in the same way, which can then run here only
        models = {agent: model for agent, model in self._on_policy().items() if "train" not in vars(model)}
        if self._n_processes < 2:
            yield
            return
        if not self._workers:
            for agent, model in models.items():
                # Said now rather than after a first long rollout
                self._pack(agent, model)
        self._workers.start(self._n_processes - 1)
        self._round = -1
        try:
            for agent, model in models.items():
                excluded = [*model._excluded_save_params(), *REPLACED]
                model.train = partial(self._train, hub, agent, model)  # type: ignore[method-assign]
                # A model that is saved meanwhile is saved as always
                model._excluded_save_params = partial(list, excluded)  # type: ignore[method-assign]
            yield
        except BaseException:
            self._workers.end()
            raise
        finally:
            for model in models.values():
                for name in REPLACED:
                    vars(model).pop(name, None)

    def _train(self, hub: "Lockstep", agent: str, model: OnPolicyAlgorithm) -> None:
        """What ``model.train`` is, in the agent's own coroutine and random stream."""
        if not hub.is_round_of(agent):
            type(model).train(model)
            return
        if self._round != hub.n_steps:
            self._round, self._submitted = hub.n_steps, 0
        worker = self._submitted % self._n_processes
        self._submitted += 1
        if worker == self._n_processes - 1:
            # Not before the workers have something to do as well
            hub.wait(agent, UPDATES_HERE)
            type(model).train(model)
            # A normal number that numpy keeps back would be lost while others draw
            stream = read_stream()
            hub.wait(agent, UPDATES)
            write_stream(stream)
        else:
            self._workers.send(worker, agent, self._pack(agent, model))
            hub.wait(agent, UPDATES)
            unpack_result(model, self._workers.receive(worker))

    @staticmethod
    def _pack(agent: str, model: BaseAlgorithm) -> Message:
        try:
            return pack(model)
        except ValueError as error:
            raise ValueError(f"Agent {agent!r} cannot be updated in another process. {error}") from error


class _Workers:
    """Processes that update models, ended with the last reference to this."""

    def __init__(self) -> None:
        # Process, connection and the agents it has been given
        self._all: list[tuple[Any, Connection, deque[str]]] = []
        weakref.finalize(self, _end, self._all, os.getpid())

    def __len__(self) -> int:
        return len(self._all)

    def start(self, n: int) -> None:
        """
        :param n: how many there are to be
        """
        if any(not process.is_alive() for process, _, _ in self._all):
            self.end()
        methods = multiprocessing.get_all_start_methods()
        # A process that has trained must not be forked: autograd has threads
        context: Any = multiprocessing.get_context("forkserver" if "forkserver" in methods else "spawn")
        while len(self._all) < n:
            here, there = context.Pipe()
            process = context.Process(target=serve, args=(there,), name=f"update-worker-{len(self._all)}", daemon=True)
            process.start()
            there.close()
            self._all.append((process, here, deque()))

    def send(self, worker: int, agent: str, job: Message) -> None:
        """
        :param worker: which of them
        :param agent: whose job it is
        :param job: to do after those it has
        """
        _, connection, agents = self._all[worker]
        agents.append(agent)
        try:
            send(connection, job)
        except OSError as error:
            raise self._death(worker) from error

    def receive(self, worker: int) -> Message:
        """
        :param worker: which of them
        :return: the next of its results
        """
        process, connection, agents = self._all[worker]
        try:
            # Not every death of a process closes its connection
            while not connection.poll(1.0):
                if not process.is_alive() and not connection.poll(0):
                    raise EOFError
            result = receive(connection)
        except (EOFError, OSError) as error:
            raise self._death(worker) from error
        agents.popleft()
        return result

    def _death(self, worker: int) -> RuntimeError:
        process, _, agents = self._all[worker]
        # It may need a moment to end
        process.join(1.0)
        return RuntimeError(
            f"Worker process {worker} (exit code {process.exitcode}) died while it had to update {', '.join(agents)}; see its"
            " own error above, if it could write one. The next learn() starts new ones; with jobs=1 there are none. A script"
            " that uses them needs the line 'if __name__ == \"__main__\":' before what it does."
        )

    def end(self) -> None:
        """End them all, whatever they do."""
        _end(self._all, os.getpid())


def _end(workers: list[tuple[Any, Connection, deque[str]]], pid: int) -> None:
    # Not by a forked child, which has a copy of the list
    if os.getpid() == pid:
        for process, connection, _ in workers:
            connection.close()
            process.terminate()
        for process, _, _ in workers:
            process.join(5.0)
    workers.clear()
