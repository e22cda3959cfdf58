"""``TeamVecEnv`` over copies of a PettingZoo ``ParallelEnv``, in this process or in workers, held by SB3's own vectorisers."""

import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from sb3_belief.vec_env.joint_env import JointEnv, mask_width
from sb3_belief.vec_env.team_vec_env import TeamObs, TeamStep, TeamVecEnv, check_spaces
from sb3_belief.vec_env.validation import StepChecks
from sb3_belief.vec_env.workers import WorkersVecEnv, step_and_reset


class ParallelTeamVecEnv(TeamVecEnv):
    """
    Copies of a team environment, each a ``JointEnv`` in SB3's ``DummyVecEnv`` or ``SubprocVecEnv``.

    A worker process that dies ends the environment with a ``RuntimeError`` that says which; the other workers are ended too.
    Ctrl-C is left to the main process: workers ignore it, and an interrupted step is finished before the next one.

    :param env_fns: one callable per copy that makes its ``JointEnv``
    :param subproc: one worker process per copy instead of stepping them in turn here
    :raises ValueError: for names or spaces that a team cannot have, or that are not the same in all copies
    """

    def __init__(self, env_fns: Sequence[Callable[[], JointEnv]], subproc: bool = False):
        self.venv: _InProcessVecEnv | WorkersVecEnv
        self._masks: np.ndarray | None = None
        if subproc:
            self.venv = WorkersVecEnv(list(env_fns))
        else:
            envs = [env_fn() for env_fn in env_fns]
            if len({id(env.env) for env in envs}) < len(envs):
                raise ValueError("The copies are one and the same environment: return a new one at each call.")
            # Before DummyVecEnv stumbles over them
            first = envs[0]
            check_spaces(first.possible_agents, first.observation_spaces, first.action_spaces, first.scripted_action_spaces)
            self.venv = _InProcessVecEnv([partial(_same, env) for env in envs])
            self.venv.layout = [
                (agent, (len(envs), *(space.shape or ())), space.dtype) for agent, space in first.observation_spaces.items()
            ]
        try:
            agents, self._observation_spaces, self._action_spaces, scripted = self._common_members()
            super().__init__(
                len(env_fns), agents, self._observation_spaces, self._action_spaces, self.venv.render_mode, scripted
            )
        except BaseException:
            self.venv.close()
            raise
        if isinstance(self.venv, WorkersVecEnv):
            self.venv.set_members(self._observation_spaces, self._action_spaces, self.scripted_action_spaces)
        self._discrete = [isinstance(self._action_spaces[agent], spaces.Discrete) for agent in agents]
        self._mask_widths = [mask_width(self._action_spaces[agent]) for agent in agents]
        self._checks = StepChecks(agents, self._observation_spaces, self._action_spaces, self._mask_widths)

    def _common_members(self) -> list[Any]:
        """
        :return: names of the agents, their observation spaces and action spaces, and the scripted others' action spaces
        """
        members = []
        for name in ("possible_agents", "observation_spaces", "action_spaces", "scripted_action_spaces"):
            first, *others = self.venv.get_attr(name)
            for copy, other in enumerate(others, start=1):
                if other != first:
                    raise ValueError(
                        f"All copies must have the same {name}, but those of environment copy {copy} are {other} and those of"
                        f" copy 0 are {first}."
                    )
            members.append(first)
        return members

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """
        :param seed: copy i gets ``seed + i`` at its next reset
        :return: the copies' seeds
        """
        return self.venv.seed(seed)

    def set_options(self, options: list[dict] | dict | None = None) -> None:
        """
        :param options: handed to the copies at their next reset
        """
        self.venv.set_options(options)

    def action_masks(self) -> dict[str, np.ndarray] | None:
        """
        :return: {agent: bool [num_envs, k]} for the current observation, or None if the environment gives no masks
        """
        if self._masks is None:
            return None
        parts = np.split(self._masks, np.cumsum(self._mask_widths)[:-1], axis=1)
        columns = zip(self.possible_agents, parts, self._mask_widths, strict=True)
        return {agent: part for agent, part, width in columns if width}

    def close(self) -> None:
        """End the workers or close the copies."""
        super().close()
        self._finish_interrupted_step()
        self.venv.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        return self.venv.get_images()

    def has_attr(self, attr_name: str) -> bool:
        # As SB3 asks worker processes, which do not survive being asked for the value of what they do not have
        self._finish_interrupted_step()
        return attr_name == "action_masks" or self.venv.has_attr(attr_name)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        if attr_name == "action_masks":
            return super().get_attr(attr_name, indices)
        self._finish_interrupted_step()
        return self.venv.get_attr(attr_name, indices)

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        self.env_method("set_env_attr", attr_name, value, indices=indices)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        if method_name == "action_masks":
            return super().env_method(method_name, indices=indices)
        self._finish_interrupted_step()
        return self.venv.env_method(method_name, *method_args, indices=indices, **method_kwargs)

    def _reset_joint(self) -> TeamObs:
        self._finish_interrupted_step()
        with self._worker_deaths("reset"):
            obs = self.venv.reset()
        reset_infos = self.venv.reset_infos
        self._masks = None
        if "action_masks" in reset_infos[0]:
            self._masks = np.array([info["action_masks"] for info in reset_infos])
            self._checks.masks(self._masks, np.zeros(self.num_envs, dtype=int))
        return obs  # type: ignore[return-value]

    def _step_joint(self, actions: TeamObs) -> TeamStep:
        self._finish_interrupted_step()
        # Plain integers for Discrete: what PettingZoo environments are tested with
        columns = [
            (self._checks.number if discrete else self._checks.vector)(agent, actions[agent], self._lengths)
            for agent, discrete in zip(self.possible_agents, self._discrete, strict=True)
        ]
        joint_actions = [dict(zip(self.possible_agents, row)) for row in zip(*columns)]  # noqa: B905 (lengths are checked)
        if isinstance(self.venv, WorkersVecEnv):
            with self._worker_deaths("step"):
                obs, rewards, dones, infos = self._step_workers(self.venv, joint_actions)
        else:
            obs, rewards, dones, infos = self.venv.step(joint_actions)  # type: ignore[arg-type]
        self._checks.numbers(obs, self.venv.agent_rewards, self._lengths)
        if self.venv.action_masks is not None:
            self._masks = self.venv.action_masks
            self._checks.masks(self._masks, np.where(dones, 0, self._lengths + 1))
        return obs, rewards, dones, infos

    # Workers

    def _step_workers(self, venv: WorkersVecEnv, joint_actions: list[dict[str, Any]]) -> Any:
        # Nothing is sent or received by halves, the waiting between can be interrupted
        with _uninterrupted():
            venv.step_async(joint_actions)
        self._await_workers(venv)
        with _uninterrupted():
            return venv.step_wait()

    @staticmethod
    def _await_workers(venv: WorkersVecEnv) -> None:
        # The last to start is likely the last to finish: to wait for it first is to be woken once
        for inbox in reversed(venv.inboxes):
            inbox.wait()

    def _finish_interrupted_step(self) -> None:
        if isinstance(self.venv, WorkersVecEnv) and self.venv.waiting:
            with self._worker_deaths("step"):
                self._await_workers(self.venv)
                self.venv.step_wait()

    @contextmanager
    def _worker_deaths(self, doing: str) -> Iterator[None]:
        try:
            yield
        except (EOFError, OSError) as error:
            if not isinstance(self.venv, WorkersVecEnv):
                raise
            if self.venv.closed:
                raise RuntimeError(f"Cannot {doing}: the environment is closed, its worker processes have ended.") from error
            # A process that has closed its pipe may need a moment to end
            for process in self.venv.processes:
                process.join(0.1)
            dead = [f"{i} (exit code {p.exitcode})" for i, p in enumerate(self.venv.processes) if not p.is_alive()]
            self._end_workers(self.venv)
            raise RuntimeError(
                f"Environment worker process {', '.join(dead) or 'unknown'} died during {doing}(); see its own error above,"
                " if it could write one. The other workers have been ended: make a new environment to go on."
            ) from error

    def _end_workers(self, venv: WorkersVecEnv) -> None:
        for process in venv.processes:
            process.terminate()
        for process, remote in zip(venv.processes, venv.remotes, strict=True):
            process.join(5.0)
            remote.close()
        venv.waiting, venv.closed = False, True


class _InProcessVecEnv(DummyVecEnv):
    """
    SB3's ``DummyVecEnv`` for joint environments, without its deep copies.

    Observations are copied once, where they are stacked, and a ``JointEnv`` keeps nothing of its infos; the further copies
    would take more time than all else that a joint step needs besides the environment.
    """

    # Agent, shape and type of its stacked observations
    layout: list[tuple[str, tuple[int, ...], Any]]
    # As in WorkersVecEnv
    agent_rewards: np.ndarray
    action_masks: np.ndarray | None = None

    def step_wait(self) -> VecEnvStepReturn:
        """
        :return: observations {agent: array [num_envs, ...]}, rewards float32 [num_envs], dones bool [num_envs] and infos as
            a ``TeamVecEnv`` has them
        """
        steps = [step_and_reset(env, action) for env, action in zip(self.envs, self.actions, strict=True)]  # type: ignore[arg-type]
        observations, rewards, dones, records, masks, others = zip(*steps, strict=True)
        # concatenate() takes a third of the time of array()
        stack = partial(np.concatenate, axis=None, casting="unsafe")
        stacked = {
            agent: stack([obs[agent] for obs in observations], dtype=dtype).reshape(shape)
            for agent, shape, dtype in self.layout
        }
        self.agent_rewards = np.array([record.agent_rewards for record in records], dtype=np.float32)
        infos = []
        for record, own_rewards, other in zip(records, self.agent_rewards, others, strict=True):
            active, life_end, truncated = record.flags
            info = {
                "agent_rewards": own_rewards,
                "visible": record.visible,
                "active": active,
                "life_end": life_end,
                "truncated": truncated,
            }
            if record.scripted_actions is not None:
                info["scripted_actions"] = record.scripted_actions
            if other:
                info.update(other)
            infos.append(info)
        self.action_masks = None if masks[0] is None else np.array(masks)
        return stacked, np.array(rewards, dtype=np.float32), np.array(dones), infos


def _same(env: JointEnv) -> JointEnv:
    return env


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Hold Ctrl-C back, where the system can, until the block is through."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    previous = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous)
