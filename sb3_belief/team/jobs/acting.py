"""
Actions chosen together, and in the process that updates the agent.

In a rollout most of the time goes into the policies' passes. A worker still has the networks that it has updated, so it can
do these passes too, while this process and other workers do those of other agents. All that is sent is the observations and
where torch's generator stands; actions, values and log-probabilities come back, bit for bit what they would be here.
"""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from torch import nn

from sb3_belief.belief_ppo.writes import Watch
from sb3_belief.team.jobs.messages import own_tensor
from sb3_belief.team.members import ACTS_ELSEWHERE, ACTS_HERE
from sb3_belief.team.stacking import Part, Together, make

if TYPE_CHECKING:
    from sb3_belief.team.jobs.workers import Workers
    from sb3_belief.team.lockstep import Lockstep

# Whose passes leave nothing behind that the process which did not do them would miss
_STATELESS = {"torch", "stable_baselines3", "sb3_contrib", "sb3_belief"}


class Pass(NamedTuple):
    """
    A policy's pass to be done elsewhere.

    :param args: its arguments, as they are sent
    :param kwargs: those with names
    :param generator: where torch's stands; such policies draw from no other
    """

    args: tuple[Any, ...]
    kwargs: dict[str, Any]
    generator: np.ndarray


class PassDone(NamedTuple):
    """
    :param outputs: what the policy returned, as it is sent
    :param acted_with: what a policy with a belief notes of it, see :attr:`~sb3_belief.belief_ppo.BeliefPolicyMixin.acted_with`
    :param generator: where torch's stands now
    """

    outputs: Any
    acted_with: Any
    generator: np.ndarray


def can_act_elsewhere(model: OnPolicyAlgorithm) -> bool:
    """
    :param model: a model
    :return: whether its policy's passes depend on nothing but weights, history, arguments and random stream, and change
        nothing but the last: not with noise that is drawn for a rollout (gSDE), nor for sure with networks of one's own
    """
    modules = {type(module).__module__.partition(".")[0] for module in model.policy.modules()}
    return modules <= _STATELESS and not model.use_sde and "forward" not in vars(model.policy)


class ActsElsewhere:
    """
    Stands in the place of the ``forward`` of a policy while its team learns.

    :param agent: whose policy it is
    :param policy: the policy
    :param workers: the processes
    :param worker: number of the one that updates the agent
    """

    #: In which the agent learns
    hub: "Lockstep"

    def __init__(self, agent: str, policy: nn.Module, workers: "Workers", worker: int):
        self.policy, self.worker = policy, worker
        self._agent, self._workers = agent, workers
        self._places: list[Mapping[str, th.Tensor | None]] = []
        # The last update; None where there was none, or what it left has been changed since
        self._since: Watch | None = None

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        # A copy of the policy acts by itself
        return _own_forward, (self.policy,)

    def updated(self) -> None:
        """Called when the worker has just made the weights what they are here."""
        # Where they are kept rather than the tensors: a history is replaced
        self._places = [place for module in self.policy.modules() for place in (module._parameters, module._buffers)]
        self._since = Watch()
        self._since.changed(self._tensors())

    def _tensors(self) -> list[th.Tensor]:
        return [tensor for place in self._places for tensor in place.values() if tensor is not None]

    def _is_as_updated(self) -> bool:
        if self._since is not None and self._since.changed(self._tensors()):
            self._since = None
        return self._since is not None

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        if th.is_grad_enabled() or not self.hub.chooses_actions(self._agent) or not self._is_as_updated():
            return _own_forward(self.policy)(*args, **kwargs)
        try:
            job = Pass(_sent(args), _sent(kwargs), th.get_rng_state().numpy())
        except TypeError:
            return _own_forward(self.policy)(*args, **kwargs)
        self._workers.post(self.worker, self._agent, job)
        self.hub.wait(self._agent, ACTS_ELSEWHERE)
        self._workers.flush()
        done: PassDone | None = self._workers.receive(self.worker, self._agent)
        if done is None:
            # It has failed: let it fail here, where its error is seen
            return _own_forward(self.policy)(*args, **kwargs)
        th.set_rng_state(th.from_numpy(done.generator))
        if done.acted_with is not None:
            self.policy.acted_with = _received(done.acted_with)
        return _received(done.outputs)


class ActsHere:
    """
    The same for a policy that acts in this process: when the passes of others have been sent, and together with others in this
    process.

    :param hub: in which its agent learns
    :param agent: whose policy it is
    :param part: of its policy
    :param workers: the processes
    :param together: makes the passes of all in this process
    """

    def __init__(self, hub: "Lockstep", agent: str, part: Part, workers: "Workers", together: Together):
        self._hub, self._agent, self._policy, self._workers, self._together = hub, agent, part.policy, workers, together
        self._part, self._rollout = part, 0

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return _own_forward, (self._policy,)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        if not self._hub.chooses_actions(self._agent):
            return _own_forward(self._policy)(*args, **kwargs)
        # The hub lets agents that act elsewhere go first, so but right after an update all of theirs are posted by now
        self._workers.flush()
        if self._rollout != self._hub.n_rounds:
            # Others' weights, and it may have other networks
            self._part, self._rollout = Part(self._policy), self._hub.n_rounds
        is_part = self._part.can_take(*args, **kwargs)
        if is_part:
            self._part.prepare(args[0])
            self._together.join(self._part)
        self._hub.wait(self._agent, ACTS_HERE)
        self._workers.flush()
        if not is_part:
            return _own_forward(self._policy)(*args, **kwargs)
        self._together.go_on(self._part)
        return self._part.finish(*args, **kwargs)


def _own_forward(policy: nn.Module) -> Any:
    return type(policy).forward.__get__(policy)


@th.no_grad()
def do_passes(parts: Mapping[str, Part], jobs: Mapping[str, Pass]) -> dict[str, PassDone | None]:
    """
    :param parts: of the policies, as their updates have left them
    :param jobs: the passes, by agent
    :return: what has come of each; None if it failed
    """
    given = {agent: (_received(job.args), _received(job.kwargs)) for agent, job in jobs.items()}
    generators = {agent: th.from_numpy(job.generator) for agent, job in jobs.items()}
    try:
        joint = [agent for agent, (args, kwargs) in given.items() if parts[agent].can_take(*args, **kwargs)]
        for agent in joint:
            th.set_rng_state(generators[agent])
            parts[agent].prepare(given[agent][0][0])
            generators[agent] = th.get_rng_state()
        make([parts[agent] for agent in joint])
    except Exception:
        return {agent: None for agent in jobs}
    return {agent: _do_pass(parts[agent], *given[agent], generators[agent], agent in joint) for agent in jobs}


def _do_pass(part: Part, args: tuple, kwargs: dict, generator: th.Tensor, is_prepared: bool) -> PassDone | None:
    policy = part.policy
    try:
        if policy.training:
            policy.set_training_mode(False)
        th.set_rng_state(generator)
        outputs = (part.finish if is_prepared else policy)(*args, **kwargs)
        return PassDone(_sent(outputs), _sent(getattr(policy, "acted_with", None)), th.get_rng_state().numpy())
    except Exception:
        return None


class _Sent(NamedTuple):
    """A tensor as it is sent."""

    array: np.ndarray
    stride: tuple[int, ...]


def _sent(value: Any) -> Any:
    """The same without tensors; a TypeError for what may not mean the same elsewhere."""
    if isinstance(value, th.Tensor):
        return _Sent(value.numpy(), value.stride())
    if type(value) is tuple:
        return tuple(map(_sent, value))
    if type(value) is dict:
        return {key: _sent(part) for key, part in value.items()}
    if value is None or isinstance(value, (bool, np.ndarray)):
        return value
    raise TypeError(type(value))


def _received(value: Any) -> Any:
    if isinstance(value, _Sent):
        return own_tensor(*value)
    if isinstance(value, tuple):
        return tuple(map(_received, value))
    if isinstance(value, dict):
        return {key: _received(part) for key, part in value.items()}
    return value
