"""
A team's agents on several cores.

On-policy algorithms collect a rollout and then call ``train()``. Agents are independent, so these calls can run at once: while
a team learns, ``train`` of each such model waits for the others', and is then run in this process or, with the model as it is,
in a worker process. What was updated there also chooses its actions there, see ``acting``. What is learned, drawn and logged
is the same, bit for bit.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_belief.team.jobs.acting import ActsElsewhere, ActsHere, can_act_elsewhere
from sb3_belief.team.jobs.messages import Message
from sb3_belief.team.jobs.updating import REPLACED, pack, read_stream, unpack_result, write_stream
from sb3_belief.team.jobs.workers import Workers
from sb3_belief.team.members import UPDATES, UPDATES_HERE
from sb3_belief.team.stacking import Part, Together

if TYPE_CHECKING:
    from sb3_belief.team.lockstep import Lockstep


def check_jobs(jobs: Any) -> int:
    """
    :param jobs: given as the number of processes
    :return: the same
    :raises ValueError: if it is none
    """
    if not isinstance(jobs, int) or isinstance(jobs, bool) or jobs < 1:
        raise ValueError(f"jobs is {jobs!r}; it must be a whole number of at least 1: the processes that work for the agents.")
    return jobs


class Jobs:
    """
    Who is updated, and then acts, in which process: the n-th on-policy agent in process n modulo their number, the last of
    which is this one.

    :param models: of the team, by agent; those that are not on-policy train within their own steps, and are left alone
    :param jobs: number of processes, this one among them; more than there are on-policy agents are not used
    :raises ValueError: if there are several, and a model is not on the CPU
    """

    def __init__(self, models: Mapping[str, BaseAlgorithm], jobs: int):
        self._models, self._jobs = models, check_jobs(jobs)
        self._workers = Workers()
        self._acts: dict[str, ActsElsewhere] = {}
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

    @contextmanager
    def shared_out(self, hub: "Lockstep") -> Iterator[None]:
        """
        Within the block policies act together, and several processes work for the agents. Workers go on waiting for the next
        block, unless an error ends this one.

        :param hub: in which the agents learn
        :raises ValueError: if a model cannot be sent to another process
        """
        models = self._on_policy()
        # A user may have replaced a model's train() in the same way as is done here, which can then run here only
        shared = [agent for agent, model in models.items() if "train" not in vars(model)]
        n_processes = min(self._jobs, len(shared))
        if n_processes > 1:
            self._start({agent: models[agent] for agent in shared}, n_processes - 1)
        else:
            shared = []
        # None: this process
        workers = {agent: i % n_processes if (i + 1) % n_processes else None for i, agent in enumerate(shared)}
        together, parts = Together(), {agent: Part(model.policy) for agent, model in models.items()}
        alike: Counter[int | None] = Counter(part.signature for part in parts.values() if part.signature is not None)
        try:
            for agent, model in models.items():
                worker = workers.get(agent)
                if agent in workers:
                    self._share_update(hub, agent, model, worker)
                if worker is not None:
                    self._act_elsewhere(hub, agent, model, worker)
                elif "forward" not in vars(model.policy) and (shared or alike[parts[agent].signature] > 1):
                    acts = ActsHere(hub, agent, parts[agent], self._workers, together)
                    model.policy.forward = acts  # type: ignore[method-assign]
            yield
        except BaseException:
            self._workers.end()
            raise
        finally:
            for agent, model in models.items():
                for name in REPLACED if agent in workers else ():
                    vars(model).pop(name, None)
                if isinstance(vars(model.policy).get("forward"), (ActsHere, ActsElsewhere)):
                    del vars(model.policy)["forward"]

    def _start(self, models: Mapping[str, OnPolicyAlgorithm], n_workers: int) -> None:
        if not self._workers:
            for agent, model in models.items():
                # Said now rather than after a first long rollout
                _pack(agent, model)
        if self._workers.start(n_workers):
            self._acts.clear()

    def _share_update(self, hub: "Lockstep", agent: str, model: OnPolicyAlgorithm, worker: int | None) -> None:
        excluded = [*model._excluded_save_params(), *REPLACED]
        # A model that is saved meanwhile is saved as always
        model._excluded_save_params = partial(list, excluded)  # type: ignore[method-assign]
        if worker is None:
            model.train = partial(_train_here, hub, agent, model)  # type: ignore[method-assign]
        else:
            model.train = partial(self._train, hub, agent, model, worker)  # type: ignore[method-assign]

    def _act_elsewhere(self, hub: "Lockstep", agent: str, model: OnPolicyAlgorithm, worker: int) -> None:
        if can_act_elsewhere(model):
            acts = self._acts.get(agent)
            if acts is None or acts.policy is not model.policy or acts.worker != worker:
                acts = self._acts[agent] = ActsElsewhere(agent, model.policy, self._workers, worker)
            acts.hub = hub
            model.policy.forward = acts  # type: ignore[method-assign]

    def _train(self, hub: "Lockstep", agent: str, model: OnPolicyAlgorithm, worker: int) -> None:
        """What ``model.train`` is, in the agent's own coroutine and random stream, for those updated in a worker."""
        if not hub.is_round_of(agent):
            type(model).train(model)
            return
        self._workers.send(worker, agent, _pack(agent, model))
        hub.wait(agent, UPDATES)
        unpack_result(model, self._workers.receive(worker, agent))
        acts = self._acts.get(agent)
        if acts is not None:
            acts.updated()


def _train_here(hub: "Lockstep", agent: str, model: OnPolicyAlgorithm) -> None:
    """The same for those updated in this process."""
    if not hub.is_round_of(agent):
        type(model).train(model)
        return
    # Not before the workers have something to do as well
    hub.wait(agent, UPDATES_HERE)
    type(model).train(model)
    # A normal number that numpy keeps back would be lost while others draw
    stream = read_stream()
    hub.wait(agent, UPDATES)
    write_stream(stream)


def _pack(agent: str, model: BaseAlgorithm) -> Message:
    try:
        return pack(model)
    except ValueError as error:
        raise ValueError(f"Agent {agent!r} cannot be updated in another process. {error}") from error
