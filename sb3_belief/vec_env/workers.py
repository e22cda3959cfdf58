"""
Copies of a team environment in worker processes: SB3's ``SubprocVecEnv``, whose steps come back as rows of bytes.

What a step is made of has the same shape at all steps, so a worker packs it into one row, and here the rows of all copies are
one array. To pickle a step's dictionaries, arrays and records one by one, and to stack them again, took most of the time that
workers cost.
"""

import pickle
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import CloudpickleWrapper, VecEnvIndices, VecEnvStepReturn
from stable_baselines3.common.vec_env.subproc_vec_env import _worker

from sb3_belief.common.processes import Inbox, leave_interrupts_to_main, start_context
from sb3_belief.vec_env.joint_env import JointEnv, mask_width, step_and_reset

# What a message with a step's actions begins with; all others are pickles, which do not begin so
_STEP = b"s"
# The parts of a row that are entries of infos, in the order in which ``TeamVecEnv`` lists them
_INFOS = ("agent_rewards", "visible", "active", "life_end", "truncated")


def row_type(
    observation_spaces: dict[str, spaces.Space],
    action_spaces: dict[str, spaces.Space],
    scripted_action_spaces: dict[str, spaces.Space],
) -> np.dtype:
    """
    :param observation_spaces: by agent
    :param action_spaces: by agent
    :param scripted_action_spaces: by name of a scripted other
    :return: what a joint step of one copy is made of; observations are named by the agent's number
    """
    n = len(observation_spaces)
    observations = [(str(i), space.dtype, space.shape or ()) for i, space in enumerate(observation_spaces.values())]
    return np.dtype(
        [
            ("observations", observations),
            ("reward", np.float32),
            ("done", bool),
            ("agent_rewards", np.float32, (n,)),
            ("visible", bool, (n, n - 1 + len(scripted_action_spaces))),
            *((name, bool, (n,)) for name in ("active", "life_end", "truncated")),
            ("scripted_actions", np.float32, (sum(map(spaces.flatdim, scripted_action_spaces.values())),)),
            ("has_masks", bool),
            ("action_masks", bool, (sum(map(mask_width, action_spaces.values())),)),
        ]
    )


class WorkersVecEnv(SubprocVecEnv):
    """
    SB3's ``SubprocVecEnv`` for joint environments, with other messages for the steps. Its workers leave Ctrl-C to the main
    process.

    :param env_fns: one callable per copy that makes its ``JointEnv``
    """

    # Of the last step: float32 [num_envs, n]
    agent_rewards: np.ndarray
    # For the next one: bool [num_envs, sum of their widths], all agents' one after the other; None if there are none
    action_masks: np.ndarray | None = None

    def __init__(self, env_fns: list[Callable[[], JointEnv]]):
        self.waiting = self.closed = False
        # As SB3 starts its own workers: with another target, so its constructor is not called
        context = start_context()
        self.remotes, self.work_remotes = zip(*[context.Pipe() for _ in env_fns], strict=True)
        self.processes = []
        for work_remote, remote, env_fn in zip(self.work_remotes, self.remotes, env_fns, strict=True):
            process = context.Process(target=_serve, args=(work_remote, remote, CloudpickleWrapper(env_fn)), daemon=True)
            process.start()
            self.processes.append(process)
            work_remote.close()
        self.inboxes = [Inbox(remote, process) for remote, process in zip(self.remotes, self.processes, strict=True)]
        self.remotes[0].send(("get_spaces", None))
        VecEnv.__init__(self, len(env_fns), *self.remotes[0].recv())
        self._agents: list[str] = []
        self._row_type = np.dtype([])

    def set_members(
        self,
        observation_spaces: dict[str, spaces.Space],
        action_spaces: dict[str, spaces.Space],
        scripted_action_spaces: dict[str, spaces.Space],
    ) -> None:
        """
        :param observation_spaces: by agent, the same in all copies
        :param action_spaces: by agent
        :param scripted_action_spaces: by name of a scripted other
        """
        self._agents = list(observation_spaces)
        self._row_type = row_type(observation_spaces, action_spaces, scripted_action_spaces)
        self._info_names = _INFOS + ("scripted_actions",) * bool(scripted_action_spaces)

    def step(self, actions: Any) -> VecEnvStepReturn:
        """
        Step all copies. Ctrl-C can interrupt the waiting, never a message: an interrupted step is finished before the next
        one.

        :param actions: For each copy, the actions by agent
        :return: As :meth:`step_wait`
        :raises RuntimeError: If a worker died
        """
        self.finish_step()
        with self._reports_deaths("step"):
            with _uninterrupted():
                self.step_async(actions)
            self._await_steps()
            with _uninterrupted():
                return self.step_wait()

    def finish_step(self) -> None:
        """Receive the results of a step that was interrupted, and drop them."""
        if self.waiting:
            with self._reports_deaths("step"):
                self._await_steps()
                self.step_wait()

    def _await_steps(self) -> None:
        # The last to start is likely the last to finish: waiting for it first means being woken once
        for inbox in reversed(self.inboxes):
            inbox.wait()

    def reset(self) -> Any:
        self.finish_step()
        with self._reports_deaths("reset"):
            return super().reset()

    def close(self) -> None:
        self.finish_step()
        super().close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        self.finish_step()
        return super().get_attr(attr_name, indices)

    def has_attr(self, attr_name: str) -> bool:
        self.finish_step()
        return super().has_attr(attr_name)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        self.finish_step()
        return super().env_method(method_name, *method_args, indices=indices, **method_kwargs)

    @contextmanager
    def _reports_deaths(self, doing: str) -> Iterator[None]:
        """Say which worker died within the block, and end the others."""
        try:
            yield
        except (EOFError, OSError) as error:
            if self.closed:
                raise RuntimeError(f"Cannot {doing}: the environment is closed, its worker processes have ended.") from error
            # A process that has closed its pipe may need a moment to end
            for process in self.processes:
                process.join(0.1)
            dead = [f"{i} (exit code {p.exitcode})" for i, p in enumerate(self.processes) if not p.is_alive()]
            self._end_all()
            raise RuntimeError(
                f"Environment worker process {', '.join(dead) or 'unknown'} died during {doing}(); see its own error above,"
                " if it could write one. The other workers have been ended: make a new environment to go on."
            ) from error

    def _end_all(self) -> None:
        for process in self.processes:
            process.terminate()
        for process, remote in zip(self.processes, self.remotes, strict=True):
            process.join(5.0)
            remote.close()
        self.waiting, self.closed = False, True

    def step_async(self, actions: Any) -> None:
        """
        :param actions: of each copy, {agent: action}
        """
        for remote, chosen in zip(self.remotes, actions, strict=True):
            remote.send_bytes(_STEP + pickle.dumps(tuple(chosen.values())))
        self.waiting = True

    def step_wait(self) -> VecEnvStepReturn:
        """
        :return: observations {agent: array [num_envs, ...]}, rewards float32 [num_envs], dones bool [num_envs] and infos as
            a ``TeamVecEnv`` has them
        """
        messages = [remote.recv_bytes() for remote in self.remotes]
        self.waiting = False
        size = self._row_type.itemsize
        rows = np.frombuffer(b"".join([message[:size] for message in messages]), dtype=self._row_type)
        # Copies, since rows are read-only and would be kept as a whole by whoever keeps a part
        observations = {agent: rows["observations"][str(i)].copy() for i, agent in enumerate(self._agents)}
        columns = [rows[name].copy() for name in self._info_names]
        self.agent_rewards = columns[0]
        infos = [dict(zip(self._info_names, parts, strict=True)) for parts in zip(*columns, strict=True)]
        for info, message in zip(infos, messages, strict=True):
            if len(message) > size:
                info.update(pickle.loads(message[size:]))
        self.action_masks = rows["action_masks"].copy() if rows["has_masks"][0] else None
        return observations, rows["reward"].copy(), rows["done"].copy(), infos


class PackedSteps:
    """
    Steps a copy in its worker.

    :param env: the copy
    """

    def __init__(self, env: JointEnv):
        self._env = env
        dtype = row_type(env.observation_spaces, env.action_spaces, env.scripted_action_spaces)
        self._row = np.zeros((), dtype=dtype)
        # Views of the row, to be filled
        self._observations = [(agent, self._row["observations"][str(i)]) for i, agent in enumerate(env.observation_spaces)]
        self._parts = {name: self._row[name] for name in dtype.names or ()}

    def __call__(self, actions: tuple[Any, ...]) -> bytes:
        """
        :param actions: of the agents, in order
        :return: the row, with the observations and masks of the new episode if one has ended, and if the infos hold anything
            else, that as a pickle
        """
        parts = self._parts
        joint_action = dict(zip(self._env.possible_agents, actions, strict=True))
        obs, reward, done, record, masks, others = step_and_reset(self._env, joint_action)
        for agent, part in self._observations:
            part[...] = obs[agent]
        parts["reward"][...], parts["done"][...] = reward, done
        parts["agent_rewards"][...], parts["visible"][...] = record.agent_rewards, record.visible
        parts["active"][...], parts["life_end"][...], parts["truncated"][...] = record.flags
        if record.scripted_actions is not None:
            parts["scripted_actions"][...] = record.scripted_actions
        parts["has_masks"][...] = masks is not None
        if masks is not None:
            parts["action_masks"][...] = masks
        return self._row.tobytes() + pickle.dumps(others) if others else self._row.tobytes()


class _Channel:
    """
    A worker's end of its pipe as SB3's worker loop knows it. Steps are answered here, all other commands are left to that.

    :param connection: the end itself
    :param env: the worker's copy
    """

    def __init__(self, connection: Connection, env: JointEnv):
        self._connection, self._env = connection, env
        self._steps: PackedSteps | None = None
        self.send, self.close = connection.send, connection.close

    def recv(self) -> Any:
        """
        :return: the next command that is no step
        """
        while (message := self._connection.recv_bytes()).startswith(_STEP):
            # Made at the first step: by then the main process has seen that a team can have these spaces
            self._steps = self._steps or PackedSteps(self._env)
            self._connection.send_bytes(self._steps(pickle.loads(message[len(_STEP) :])))
        return pickle.loads(message)


def _serve(connection: Connection, parent_end: Connection, env_fn: CloudpickleWrapper) -> None:
    """
    What a worker process does until its pipe is closed.

    :param connection: its end of the pipe
    :param parent_end: the other end
    :param env_fn: makes its copy
    """
    # SB3's loop would end and the environment with it
    leave_interrupts_to_main()
    # Before the environment, which may start processes of its own
    parent_end.close()
    env = env_fn.var()
    channel: Any = _Channel(connection, env)
    _worker(channel, parent_end, CloudpickleWrapper(lambda: env))


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Hold Ctrl-C back until the end of the block, where the system can."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    previous = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous)
