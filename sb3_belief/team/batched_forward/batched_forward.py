"""Policies that wait for each other before they act, while their models learn."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_belief.team.batched_forward.passes import ForwardBatcher, ForwardRequest
from sb3_belief.team.lockstep.agent_task import BATCHES_FORWARD

if TYPE_CHECKING:
    from sb3_belief.team.lockstep.scheduler import Scheduler


class BatchedForward:
    """
    Stands in the place of the ``forward`` of a policy while its team learns.

    :param hub: in which its agent learns
    :param agent: whose policy it is
    :param part: of its policy
    :param together: makes the passes of all in this process
    """

    def __init__(self, scheduler: "Scheduler", agent: str, part: ForwardRequest, together: ForwardBatcher):
        self._scheduler, self._agent, self._policy, self._together = scheduler, agent, part.policy, together
        self._part, self._rollout = part, 0

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        # A copy of the policy acts by itself
        return _own_forward, (self._policy,)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        if not self._scheduler.chooses_actions(self._agent):
            return _own_forward(self._policy)(*args, **kwargs)
        if self._rollout != self._scheduler.n_rounds:
            # Others' weights, and it may have other networks
            self._part, self._rollout = ForwardRequest(self._policy), self._scheduler.n_rounds
        is_part = self._part.can_take(*args, **kwargs)
        if is_part:
            self._part.prepare(args[0])
            self._together.join(self._part)
        self._scheduler.wait(self._agent, BATCHES_FORWARD)
        if not is_part:
            return _own_forward(self._policy)(*args, **kwargs)
        self._together.go_on(self._part)
        return self._part.finish(*args, **kwargs)


def _own_forward(policy: Any) -> Any:
    return type(policy).forward.__get__(policy)


@contextmanager
def batched_forwards(scheduler: "Scheduler", models: Mapping[str, OnPolicyAlgorithm]) -> Iterator[None]:
    """
    Within the block those policies act together that can.

    :param hub: in which the agents learn
    :param models: of those who learn in this process
    """
    together, parts = ForwardBatcher(), {agent: ForwardRequest(model.policy) for agent, model in models.items()}
    alike: Counter[int | None] = Counter(part.signature for part in parts.values() if part.signature is not None)
    try:
        for agent, model in models.items():
            if "forward" not in vars(model.policy) and alike[parts[agent].signature] > 1:
                model.policy.forward = BatchedForward(scheduler, agent, parts[agent], together)  # type: ignore[method-assign]
        yield
    finally:
        for model in models.values():
            if isinstance(vars(model.policy).get("forward"), BatchedForward):
                del vars(model.policy)["forward"]
