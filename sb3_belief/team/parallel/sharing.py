"""
A team's agents on several cores.

Agents are independent, so those with on-policy algorithms can learn at once, each group in a process of its own (see
``remote_agents``). An agent whose model is looked at meanwhile, by a callback of its own or one of the team not from SB3,
stays here. Of those, only ``train()`` runs in a worker: each waits for the others', and is then run in this process or, with
the model as it is, in the agent's worker. What is learned, drawn and logged is the same, bit for bit.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from typing import TYPE_CHECKING, Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_belief.common.rng import RngState
from sb3_belief.team.batched_forward import batched_forwards
from sb3_belief.team.lockstep.scheduler import UPDATES, UPDATES_HERE, AgentTask
from sb3_belief.team.parallel.remote_agents import RemoteAgents, can_learn_elsewhere, leaves_models_alone
from sb3_belief.team.parallel.updating import REPLACED, pack_of, read_stream, unpack_result, write_stream
from sb3_belief.team.parallel.workers import Workers

if TYPE_CHECKING:
    from sb3_belief.team.lockstep.joint_loop import JointLoop


def check_jobs(jobs: Any) -> int:
    """
    :param jobs: given as the number of processes
    :return: the same
    :raises ValueError: if it is none
    """
    if not isinstance(jobs, int) or isinstance(jobs, bool) or jobs < 1:
        raise ValueError(f"jobs is {jobs!r}; it must be a whole number of at least 1: the processes that work for the agents.")
    return jobs


class ParallelLearning:
    """
    Who learns in which process: the n-th on-policy agent in process n modulo their number, the last of which is this one.

    :param models: of the team, by agent; those that are not on-policy are left alone
    :param streams: what they draw from
    :param jobs: number of processes, this one among them; more than there are on-policy agents are not used
    :raises ValueError: if there are several, and a model is not on the CPU
    """

    def __init__(self, models: Mapping[str, BaseAlgorithm], streams: Mapping[str, RngState], jobs: int):
        self._models, self._streams, self._jobs = models, streams, check_jobs(jobs)
        self._workers = Workers()
        self._remote_groups: list[RemoteAgents] = []
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

    def sync_models(self) -> None:
        """Make the models here what they are where they learn."""
        for group in self._remote_groups:
            group.look()

    @contextmanager
    def distribute(
        self, scheduler: "JointLoop", tasks: Mapping[str, AgentTask], learn: Callable[..., None], callback: BaseCallback
    ) -> Iterator[Sequence[RemoteAgents]]:
        """
        Within the block policies act together, and several processes work for the agents. Workers go on waiting for the next
        block, unless an error ends this one.

        :param hub: in which the agents learn
        :param members: they
        :param learn: runs ``learn()`` of a model with a callback
        :param callback: the team's
        :return: the agents that learn in other processes
        :raises ValueError: if a model cannot be sent to another process
        """
        models = self._on_policy()
        # A user may have replaced a model's train() in the same way as is done here, which can then run here only
        shared = [agent for agent, model in models.items() if "train" not in vars(model)]
        n_processes = min(self._jobs, len(shared))
        # None: this process
        workers = {agent: i % n_processes if (i + 1) % n_processes else None for i, agent in enumerate(shared)}
        away: dict[int, dict[str, BaseAlgorithm]] = {}
        for agent, worker in workers.items() if leaves_models_alone(callback) else ():
            can_go = tasks[agent].callback is None and can_learn_elsewhere(models[agent], scheduler, agent)
            if worker is not None and can_go:
                away.setdefault(worker, {})[agent] = models[agent]
        gone = {agent for those in away.values() for agent in those}
        updated = {agent: worker for agent, worker in workers.items() if n_processes > 1 and agent not in gone}
        if n_processes > 1:
            self._start({agent: models[agent] for agent in updated}, n_processes - 1)
        try:
            for agent, worker in updated.items():
                self._share_update(scheduler, agent, models[agent], worker)
            self._remote_groups = [
                RemoteAgents(scheduler, self._workers, i, those, self._streams, learn) for i, those in away.items()
            ]
            with batched_forwards(scheduler, {agent: model for agent, model in models.items() if agent not in gone}):
                yield self._remote_groups
            for group in self._remote_groups:
                group.close()
        except BaseException:
            try:
                # What a worker that is dead or has failed cannot give back stays as it was
                for group in self._remote_groups:
                    with suppress(Exception):
                        group.close()
            finally:
                self._workers.end()
            raise
        finally:
            self._remote_groups = []
            for agent in updated:
                for name in REPLACED:
                    vars(models[agent]).pop(name, None)

    def _start(self, models: Mapping[str, OnPolicyAlgorithm], n_workers: int) -> None:
        if not self._workers:
            for agent, model in models.items():
                # Said now rather than after a first long rollout
                pack_of(agent, model)
        self._workers.start(n_workers)

    def _share_update(self, scheduler: "JointLoop", agent: str, model: OnPolicyAlgorithm, worker: int | None) -> None:
        excluded = [*model._excluded_save_params(), *REPLACED]
        # A model that is saved meanwhile is saved as always
        model._excluded_save_params = partial(list, excluded)  # type: ignore[method-assign]
        if worker is None:
            model.train = partial(_train_here, scheduler, agent, model)  # type: ignore[method-assign]
        else:
            model.train = partial(self._train, scheduler, agent, model, worker)  # type: ignore[method-assign]

    def _train(self, scheduler: "JointLoop", agent: str, model: OnPolicyAlgorithm, worker: int) -> None:
        """What ``model.train`` is, in the agent's own coroutine and random stream, for those updated in a worker."""
        if not scheduler.is_round_of(agent):
            type(model).train(model)
            return
        self._workers.send(worker, agent, pack_of(agent, model))
        scheduler.wait(agent, UPDATES)
        unpack_result(model, self._workers.receive(worker, agent))


def _train_here(scheduler: "JointLoop", agent: str, model: OnPolicyAlgorithm) -> None:
    """The same for those updated in this process."""
    if not scheduler.is_round_of(agent):
        type(model).train(model)
        return
    # Not before the workers have something to do as well
    scheduler.wait(agent, UPDATES_HERE)
    type(model).train(model)
    # A normal number that numpy keeps back would be lost while others draw
    stream = read_stream()
    scheduler.wait(agent, UPDATES)
    write_stream(stream)
