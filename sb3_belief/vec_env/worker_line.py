"""The main process's end of the pipe to one environment worker, which answers each command in time or is at fault."""

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

from stable_baselines3.common.vec_env.base_vec_env import CloudpickleWrapper

from sb3_belief.common.processes import (
    Inbox,
    WorkerError,
    WorkerTimeoutError,
    is_dead,
    join_workers,
    kill_workers,
    patience,
    start_context,
    start_worker,
    uninterrupted,
)
from sb3_belief.common.sent_errors import SentError, rebuilt_error
from sb3_belief.vec_env.worker_loop import serve_env

#: Seconds that a worker has for its first answer, before which it imports what its environment needs
START_TIMEOUT = 600.0
#: Seconds that workers have to finish an interrupted command, and then to close their environments, before they are killed
STEP_PATIENCE, CLOSE_PATIENCE = 1.0, 3.0


class WorkerLine:
    """
    One environment worker, as the main process sees it.

    SB3's ``SubprocVecEnv`` talks to it by ``send`` and ``recv``, which pass a fault on to ``on_fault``; what the caller looks
    after itself it does by ``post``, ``wait`` and ``take``.

    :param copy: Number of the environment copy
    :param env_fn: Makes the copy
    :param timeout: Seconds within which each command must be answered; None for no limit
    :param on_fault: Called with this line and the error when a worker has died or hangs; returns the error to raise
    """

    def __init__(
        self,
        copy: int,
        env_fn: Callable[[], Any],
        timeout: float | None,
        on_fault: Callable[["WorkerLine", WorkerError], WorkerError],
    ):
        self.copy, self.timeout = copy, timeout
        self._env_fn, self._on_fault = env_fn, on_fault
        #: Seconds of the longest step so far
        self.longest = 0.0
        self.start()

    def start(self) -> None:
        """Start the worker, or another one in its place."""
        #: Name of the command that has not been answered yet
        self.pending: str | None = None
        self._is_new = True
        self._deadline: float | None = None
        self._connection, there = start_context().Pipe()
        self.process = start_worker(serve_env, (there, self._connection, CloudpickleWrapper(self._env_fn)))
        there.close()
        self._inbox = Inbox(self._connection, self.process)

    def post(self, command: str, message: Any) -> None:
        """
        Send a command, whose answer is to be taken before the next one.

        :param command: Its name
        :param message: What is sent: the bytes of a step, or another thing as a pickle
        :raises OSError: If the worker is dead
        """
        if self.timeout is not None or self._is_new:
            self._deadline = time.monotonic() + self._limit
        else:
            self._deadline = None
        if command == "step":
            self._connection.send_bytes(message)
        else:
            self._connection.send(message)
        self.pending = command

    @property
    def _limit(self) -> float:
        timeout = self.timeout or 0.0
        return max(START_TIMEOUT, timeout) if self._is_new else timeout

    def wait(self) -> bool:
        """
        Wait for the answer.

        :return: Whether it is there. False if its time is over
        :raises EOFError: If the worker is dead
        """
        return self._inbox.wait(self._deadline)

    def take(self, as_bytes: bool = False) -> Any:
        """
        Receive the answer that is there.

        :param as_bytes: Whether it is the answer to a step
        :raises EOFError: If the worker is dead
        """
        answer = self._connection.recv_bytes() if as_bytes else self._connection.recv()
        self.pending, self._is_new = None, False
        return answer

    def fault(self, doing: str) -> WorkerError:
        """
        Return the error for a worker that does not answer, which is ended if it lives.

        :param doing: Name of the command
        """
        is_late = self._deadline is not None and time.monotonic() >= self._deadline
        if not is_late:
            # A process that has closed its pipe may take a moment to end
            self.process.join(1.0)
        if is_dead(self.process) or not is_late:
            kill_workers([self.process])
            return WorkerError(
                f"Environment worker process {self.copy} (exit code {self.process.exitcode}) died during {doing}()"
            )
        kill_workers([self.process])
        seconds = "in time" if not self._limit else f"within {self._limit:g} s"
        return WorkerTimeoutError(f"Environment worker process {self.copy} did not answer {doing}() {seconds} and was ended")

    def drain(self) -> None:
        """
        Receive and discard the answer to an interrupted command, if there is one.

        Without a limit of the user's such a command gets a little more time than its steps took so far: whoever has pressed
        Ctrl-C because it hangs does not have to press it again.

        :raises WorkerError: If the worker is dead, or does not answer
        """
        if self.pending is None:
            return
        command = self.pending
        if self._deadline is None:
            self._deadline = time.monotonic() + patience(self.longest)
        try:
            if not self.wait():
                raise EOFError
            with uninterrupted():
                self.take(as_bytes=True)
        except (EOFError, OSError) as error:
            raise self._on_fault(self, self.fault(command)) from error

    # What SB3's SubprocVecEnv calls

    def send(self, message: tuple[str, Any]) -> None:
        """
        Send a command that is no step.

        :param message: Its name and its data
        :raises WorkerError: If the worker is dead, or hangs in an interrupted command
        """
        self.drain()
        try:
            with uninterrupted():
                self.post(message[0], message)
        except OSError as error:
            raise self._on_fault(self, self.fault(message[0])) from error

    def recv(self) -> Any:
        """
        Wait for the answer to a command that is no step.

        :return: The answer
        :raises WorkerError: If the worker is dead, or does not answer in time
        :raises BaseException: What the environment raised
        """
        command = self.pending or "nothing"
        try:
            if not self.wait():
                raise EOFError
            with uninterrupted():
                answer = self.take()
        except (EOFError, OSError) as error:
            raise self._on_fault(self, self.fault(command)) from error
        if isinstance(answer, SentError):
            raise rebuilt_error(answer)
        return answer

    def ask_to_close(self, deadline: float) -> bool:
        """
        Tell the worker to close its environment and to end, once it has finished what it is at.

        :param deadline: Until when it may finish that
        :return: Whether it could be told
        """
        try:
            if self.pending is not None:
                if not self._inbox.wait(deadline):
                    return False
                self.take(as_bytes=True)
            self.post("close", ("close", None))
            return True
        except (EOFError, OSError):
            return False

    def closing_error(self, deadline: float) -> BaseException | None:
        """
        Wait until the worker has closed its environment.

        :param deadline: Until when to wait
        :return: What the environment raised, if anything
        """
        # What it does in the end is to close the pipe
        with suppress(EOFError, OSError):
            if self._inbox.wait(deadline) and isinstance(answer := self.take(), SentError):
                return rebuilt_error(answer)
        return None

    def close(self) -> None:
        """Close the pipe."""
        self._connection.close()
        self.pending = None


def close_lines(lines: Sequence[WorkerLine]) -> list[BaseException]:
    """
    End workers: those that can still be told close their environments first. None is waited for long.

    :param lines: To the workers
    :return: What the environments raised as they were closed
    """
    errors: list[BaseException] = []
    told: list[WorkerLine] = []
    try:
        deadline = time.monotonic() + STEP_PATIENCE
        told = [line for line in lines if line.ask_to_close(deadline)]
        kill_workers(line.process for line in lines if line not in told)
        deadline = time.monotonic() + CLOSE_PATIENCE
        errors = [error for line in told if (error := line.closing_error(deadline)) is not None]
        join_workers([line.process for line in told], max(deadline - time.monotonic(), 0.5))
    finally:
        # Whatever has interrupted this
        kill_workers(line.process for line in lines if not is_dead(line.process))
        for line in lines:
            line.close()
    return errors
