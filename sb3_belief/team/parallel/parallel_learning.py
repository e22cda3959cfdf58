"""
A team's agents on several cores.

Agents are independent, so those with on-policy algorithms can learn at the same time: each group of them in a process of its
own, with the whole ``learn()`` of each agent (its policy, buffer, update and bookkeeping). Their models move to a worker when
a team begins to learn. From then on all that travels is each agent's part of the joint steps and its actions. The models come
back when the team has learned, or when they are accessed. What is learned, drawn and logged is the same as in one
process, bit for bit.
"""

import inspect
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_belief.common.exceptions import add_note
from sb3_belief.common.processes import check_may_have_workers
from sb3_belief.common.rng import RngState
from sb3_belief.team.batched_forward import batched_forwards
from sb3_belief.team.lockstep.joint_loop import JointLoop
from sb3_belief.team.lockstep.scheduler import AgentTask
from sb3_belief.team.model_parts import modules_of, optimizers_of
from sb3_belief.team.own_code import find_own_callback, runs_own_code
from sb3_belief.team.parallel.model_state import pack
from sb3_belief.team.parallel.remote_agents import RemoteAgents
from sb3_belief.team.parallel.workers import Workers

_HOOKS = ("_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks")


def check_jobs(jobs: Any) -> int:
    """
    Check a number of processes.

    :param jobs: What the user gave
    :return: The same
    :raises ValueError: If it is not a whole number of at least 1, or if this process may not start others
    """
    if not isinstance(jobs, int) or isinstance(jobs, bool) or jobs < 1:
        raise ValueError(f"jobs is {jobs!r}; it must be a whole number of at least 1: the processes that work for the agents.")
    if jobs > 1:
        check_may_have_workers(f"jobs={jobs}", "jobs=1")
    return jobs


def can_learn_elsewhere(model: OnPolicyAlgorithm, loop: JointLoop, agent: str, task: AgentTask) -> bool:
    """
    Tell whether nothing in this process takes part in an agent's learning.

    :param model: The agent's model
    :param loop: Its team's loop
    :param agent: Its name
    :param task: Its task
    :return: False for a callback of the agent's own, replaced methods, hooks in a network, and another environment than the
        team's
    """
    if task.callback is not None or model.env is None or model.env.unwrapped is not loop.agent_envs[agent]:
        return False
    modules = [module for _, module in modules_of(model)]
    for owner in (model, model.rollout_buffer, *modules, *optimizers_of(model).values()):
        if any(inspect.isroutine(getattr(type(owner), name, None)) for name in vars(owner)):
            return False
    return not any(vars(module)[hooks] for module in modules for hooks in _HOOKS)


class ParallelLearning:
    """
    Decides which agents learn in which process: the n-th on-policy agent in process n modulo their number, the last of which
    is the main process.

    :param models: The team's models by agent; those that are not on-policy stay in the main process
    :param rngs: Their random number generators
    :param jobs: Number of processes, the main one included; no more are used than there are on-policy agents
    :raises ValueError: If there are several, and a model is not on the CPU
    """

    def __init__(self, models: Mapping[str, BaseAlgorithm], rngs: Mapping[str, RngState], jobs: int):
        self._models, self._rngs, self._jobs = models, rngs, check_jobs(jobs)
        self._workers = Workers()
        self._groups: list[RemoteAgents] = []
        # Why this team is not whole, if its agents are not as far as each other
        self._mixed: str | None = None
        self._on_policy()

    def _on_policy(self) -> dict[str, OnPolicyAlgorithm]:
        found = {agent: model for agent, model in self._models.items() if isinstance(model, OnPolicyAlgorithm)}
        for agent, model in found.items():
            if min(self._jobs, len(found)) > 1 and model.device.type != "cpu":
                raise ValueError(
                    f"jobs={self._jobs} is for models on the CPU, but that of {agent!r} is on {model.device}: use jobs=1, or"
                    ' device="cpu".'
                )
        return found

    def begin(self, counts_anew: bool) -> None:
        """
        Check that the team is whole before it learns further.

        :param counts_anew: Whether its steps are counted from 0 on, so that its agents are what a new training begins with
        :raises ValueError: If a worker's end has left agents behind the others, and their steps are counted on
        """
        if counts_anew:
            self._mixed = None
        self._check_whole()

    def models_to_save(self) -> dict[str, BaseAlgorithm]:
        """
        Return the models of the team as they are now.

        :raises ValueError: If a worker's end has left agents behind the others
        """
        self._check_whole()
        self.sync_models()
        return dict(self._models)

    def _check_whole(self) -> None:
        if self._mixed is not None:
            raise ValueError(
                f"{self._mixed} One file, or one count of steps, would hide that: load the last checkpoint (Team.load), or"
                " begin a new training with these models by learn(..., reset_num_timesteps=True). A single model is saved by"
                " team.agents[agent].save(path)."
            )

    def _note_who_is_behind(self, error: BaseException) -> None:
        """Remember, and add to an error, whose models are not what they had become in a worker."""
        behind = {agent for group in self._groups for agent in group.behind}
        if behind:
            steps = {agent: model.num_timesteps for agent, model in self._models.items()}
            back = ", ".join(f"{agent!r} at step {steps[agent]}" for agent in steps if agent in behind)
            others = ", ".join(f"{agent!r} at step {steps[agent]}" for agent in steps if agent not in behind)
            self._mixed = (
                "The agents of this team are not equally far, because a worker process ended before its models came back: as"
                f" they were before are {back}; as far as they came are {others}."
            )
            add_note(error, self._mixed)

    def sync_models(self) -> None:
        """Bring the models in this process up to date with those in the workers."""
        for group in self._groups:
            group.sync()

    @contextmanager
    def distribute(
        self, loop: JointLoop, tasks: Mapping[str, AgentTask], learn: Callable[..., None], callback: BaseCallback
    ) -> Iterator[Sequence[RemoteAgents]]:
        """
        Let agents learn in workers within the block, and batch the forward passes of those that stay.

        Workers continue to wait for the next block, unless an error ends this one.

        :param loop: The team's loop
        :param tasks: The agents' tasks
        :param learn: Runs a model's ``learn()``, called with the model and a callback
        :param callback: The team's callback
        :return: The agents that learn in workers
        :raises ValueError: If a model cannot be sent to a worker
        """
        models = self._on_policy()
        by_worker = self._choose(models, loop, tasks, callback)
        away = {agent for group in by_worker.values() for agent in group}
        try:
            self._groups = [
                RemoteAgents(loop, self._workers, worker, group, self._rngs, learn) for worker, group in by_worker.items()
            ]
            here = {agent: model for agent, model in models.items() if agent not in away}
            with batched_forwards(
                loop, here, watches=runs_own_code([callback, *(task.callback for task in tasks.values())], here)
            ):
                yield self._groups
            for group in self._groups:
                group.close()
        except BaseException as error:
            try:
                # What a worker that is dead or has failed cannot send back stays as it was. One that hangs is not waited for
                deadline = self._workers.deadline()
                for group in self._groups:
                    with suppress(Exception):
                        group.close(deadline)
            finally:
                self._workers.end()
                self._note_who_is_behind(error)
            raise
        finally:
            self._groups = []

    def _choose(
        self,
        models: Mapping[str, OnPolicyAlgorithm],
        loop: JointLoop,
        tasks: Mapping[str, AgentTask],
        callback: BaseCallback,
    ) -> dict[int, dict[str, BaseAlgorithm]]:
        """Return the models that move to each worker, and start the workers."""
        n_processes = min(self._jobs, len(models))
        if n_processes <= 1:
            return {}
        own = find_own_callback(callback)
        if own is not None:
            name = getattr(own, "__name__", type(own).__name__)
            warnings.warn(
                f"All agents learn in one process, although jobs={self._jobs}: the team's callback {name} is not from SB3 or"
                " sb3-contrib, and may look at the models or change them at any step. Leave it out, or use jobs=1."
            )
            return {}
        chosen: dict[int, dict[str, BaseAlgorithm]] = {}
        for i, (agent, model) in enumerate(models.items()):
            worker = i % n_processes
            if worker < n_processes - 1 and can_learn_elsewhere(model, loop, agent, tasks[agent]):
                chosen.setdefault(worker, {})[agent] = model
        for group in chosen.values():
            for agent, learner in group.items():
                # Refused now, before any model has moved
                pack(agent, learner)
        if chosen:
            self._workers.start(n_processes - 1)
        return chosen
