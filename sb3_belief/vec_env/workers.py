"""
Copies of a team environment in worker processes: SB3's ``SubprocVecEnv``, with each step sent back as one row of bytes.

What can go wrong in a worker is told here in the same way as if the copy were in this process: what the environment raises is
raised, and a worker that dies or hangs is named, with its copy and step.
"""

import pickle
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from sb3_belief.common.processes import (
    WorkerError,
    WorkerTimeoutError,
    check_may_have_workers,
    is_dead,
    kill_workers,
    uninterrupted,
)
from sb3_belief.common.sent_errors import SentError, rebuilt_error
from sb3_belief.vec_env.joint_env import JointEnv
from sb3_belief.vec_env.observation_forms import ObservationStack
from sb3_belief.vec_env.restarts import LastStep, Restarts, cut_step
from sb3_belief.vec_env.validation import place
from sb3_belief.vec_env.worker_line import WorkerLine, close_lines
from sb3_belief.vec_env.worker_loop import FAILED, STEP
from sb3_belief.vec_env.worker_rows import RowPacker, RowReader


class WorkersVecEnv(SubprocVecEnv):
    """
    SB3's ``SubprocVecEnv`` for joint environments, with its own messages for steps.

    The workers leave Ctrl-C to the main process.

    :param env_fns: One callable for each copy, which makes its ``JointEnv``
    :param step_timeout: Seconds within which a worker must answer; None for no limit
    :param restart_workers: How often a worker of a copy may be replaced
    """

    # Set by set_members()
    _rows: RowReader
    _stack: ObservationStack

    def __init__(self, env_fns: Sequence[Callable[[], JointEnv]], step_timeout: float | None = None, restart_workers: int = 0):
        check_may_have_workers('vec_env="subproc"', 'vec_env="dummy"')
        self.waiting = self.closed = False
        self.restarts = Restarts(len(env_fns), restart_workers)
        #: How many steps each copy's episode has had, for messages
        self.steps_so_far: Callable[[], Any] = lambda: [0] * len(env_fns)
        # Seconds of the longest step, and copies whose worker does not answer
        self._longest, self._at_fault = 0.0, set[int]()
        # SB3's constructor is not called, because it would start its own function in the workers. Otherwise this does the same
        self._lines: list[WorkerLine] = []
        try:
            for copy, env_fn in enumerate(env_fns):
                self._lines.append(WorkerLine(copy, env_fn, step_timeout, self._on_fault))
            self.processes = [line.process for line in self._lines]
            self.remotes: Any = tuple(self._lines)
            self.remotes[0].send(("get_spaces", None))
            VecEnv.__init__(self, len(env_fns), *self.remotes[0].recv())
        except BaseException:
            self._end_all()
            raise

    @property
    def agent_rewards(self) -> np.ndarray:
        """Rewards of the last step, float32 ``[num_envs, n]``."""
        return self._rows.agent_rewards

    @property
    def action_masks(self) -> np.ndarray | None:
        """Masks for the next actions, those of all agents side by side, bool ``[num_envs, width]``; None without masks."""
        return self._rows.action_masks

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
        self._members = observation_spaces, action_spaces, scripted_action_spaces
        self._stack = ObservationStack(self.num_envs, observation_spaces)
        self._rows = RowReader(*self._members)

    def step(self, actions: Any) -> VecEnvStepReturn:
        """
        Step all copies.

        Ctrl-C can interrupt the wait for the workers, but not the transfer of a message. An interrupted step is finished
        before the next command is sent.

        :param actions: For each copy, the actions by agent
        :return: As for :meth:`step_wait`
        :raises WorkerError: If a worker has died, or has not answered in time
        :raises BaseException: What an environment raised
        """
        self.finish_step()
        started = time.monotonic()
        with uninterrupted():
            self.step_async(actions)
        step = self.step_wait()
        seconds = time.monotonic() - started
        if seconds > self._longest:
            self._longest = seconds
            for line in self._lines:
                line.longest = seconds
        return step

    def step_async(self, actions: Any) -> None:
        """
        Send the actions to the workers.

        :param actions: For each copy, the actions by agent
        """
        self._check_open("step")
        self._at_fault = set()
        for line, chosen in zip(self._lines, actions, strict=True):
            try:
                line.post("step", STEP + pickle.dumps(tuple(chosen.values())))
            except OSError:
                # A dead worker is found when its answer is missing
                continue

    def step_wait(self) -> VecEnvStepReturn:
        """
        Receive the results of a step from all workers.

        :return: Observations ``[num_envs, ...]`` by agent, rewards float32 ``[num_envs]``, dones bool ``[num_envs]`` and infos
            as those of a ``TeamVecEnv``
        """
        self._await_steps()
        with uninterrupted():
            messages = self._take(as_bytes=True)
        size = self._rows.size
        failed = [copy for copy, each in enumerate(messages) if len(each) != size and each.endswith(FAILED)]
        if failed or self._at_fault:
            errors = {copy: rebuilt_error(pickle.loads(messages[copy])) for copy in failed}
            for copy, (obs, info) in self._restart("step", errors, {}).items():
                messages[copy] = self._cut_row(copy, obs, info.get("action_masks"))
        step: Any = self._rows.read(messages)
        self.restarts.last = LastStep(step[0], step[2], step[3])
        return step

    def _await_steps(self) -> None:
        # The last worker to start is likely the last to finish, so waiting for it first wakes this process only once
        for line in reversed(self._lines):
            try:
                if not line.wait():
                    # The time of the others is over, too
                    self._at_fault.add(line.copy)
            except EOFError:
                self._at_fault.add(line.copy)
                if not self.restarts.limit:
                    # The others need not finish
                    return

    def _take(self, as_bytes: bool) -> list[Any]:
        """Return the answers of all workers, something empty for those at fault."""
        answers: list[Any] = []
        for line in self._lines:
            answer: Any = b""
            if not self._at_fault or (line.copy not in self._at_fault and self.restarts.limit):
                try:
                    answer = line.take(as_bytes)
                except (EOFError, OSError):
                    self._at_fault.add(line.copy)
            answers.append(answer)
        return answers

    def _cut_row(self, copy: int, obs: dict[str, Any], masks: np.ndarray | None) -> bytes:
        """Return the answer to a step that broke off."""
        return RowPacker(*self._members).pack(*cut_step(copy, self.restarts.last, self._members[2], obs, masks))

    def finish_step(self) -> None:
        """Receive and discard the answers to an interrupted command, if there is one."""
        for line in self._lines:
            if line.pending is not None:
                line.drain()

    def reset(self) -> Any:
        self._check_open("reset")
        self.finish_step()
        self._at_fault = set()
        self.restarts.keep_seeds(self._seeds)
        commands = {copy: ("reset", data) for copy, data in enumerate(zip(self._seeds, self._options, strict=True))}
        with uninterrupted():
            for line in self._lines:
                with suppress(OSError):
                    line.post("reset", commands[line.copy])
        self._await_steps()
        with uninterrupted():
            answers = self._take(as_bytes=False)
        errors = {copy: rebuilt_error(each) for copy, each in enumerate(answers) if isinstance(each, SentError)}
        if errors or self._at_fault:
            for copy, answer in self._restart("reset", errors, dict(enumerate(self._options))).items():
                answers[copy] = answer
        # As in SB3, which cannot stack nested dicts
        observations, self.reset_infos = zip(*answers, strict=True)  # type: ignore[assignment]
        self._reset_seeds()
        self._reset_options()
        stacked = self._stack(observations)
        self.restarts.last = LastStep(stacked)
        return stacked

    def close(self) -> None:
        """
        End the workers, which close their environments first. None that hangs is waited for.

        :raises BaseException: What an environment raised as it was closed
        """
        if self.closed:
            return
        self.closed = True
        for error in close_lines(self._lines):
            raise error

    def _get_target_remotes(self, indices: VecEnvIndices) -> list[Any]:
        self._check_open("do that")
        return super()._get_target_remotes(indices)

    # Faults

    def _check_open(self, doing: str) -> None:
        if self.closed:
            raise RuntimeError(f"Cannot {doing}: the environment is closed, its worker processes have ended.")

    def _restart(
        self, doing: str, errors: dict[int, BaseException], options: dict[int, Any]
    ) -> dict[int, tuple[dict[str, Any], dict[str, Any]]]:
        """
        Make the copies anew that have raised an error or whose worker is at fault, or raise what has happened.

        :param doing: What they were to do
        :param errors: What environments have raised
        :param options: Of their next reset
        :return: What the reset of each of them returned
        """
        causes = {copy: errors[copy] if copy in errors else None for copy in sorted(self._at_fault | errors.keys())}
        if not all(map(self.restarts.allow, causes)):
            raise self._broken(doing) if self._at_fault else errors[min(errors)]
        return {copy: self._restarted(copy, doing, error, options.get(copy)) for copy, error in causes.items()}

    def _restarted(self, copy: int, doing: str, error: BaseException | None, options: Any) -> Any:
        line, step = self._lines[copy], self._step_number(copy, doing)
        while True:
            cause = line.fault(doing) if error is None else error
            if not self.restarts.allow(copy):
                raise self._ended([cause], doing, [copy]) if isinstance(cause, WorkerError) else cause
            seed = self.restarts.count(copy, step, cause)
            close_lines([line])
            line.start()
            self.processes[copy] = line.process
            error = None
            try:
                line.post("reset", ("reset", (seed, options)))
                if line.wait():
                    with uninterrupted():
                        answer = line.take()
                    if not isinstance(answer, SentError):
                        return answer
                    error = rebuilt_error(answer)
            except (EOFError, OSError):
                pass
            doing = "reset"

    def _step_number(self, copy: int, doing: str) -> int:
        return {"reset": 0}.get(doing, int(self.steps_so_far()[copy]) + (doing == "step"))

    def _broken(self, doing: str) -> WorkerError:
        """Return the error for workers that are at fault, of which at least one is known."""
        for line in self._lines:
            if line.copy not in self._at_fault:
                # It may have died of the same cause
                line.process.join(0.1)
                if is_dead(line.process):
                    self._at_fault.add(line.copy)
        copies = sorted(self._at_fault)
        return self._ended([self._lines[copy].fault(doing) for copy in copies], doing, copies)

    def _on_fault(self, line: WorkerLine, fault: WorkerError) -> WorkerError:
        # The command is named in the fault
        return self._ended([fault], "", [line.copy])

    def _ended(self, faults: Sequence[BaseException], doing: str, copies: Sequence[int]) -> WorkerError:
        """End all workers, and return the error that says what has happened."""
        where = [place(copy, self._step_number(copy, doing)) for copy in copies]
        self._end_all()
        kind = next((type(fault) for fault in faults if isinstance(fault, WorkerTimeoutError)), WorkerError)
        told = "; ".join(f"{fault} {at}" for fault, at in zip(faults, where, strict=True))
        return kind(
            f"{told}. See its own error above, if it could write one. The other workers have been"
            " ended: make a new environment to continue."
        )

    def _end_all(self) -> None:
        self.closed = True
        kill_workers(line.process for line in self._lines)
        for line in self._lines:
            line.close()
