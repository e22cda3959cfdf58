"""What a worker process does: it carries out commands about the agents that learn in it."""

import inspect
import io
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, redirect_stdout
from functools import partial
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, unwrap_vec_normalize

from sb3_belief.common.plain_data import PlainData
from sb3_belief.common.processes import become_worker
from sb3_belief.common.rng import RngState, RngSwitch
from sb3_belief.common.sent_errors import sent_error
from sb3_belief.team.batched_forward import batched_forwards
from sb3_belief.team.exact.agent_state import write_agent_state
from sb3_belief.team.lockstep.scheduler import AgentTask
from sb3_belief.team.model_parts import wrappers_of
from sb3_belief.team.own_code import runs_own_code
from sb3_belief.team.parallel.group_scheduler import GroupScheduler
from sb3_belief.team.parallel.messages import Message, dumps, loads, receive, send
from sb3_belief.team.parallel.model_state import StateReader, unpack
from sb3_belief.team.predictor import Predictor

LogCall = tuple[str, tuple, dict[str, Any]]


class AgentPayload(NamedTuple):
    """
    An agent on its way to a worker.

    :param model: As ``pack`` made it
    :param wrappers: Class and state of those around its environment, the outermost first
    :param rng: Its random number generators
    """

    model: Message
    wrappers: list[tuple[type[VecEnvWrapper], dict[str, Any]]]
    rng: RngState


class Command(NamedTuple):
    """
    What a worker is to do.

    :param method: Name of a method of ``GroupScheduler`` or ``WorkerServer``
    :param args: Arguments of the method
    :param is_answered: Whether the worker answers; otherwise another command follows that it answers
    """

    method: str
    args: tuple[Any, ...] = ()
    is_answered: bool = True


# Commands that are about the models, too; the others go to the scheduler
_OWN = ("open", "end_rollouts", "restore", "sync", "close")
# Attributes of a wrapper that belong to the process it is in
_OF_THE_PROCESS = ("venv", "class_attributes")


def state_of(wrapper: VecEnvWrapper) -> dict[str, Any]:
    """
    Return the state of a wrapper: all its attributes except what it wraps.

    :param wrapper: Around an agent's environment
    """
    return {name: value for name, value in vars(wrapper).items() if name not in _OF_THE_PROCESS}


class LogRecorder(Logger):
    """Records what is logged in a worker, for the model's own logger in the main process."""

    def __init__(self) -> None:
        super().__init__(None, [])
        self.calls: list[LogCall] = []

    def take(self) -> list[LogCall]:
        """Return the calls since the last time: methods and their arguments."""
        calls, self.calls = self.calls, []
        return calls

    def record(self, *args: Any, **kwargs: Any) -> None:
        self.calls.append(("record", args, kwargs))
        super().record(*args, **kwargs)

    def record_mean(self, *args: Any, **kwargs: Any) -> None:
        self.calls.append(("record_mean", args, kwargs))
        super().record_mean(*args, **kwargs)

    def log(self, *args: Any, **kwargs: Any) -> None:
        self.calls.append(("log", args, kwargs))

    def dump(self, *args: Any, **kwargs: Any) -> None:
        self.calls.append(("dump", args, kwargs))
        super().dump(*args, **kwargs)


class WorkerServer:
    """Lets one group of agents after another learn, each from ``open`` to ``close``."""

    def __init__(self) -> None:
        self._answer = _empty_answer()
        self._clear()

    def _clear(self) -> None:
        self._stack = ExitStack()
        self._scheduler: GroupScheduler | None = None
        self._models: dict[str, Any] = {}
        self._rngs: dict[str, RngState] = {}
        self._recorders: dict[str, LogRecorder] = {}
        self._readers: dict[str, StateReader] = {}
        # Agents of which no state has been read yet after an update
        self._unread: set[str] = set()

    def do(self, message: Command | Message) -> Message | None:
        """
        Carry out a command.

        :param message: From the main process
        :return: The answer, if there is one. It holds what was raised, but is as always otherwise, if the command has failed
        """
        is_answered = True
        with _captured(self._answer):
            try:
                method, args, is_answered = loads(message) if isinstance(message, Message) else message
                if method in _OWN:
                    getattr(self, method)(*args)
                elif self._answer["error"] is None:
                    getattr(self._scheduler, method)(*args)
            except BaseException as error:
                self._answer["error"] = sent_error(error)
        if not is_answered:
            return None
        if self._scheduler is not None:
            self._answer["states"], self._answer["actions"] = self._scheduler.take_result()
        self._answer["log"] = {agent: recorder.take() for agent, recorder in self._recorders.items()}
        answer, self._answer = self._answer, _empty_answer()
        if self._scheduler is None:
            self._clear()
        try:
            return dumps(answer, {})
        except Exception as error:
            return dumps({**_empty_answer(), "error": sent_error(error)}, {})

    def open(self, payloads: dict[str, AgentPayload], learn: Callable[..., None], scheduler_kwargs: dict[str, Any]) -> None:
        """
        Build the models and run them up to their first actions.

        :param payloads: The agents
        :param learn: Runs a model's ``learn()``, called with the model and a callback
        :param scheduler_kwargs: Arguments of ``GroupScheduler``
        """
        idle = RngState(0)
        rngs = self._stack.enter_context(RngSwitch(idle))
        scheduler = GroupScheduler(rngs=rngs, idle=idle, **scheduler_kwargs)
        tasks: dict[str, AgentTask] = {}
        for agent, (message, wrappers, rng) in payloads.items():
            recorder = self._recorders[agent] = LogRecorder()
            model = self._models[agent] = unpack(message, recorder)
            env: VecEnv = scheduler.agent_envs[agent]
            for wrapper_class, state in reversed(wrappers):
                wrapper = wrapper_class.__new__(wrapper_class)
                vars(wrapper).update(state, venv=env, class_attributes=dict(inspect.getmembers(wrapper_class)))
                env = wrapper
            model.env, model._vec_normalize_env = env, unwrap_vec_normalize(env)
            self._readers[agent], self._rngs[agent] = StateReader(model), rng
            tasks[agent] = AgentTask(partial(learn, model), Predictor(model, model._vec_normalize_env).act, rng)
        self._unread = set(tasks)
        self._stack.enter_context(batched_forwards(scheduler, self._models, watches=runs_own_code([], self._models)))
        self._scheduler = scheduler
        scheduler.start(tasks)

    def end_rollouts(self) -> None:
        """Let the agents that have ended a rollout train on it."""
        assert self._scheduler is not None
        for agent in self._unread.intersection(self._scheduler.end_rollouts()):
            # A model that cannot be sent back is better found out now than when there is much to lose
            self._readers[agent].read(with_buffer=False)
            self._unread.remove(agent)

    def restore(self, states: dict[str, PlainData]) -> None:
        """
        Put the agents' exact states back.

        :param states: By agent
        """
        for agent, state in states.items():
            write_agent_state(self._models[agent], self._rngs[agent], state)

    def sync(self) -> None:
        """Send the models' states, without the rollouts in their buffers."""
        self._read_states(with_buffers=False)

    def close(self) -> None:
        """Stop the agents, and send the models' states."""
        try:
            if self._scheduler is not None:
                self._scheduler.stop()
                self._read_states(with_buffers=True)
        finally:
            self._stack.close()
            self._scheduler = None

    def _read_states(self, with_buffers: bool) -> None:
        for agent, reader in self._readers.items():
            try:
                self._answer["payloads"][agent] = {
                    "model": reader.read(with_buffers),
                    "wrappers": [state_of(wrapper) for wrapper in wrappers_of(self._models[agent].env)],
                    "rng": self._rngs[agent],
                }
                reader.mark_as_sent()
            except Exception as error:
                # The other agents' states are not lost with it
                self._answer["error"] = sent_error(error)


def _empty_answer() -> dict[str, Any]:
    return {"output": "", "warnings": [], "error": None, "states": {}, "actions": {}, "log": {}, "payloads": {}}


@contextmanager
def _captured(answer: dict[str, Any]) -> Iterator[None]:
    """Add to an answer what is printed and warned within the block."""
    output = io.StringIO()
    with warnings.catch_warnings(record=True) as caught, redirect_stdout(output):
        warnings.simplefilter("always")
        yield
    answer["output"] += output.getvalue()
    answer["warnings"] += [(str(w.message), w.category, w.filename, w.lineno) for w in caught]


def serve(connection: Connection) -> None:
    """
    Carry out the commands of the main process until it closes the connection.

    :param connection: To the main process
    """
    become_worker()
    server = WorkerServer()
    try:
        while True:
            if (answer := server.do(receive(connection))) is not None:
                send(connection, answer)
    except (EOFError, OSError):
        # The team is gone
        pass
