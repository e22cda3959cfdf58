"""What a worker process does that holds a copy of a team environment: it answers the commands of the main process."""

import pickle
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

from stable_baselines3.common.vec_env.base_vec_env import CloudpickleWrapper
from stable_baselines3.common.vec_env.subproc_vec_env import _worker

from sb3_belief.common.processes import become_worker
from sb3_belief.common.sent_errors import sent_error
from sb3_belief.vec_env.joint_env import JointEnv, step_and_reset
from sb3_belief.vec_env.worker_rows import RowPacker

#: Messages with a step's actions begin with this byte; all other messages are pickles, which begin with another one
STEP = b"s"
#: The answer to a step that raised ends with this byte, after a pickle of the error; other answers to a step have the length
#: of a row, or end as pickles do, with another byte
FAILED = b"!"


class _Channel:
    """
    Connection to the main process that answers the commands to step, and passes all others to SB3's worker loop.

    :param connection: The worker's end of its pipe
    :param env: The worker's copy
    """

    def __init__(self, connection: Connection, env: JointEnv):
        self._connection, self._env = connection, env
        self._packer: RowPacker | None = None
        self.send, self.close = connection.send, connection.close
        #: The last command that is no step, and its data
        self.command: tuple[str, Any] = ("", None)
        #: Whether the main process has closed the pipe
        self.at_end = False

    def recv(self) -> Any:
        """
        Answer commands to step until another command arrives.

        :return: That command
        """
        try:
            while (message := self._connection.recv_bytes()).startswith(STEP):
                self._connection.send_bytes(self._step(message))
        except (EOFError, OSError):
            self.at_end = True
            raise EOFError from None
        self.command = pickle.loads(message)
        return self.command

    def _step(self, message: bytes) -> bytes:
        env = self._env
        try:
            if self._packer is None:
                # Made at the first step: by then the main process has checked that a team can have these spaces
                self._packer = RowPacker(env.observation_spaces, env.action_spaces, env.scripted_action_spaces)
            joint_action = dict(zip(env.possible_agents, pickle.loads(message[len(STEP) :]), strict=True))
            return self._packer.pack(*step_and_reset(env, joint_action))
        except Exception as error:
            answer = pickle.dumps(sent_error(error)) + FAILED
            # Told from a row by its length
            size = 0 if self._packer is None else self._packer.size
            return answer + FAILED if len(answer) == size else answer


def _what(command: str, data: Any) -> str:
    """Return what a command does, for a message."""
    if command == "get_attr":
        return f"attribute {data!r}"
    return f"{data[0] if command == 'env_method' else command}()"


def serve_env(connection: Connection, parent_end: Connection, env_fn: CloudpickleWrapper) -> None:
    """
    Run a worker process until its pipe is closed. What the environment raises is sent to the main process.

    :param connection: The worker's end of the pipe
    :param parent_end: The main process's end of the pipe
    :param env_fn: Makes the worker's copy
    """
    become_worker()
    # Closed before the environment is made, since processes that it starts would inherit this end
    parent_end.close()
    try:
        env = env_fn.var()
    except Exception as error:
        # The answer to whatever is asked first
        with suppress(EOFError, OSError):
            connection.recv_bytes()
            connection.send(sent_error(error))
        return
    channel: Any = _Channel(connection, env)
    while True:
        try:
            _worker(channel, parent_end, CloudpickleWrapper(lambda: env))
            if channel.at_end or channel.command[0] == "close":
                return
            raise RuntimeError("EOFError")
        except Exception as error:
            command, data = channel.command
            if command not in ("reset", "render"):
                # These two name the place themselves
                env.name_place(error, _what(command, data))
            with suppress(OSError):
                connection.send(sent_error(error))
            if command == "close":
                return
