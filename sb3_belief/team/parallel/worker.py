"""A worker process: agents learn in it, and models are updated as they are sent."""

import queue
import threading
from multiprocessing.connection import Connection
from typing import Any

from sb3_belief.common.processes import leave_interrupts_to_main
from sb3_belief.team.parallel.arrived import ModelSnapshot, Recorder, captured, failure_of, rebuild
from sb3_belief.team.parallel.messages import Message, dumps, receive, send
from sb3_belief.team.parallel.updating import read_stream
from sb3_belief.team.parallel.worker_server import WorkerServer


def serve(connection: Connection) -> None:
    """
    What a worker process does until its team is gone.

    :param connection: brings jobs, one after the other, and takes their results
    """
    leave_interrupts_to_main()
    # The team sends without waiting for results, so both ways must always be free
    jobs: queue.SimpleQueue[tuple[Any, Any] | None] = queue.SimpleQueue()
    results: queue.SimpleQueue[tuple[Any, Any]] = queue.SimpleQueue()
    threading.Thread(target=_receive_jobs, args=(connection, jobs), daemon=True).start()
    threading.Thread(target=_send_results, args=(connection, results), daemon=True).start()
    host = WorkerServer()
    while (given := jobs.get()) is not None:
        agent, job = given
        if agent is not None:
            results.put((agent, update(job)))
        elif (done := host.do(job)) is not None:
            results.put((None, done))


def _receive_jobs(connection: Connection, jobs: queue.SimpleQueue) -> None:
    try:
        while True:
            jobs.put(receive(connection))
    except (EOFError, OSError):
        jobs.put(None)


def _send_results(connection: Connection, results: queue.SimpleQueue) -> None:
    try:
        while True:
            send(connection, *results.get())
    except OSError:
        # The team is gone, as the other thread notices
        pass


def update(job: Message) -> Message:
    """
    :param job: as ``pack`` made it
    :return: the result, for ``unpack_result``
    """
    recorder = Recorder()
    content: dict[str, Any] = {"tensors": None, "error": None, "output": "", "warnings": []}
    before: ModelSnapshot | None = None
    with captured(content):
        try:
            model = rebuild(job, recorder)
            before = ModelSnapshot(model)
            model.train()  # type: ignore[attr-defined]
        except BaseException as error:
            content.update(failure_of(error))
        try:
            if before is not None:
                content.update(before.changes(), stream=read_stream())
        except Exception as error:
            content.update(failure_of(error), tensors=None)
    content["log"] = recorder.take()
    try:
        return dumps(content, {})
    except Exception as error:
        return dumps({**content, **failure_of(error), "tensors": None, "log": []}, {})
