"""In a worker process: models that learn there, from when they arrive until they are sent back."""

import inspect
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from typing import Any, NamedTuple

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, unwrap_vec_normalize

from sb3_belief.common.rng import RngState, RngSwitch
from sb3_belief.team.batched_forward import batched_forwards
from sb3_belief.team.lockstep.scheduler import AgentTask
from sb3_belief.team.parallel.arrived import ModelSnapshot, Recorder, captured, failure_of, rebuild
from sb3_belief.team.parallel.group_scheduler import GroupScheduler
from sb3_belief.team.parallel.messages import Message, dumps, loads
from sb3_belief.team.predictor import Predictor


class AgentPayload(NamedTuple):
    """
    An agent that is to learn in another process.

    :param model: as ``pack`` made it
    :param wrappers: class and state of those around its environment, the outermost first
    :param stream: what it draws from
    """

    model: Message
    wrappers: list[tuple[type[VecEnvWrapper], dict[str, Any]]]
    stream: RngState


class Command(NamedTuple):
    """
    :param method: of ``GroupScheduler``, or one of ``WorkerServer``
    :param args: of the method
    :param is_answered: whether it has an answer; otherwise another order follows, which has
    """

    method: str
    args: tuple[Any, ...] = ()
    is_answered: bool = True


# Orders that are also about the models; the others are the hub's
_OWN = ("open", "end_rollouts", "look", "close")
# Of a wrapper, what belongs to where it is
_OF_ITS_PLACE = ("venv", "class_attributes")


def wrappers_of(env: VecEnv | None) -> Iterator[VecEnvWrapper]:
    """
    :param env: of a model
    :return: what is around the agent's own environment, the outermost first
    """
    while isinstance(env, VecEnvWrapper):
        yield env
        env = env.venv


def state_of(wrapper: VecEnvWrapper) -> dict[str, Any]:
    """
    :param wrapper: around an agent's environment
    :return: all of it but what it wraps
    """
    return {name: value for name, value in vars(wrapper).items() if name not in _OF_ITS_PLACE}


class WorkerServer:
    """One branch of a team after another learns here, each from ``open`` to ``close``."""

    def __init__(self) -> None:
        self._found = _nothing()
        self._clear()

    def _clear(self) -> None:
        self._stack = ExitStack()
        self._scheduler: GroupScheduler | None = None
        self._models: dict[str, BaseAlgorithm] = {}
        self._streams: dict[str, RngState] = {}
        self._recorders: dict[str, Recorder] = {}
        self._before: dict[str, ModelSnapshot] = {}
        # Of whom it is not known yet that they can be sent back after an update
        self._unchecked: set[str] = set()

    def do(self, order: Command | Message) -> Message | None:
        """
        :param order: from the main process
        :return: the answer, if there is to be one: with what was raised, but else as always, if the order has failed
        """
        is_answered = True
        with captured(self._found):
            try:
                method, args, is_answered = loads(order) if isinstance(order, Message) else order
                if method in _OWN:
                    getattr(self, method)(*args)
                elif self._found["error"] is None:
                    getattr(self._scheduler, method)(*args)
            except BaseException as error:
                self._found.update(failure_of(error))
        if not is_answered:
            return None
        if self._scheduler is not None:
            self._found["states"], self._found["actions"] = self._scheduler.take_moves()
        self._found["log"] = {agent: recorder.take() for agent, recorder in self._recorders.items()}
        found, self._found = self._found, _nothing()
        if self._scheduler is None:
            self._clear()
        try:
            return dumps(found, {})
        except Exception as error:
            return dumps({**_nothing(), **failure_of(error)}, {})

    def open(self, arriving: dict[str, AgentPayload], learn: Callable[..., None], scheduler_kwargs: dict[str, Any]) -> None:
        """
        :param arriving: the agents
        :param learn: runs ``learn()`` of a model with a callback
        :param hub_kwargs: of ``GroupScheduler``
        """
        idle = RngState(0)
        streams = self._stack.enter_context(RngSwitch(idle))
        scheduler = GroupScheduler(streams=streams, idle=idle, **scheduler_kwargs)
        tasks: dict[str, AgentTask] = {}
        for agent, (job, wrappers, stream) in arriving.items():
            recorder = self._recorders[agent] = Recorder()
            model = self._models[agent] = rebuild(job, recorder)
            env: VecEnv = scheduler.agent_envs[agent]
            for wrapper_class, state in reversed(wrappers):
                wrapper = wrapper_class.__new__(wrapper_class)
                vars(wrapper).update(state, venv=env, class_attributes=dict(inspect.getmembers(wrapper_class)))
                env = wrapper
            model.env, model._vec_normalize_env = env, unwrap_vec_normalize(env)
            self._before[agent], self._streams[agent] = ModelSnapshot(model), stream
            tasks[agent] = AgentTask(partial(learn, model), Predictor(model, model._vec_normalize_env).act, stream)
        self._unchecked = set(tasks)
        self._stack.enter_context(batched_forwards(scheduler, self._models))  # type: ignore[arg-type]
        self._scheduler = scheduler
        scheduler.start(tasks)

    def end_rollouts(self) -> None:
        """Those who have ended a rollout are updated."""
        assert self._scheduler is not None
        for agent in self._unchecked.intersection(self._scheduler.end_rollouts()):
            # Rather now than when there is much to lose
            self._before[agent].check()
            self._unchecked.remove(agent)

    def look(self) -> None:
        """Say how the models are."""
        self._find_changes(with_buffers=False)

    def close(self) -> None:
        """End what is under way, and say how the models are."""
        try:
            if self._scheduler is not None:
                self._scheduler.stop()
                self._find_changes(with_buffers=True)
        finally:
            self._stack.close()
            self._scheduler = None

    def _find_changes(self, with_buffers: bool) -> None:
        for agent, before in self._before.items():
            env = self._models[agent].env
            try:
                self._found["changes"][agent] = {
                    "model": before.changes(),
                    "wrappers": [state_of(wrapper) for wrapper in wrappers_of(env)],
                    "stream": self._streams[agent],
                    "buffer": before.buffer() if with_buffers else None,
                }
            except Exception as error:
                # The others are not lost with it
                self._found.update(failure_of(error))


def _nothing() -> dict[str, Any]:
    return {"output": "", "warnings": [], "error": None, "states": {}, "actions": {}, "log": {}, "changes": {}}
