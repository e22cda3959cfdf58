"""
Copies of a team environment in worker processes: SB3's ``SubprocVecEnv``, with each step sent back as one row of bytes.

The results of a step have the same shapes and types at every step. A worker therefore packs them into one row of a structured
array, and the main process reads the rows of all copies as a single array. Pickling a step's dictionaries, arrays and records
one by one and stacking them again took most of the time that workers cost.
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

from sb3_belief.common.processes import Inbox, check_may_have_workers, leave_interrupts_to_main, start_context
from sb3_belief.vec_env.action_masks import mask_width
from sb3_belief.vec_env.joint_env import JointEnv, step_and_reset
from sb3_belief.vec_env.observation_forms import parts_of
from sb3_belief.vec_env.team_vec_env import ObservationStack

# Messages with a step's actions begin with this byte; all other messages are pickles, which begin with another one
_STEP = b"s"
# Fields of a row that become entries of infos; step_wait() relies on agent_rewards being the first
_INFO_FIELDS = ("agent_rewards", "visible", "active", "life_end", "truncated")


def row_type(
    observation_spaces: dict[str, spaces.Space],
    action_spaces: dict[str, spaces.Space],
    scripted_action_spaces: dict[str, spaces.Space],
) -> np.dtype:
    """
    Return the structured type of a row, which holds a joint step of one copy.

    :param observation_spaces: Observation space of each agent
    :param action_spaces: Action space of each agent
    :param scripted_action_spaces: Action space of each scripted other
    :return: The type; in ``observations``, the field of an agent has its number as its name, and so have the fields of the
        entries of a dict within it
    """
    n = len(observation_spaces)
    observations = [(str(i), *_field(space)) for i, space in enumerate(observation_spaces.values())]
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


def _field(space: spaces.Space) -> tuple[Any, ...]:
    """Return type and, except for a dict, shape of the field of an agent's observations."""
    if isinstance(space, spaces.Dict):
        return ([(str(j), *_field(part)) for j, part in enumerate(space.spaces.values())],)
    return space.dtype, space.shape or ()


class WorkersVecEnv(SubprocVecEnv):
    """
    SB3's ``SubprocVecEnv`` for joint environments, with its own messages for steps.

    The workers leave Ctrl-C to the main process.

    :param env_fns: One callable for each copy, which makes its ``JointEnv``
    """

    # Rewards of the last step, float32 [num_envs, n]
    agent_rewards: np.ndarray
    # Masks for the next actions, those of all agents side by side, bool [num_envs, sum of their widths]; None without masks
    action_masks: np.ndarray | None = None

    def __init__(self, env_fns: list[Callable[[], JointEnv]]):
        check_may_have_workers('vec_env="subproc"', 'vec_env="dummy"')
        self.waiting = self.closed = False
        # SB3's constructor is not called, because it would start its own function in the workers. Otherwise this does the same
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
        self._observation_spaces: dict[str, spaces.Space] = {}
        self._row_type = np.dtype([])

    def set_members(
        self,
        observation_spaces: dict[str, spaces.Space],
        action_spaces: dict[str, spaces.Space],
        scripted_action_spaces: dict[str, spaces.Space],
    ) -> None:
        """
        Set agents and spaces, once they are known to be the same in all copies.

        :param observation_spaces: Observation space of each agent
        :param action_spaces: Action space of each agent
        :param scripted_action_spaces: Action space of each scripted other
        """
        self._observation_spaces = observation_spaces
        self._stack = ObservationStack(self.num_envs, observation_spaces)
        self._row_type = row_type(observation_spaces, action_spaces, scripted_action_spaces)
        self._info_names = _INFO_FIELDS + ("scripted_actions",) * bool(scripted_action_spaces)

    def step(self, actions: Any) -> VecEnvStepReturn:
        """
        Step all copies.

        Ctrl-C can interrupt the wait for the workers, but not the transfer of a message. An interrupted step is finished
        before the next command is sent.

        :param actions: For each copy, the actions by agent
        :return: As for :meth:`step_wait`
        :raises RuntimeError: If a worker has died
        """
        self.finish_step()
        with self._reports_deaths("step"):
            with _uninterrupted():
                self.step_async(actions)
            self._await_steps()
            with _uninterrupted():
                return self.step_wait()

    def finish_step(self) -> None:
        """Receive and discard the results of an interrupted step, if there is one."""
        if self.waiting:
            with self._reports_deaths("step"):
                self._await_steps()
                self.step_wait()

    def _await_steps(self) -> None:
        # The last worker to start is likely the last to finish, so waiting for it first wakes this process only once
        for inbox in reversed(self.inboxes):
            inbox.wait()

    def reset(self) -> Any:
        self.finish_step()
        with self._reports_deaths("reset"):
            # As in SB3, which cannot stack nested dicts
            for remote, seed, options in zip(self.remotes, self._seeds, self._options, strict=True):
                remote.send(("reset", (seed, options)))
            observations, self.reset_infos = zip(*[remote.recv() for remote in self.remotes], strict=True)  # type: ignore
        self._reset_seeds()
        self._reset_options()
        return self._stack(observations)

    def close(self) -> None:
        self.finish_step()
        super().close()

    def _get_target_remotes(self, indices: VecEnvIndices) -> list[Any]:
        # SB3 calls this before each command to the environments (get_attr, env_method, ...), so none of them receives the
        # results of an interrupted step in place of its own
        self.finish_step()
        return super()._get_target_remotes(indices)

    @contextmanager
    def _reports_deaths(self, doing: str) -> Iterator[None]:
        """
        If a worker dies within the block, end the others and say which one it was.

        :param doing: Name of the method, for the message
        """
        try:
            yield
        except (EOFError, OSError) as error:
            if self.closed:
                raise RuntimeError(f"Cannot {doing}: the environment is closed, its worker processes have ended.") from error
            # A process that has closed its pipe may take a moment to end
            for process in self.processes:
                process.join(0.1)
            dead = [f"{i} (exit code {p.exitcode})" for i, p in enumerate(self.processes) if not p.is_alive()]
            self._end_all()
            raise RuntimeError(
                f"Environment worker process {', '.join(dead) or 'unknown'} died during {doing}(); see its own error above,"
                " if it could write one. The other workers have been ended: make a new environment to continue."
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
        Send the actions to the workers.

        :param actions: For each copy, the actions by agent
        """
        for remote, chosen in zip(self.remotes, actions, strict=True):
            remote.send_bytes(_STEP + pickle.dumps(tuple(chosen.values())))
        self.waiting = True

    def step_wait(self) -> VecEnvStepReturn:
        """
        Receive the results of a step from all workers.

        :return: Observations ``[num_envs, ...]`` by agent, rewards float32 ``[num_envs]``, dones bool ``[num_envs]`` and infos
            as those of a ``TeamVecEnv``
        """
        messages = [remote.recv_bytes() for remote in self.remotes]
        self.waiting = False
        size = self._row_type.itemsize
        rows = np.frombuffer(b"".join([message[:size] for message in messages]), dtype=self._row_type)
        # Copies, since rows are read-only, and whoever kept a view of one field would keep the whole array alive
        observations = {
            agent: _unpacked(rows["observations"][str(i)], space)
            for i, (agent, space) in enumerate(self._observation_spaces.items())
        }
        columns = [rows[name].copy() for name in self._info_names]
        self.agent_rewards = columns[0]
        infos = [dict(zip(self._info_names, entries, strict=True)) for entries in zip(*columns, strict=True)]
        # A worker appends a pickle to its row where the infos hold more, as they do at the end of an episode
        for info, message in zip(infos, messages, strict=True):
            if len(message) > size:
                info.update(pickle.loads(message[size:]))
        self.action_masks = rows["action_masks"].copy() if rows["has_masks"][0] else None
        return observations, rows["reward"].copy(), rows["done"].copy(), infos


def _unpacked(field: np.ndarray, space: spaces.Space) -> Any:
    """Copy an agent's observations out of the rows of all copies."""
    if isinstance(space, spaces.Dict):
        return {key: field[str(j)].copy() for j, key in enumerate(space.spaces)}
    return field.copy()


class PackedSteps:
    """
    Steps of one copy in its worker, each packed into a row.

    :param env: The copy
    """

    def __init__(self, env: JointEnv):
        self._env = env
        dtype = row_type(env.observation_spaces, env.action_spaces, env.scripted_action_spaces)
        self._row = np.zeros((), dtype=dtype)
        # Views of the row, made once: each step writes into them
        self._observations: list[tuple[str, str | None, np.ndarray]] = []
        for i, (agent, space) in enumerate(env.observation_spaces.items()):
            field = self._row["observations"][str(i)]
            for j, key in enumerate(parts_of(space)):
                self._observations.append((agent, key, field if key is None else field[str(j)]))
        self._fields = {name: self._row[name] for name in dtype.names or ()}

    def __call__(self, actions: tuple[Any, ...]) -> bytes:
        """
        Step the copy, and reset it if its episode ends.

        :param actions: Actions of the agents, in order
        :return: The row, followed by a pickle of what the infos hold that has no field in it, if anything. Where an episode
            has ended, observations and masks are those of the new one
        """
        fields = self._fields
        joint_action = dict(zip(self._env.possible_agents, actions, strict=True))
        obs, reward, done, record, masks, others = step_and_reset(self._env, joint_action)
        for agent, key, field in self._observations:
            field[...] = obs[agent] if key is None else obs[agent][key]
        fields["reward"][...], fields["done"][...] = reward, done
        fields["agent_rewards"][...], fields["visible"][...] = record.agent_rewards, record.visible
        fields["active"][...], fields["life_end"][...], fields["truncated"][...] = record.flags
        if record.scripted_actions is not None:
            fields["scripted_actions"][...] = record.scripted_actions
        fields["has_masks"][...] = masks is not None
        if masks is not None:
            fields["action_masks"][...] = masks
        return self._row.tobytes() + pickle.dumps(others) if others else self._row.tobytes()


class _Channel:
    """
    Connection to the main process that answers the commands to step, and passes all others to SB3's worker loop.

    :param connection: The worker's end of its pipe
    :param env: The worker's copy
    """

    def __init__(self, connection: Connection, env: JointEnv):
        self._connection, self._env = connection, env
        self._steps: PackedSteps | None = None
        self.send, self.close = connection.send, connection.close

    def recv(self) -> Any:
        """
        Answer commands to step until another command arrives.

        :return: That command
        """
        while (message := self._connection.recv_bytes()).startswith(_STEP):
            # Made at the first step: by then the main process has checked that a team can have these spaces
            self._steps = self._steps or PackedSteps(self._env)
            self._connection.send_bytes(self._steps(pickle.loads(message[len(_STEP) :])))
        return pickle.loads(message)


def _serve(connection: Connection, parent_end: Connection, env_fn: CloudpickleWrapper) -> None:
    """
    Run a worker process until its pipe is closed.

    :param connection: The worker's end of the pipe
    :param parent_end: The main process's end of the pipe
    :param env_fn: Makes the worker's copy
    """
    # At Ctrl-C SB3's loop would end, and the environment with it
    leave_interrupts_to_main()
    # Closed before the environment is made, since processes that it starts would inherit this end
    parent_end.close()
    env = env_fn.var()
    channel: Any = _Channel(connection, env)
    _worker(channel, parent_end, CloudpickleWrapper(lambda: env))


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Delay Ctrl-C until the end of the block, on systems that can."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    previous = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous)
