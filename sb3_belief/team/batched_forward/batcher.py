"""
Forward passes of several policies as one.

Small networks take more time for calls than for products, so the agents of one process that choose actions at the same time
make one pass, from observations to latents, with their weights stacked into one tensor for each layer. The rest (distribution,
sample, value) is each policy's own ``forward``, with its own random number generators. The result is the same, bit for bit.
Whether it is depends on the shapes and on the libraries behind PyTorch, so it is tried out once for each shape; where it is
not, each policy makes its own passes.
"""

import copy
from collections import Counter, defaultdict
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch as th
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from torch import nn

from sb3_belief.belief import BeliefOutput, HistoryContext
from sb3_belief.belief_ppo.buffers import attached
from sb3_belief.belief_ppo.extractor import BeliefExtractor, BeliefPass, flat_observations
from sb3_belief.common.kept_tensors import KeptTensors
from sb3_belief.team.batched_forward.signature import has_hooks, signature
from sb3_belief.team.lockstep.scheduler import BATCHES_FORWARD, Scheduler

# A number for each signature: they are compared at every step, and numbers compare faster
_signature_numbers: dict[Hashable, int] = {}
# Whether so many requests of a kind have the same result in one batch
_agrees: dict[Hashable, bool] = {}


class Latents(NamedTuple):
    """
    What a policy's own part of the forward pass starts from.

    :param policy: Input of the action distribution, ``[B, ...]``
    :param value: Input of the value, ``[B, ...]``
    :param belief: The belief behind both; None for a policy without one
    """

    policy: th.Tensor
    value: th.Tensor
    belief: BeliefOutput | None


class StackedLinear(nn.Module):
    """
    Linear layers of several agents, each applied to the inputs of its own agent.

    :param layers: The layers, of equal shape
    """

    weight: th.Tensor
    bias: th.Tensor | None

    def __init__(self, layers: Sequence[nn.Module]):
        super().__init__()
        #: Where each agent keeps its weights: the dict rather than the tensors, which may be replaced
        self.own = [layer._parameters for layer in layers]
        self.read_weights()

    def read_weights(self) -> None:
        """Copy the agents' present weights."""
        for name, first in self.own[0].items():
            stacked = None if first is None else th.stack([weights[name].detach() for weights in self.own])  # type: ignore
            self.register_buffer(name, stacked)

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """
        Apply each agent's layer.

        :param inputs: ``[agents, B, in]``
        :return: ``[agents, B, out]``
        """
        weights = self.weight.mT
        return inputs @ weights if self.bias is None else th.baddbmm(self.bias[:, None], inputs, weights)


def stack(modules: Sequence[nn.Module]) -> nn.Module:
    """
    Stack modules of several agents.

    :param modules: One for each agent, with equal signatures
    :return: A module like each of them, for stacked inputs
    """
    if type(modules[0]) is nn.Linear:
        return StackedLinear(modules)
    result = copy.copy(modules[0])
    result._modules = {name: stack([module._modules[name] for module in modules]) for name in modules[0]._modules}  # type: ignore
    return result


class StackedNetworks:
    """
    The networks of several policies from observations to latents.

    :param policies: The policies, with equal signatures
    :param watches: Whether each call looks whether weights or histories have been written to
    """

    def __init__(self, policies: Sequence[Any], watches: bool):
        self._latents = stack([policy.mlp_extractor for policy in policies])
        networks = [self._latents]
        self._extractors = [p.features_extractor for p in policies if isinstance(p.features_extractor, BeliefExtractor)]
        if self._extractors:
            self._belief = stack([extractor.belief for extractor in self._extractors])
            networks.append(self._belief)
        self._layers = [layer for network in networks for layer in network.modules() if isinstance(layer, StackedLinear)]
        self._watches, self._inputs = watches, KeptTensors()
        self._context: HistoryContext | None = None
        self._encode_histories()

    def __call__(self, flat: th.Tensor, noise: th.Tensor | None) -> tuple[th.Tensor, th.Tensor, BeliefOutput | None]:
        """
        Make the forward passes of all policies.

        :param flat: Preprocessed flat observations, ``[agents, B, d_o]``
        :param noise: Noise of the beliefs, ``[agents, B, z]``
        :return: Latents of policies and values, ``[agents, B, ...]``, and the beliefs
        """
        if self._watches:
            self._refresh()
        if not self._extractors:
            return *self._latents(flat), None
        belief = self._belief(flat, None, noise, None, self._context, predict=False)
        return *self._latents(self._extractors[0].with_belief(flat, belief)), belief

    def _refresh(self) -> None:
        """Copy the agents' weights and encoded histories again if any has been written to."""
        weights = [tensor for layer in self._layers for own in layer.own for tensor in own.values() if tensor is not None]
        rows = [tensor for e in self._extractors if e.history is not None for tensor in e.history]
        if self._inputs.changed((*weights, *rows)):
            for layer in self._layers:
                layer.read_weights()
            self._encode_histories()

    def _encode_histories(self) -> None:
        contexts = [e.encoded(e.history) for e in self._extractors if e.history is not None]
        if contexts:
            self._context = HistoryContext(*map(th.stack, zip(*contexts, strict=True)))


class ForwardRequest:
    """
    One policy's part of batched passes: its inputs before, and its own ``forward`` from the latents afterwards.

    It serves for one rollout, as long as the policy keeps its networks.

    :param policy: The policy
    :param watches: Whether weights and histories may be written to within the rollout
    """

    latents: Latents | None
    _flat: th.Tensor
    _noise: th.Tensor | None

    def __init__(self, policy: Any, watches: bool):
        self.policy, self.watches = policy, watches
        found = signature(policy)
        #: Equal for policies of equal networks; None for a policy that makes its passes alone
        self.signature = None if found is None else _signature_numbers.setdefault(found, len(_signature_numbers))
        self._modules = list(policy.modules())
        extractor = getattr(policy, "features_extractor", None)
        self._extractor = extractor if isinstance(extractor, BeliefExtractor) else None
        self._valid, self._n_rows = KeptTensors(), 0
        # The others of the batch and the stacked networks, kept by the first request of a batch
        self._others: list[ForwardRequest] | None = None
        self._networks: StackedNetworks | None = None

    def is_outdated(self) -> bool:
        """Tell whether the policy has got other modules or hooks since; it is not looked for without ``watches``."""
        if not self.watches or self.signature is None:
            return False
        modules = list(self.policy.modules())
        return modules != self._modules or has_hooks(modules)

    def accepts(self, *args: Any, **kwargs: Any) -> bool:
        """
        Tell whether such a pass can be made in a batch.

        :param args: Arguments of ``forward``
        :param kwargs: Arguments of ``forward``
        """
        is_usual = len(args) == 1 and isinstance(args[0], th.Tensor) and kwargs.keys() <= {"action_masks"}
        return self.signature is not None and is_usual and not th.is_grad_enabled()

    def prepare(self, obs: th.Tensor) -> None:
        """
        Flatten the observations and draw the noise of the belief, while the agent's own generators are the current ones.

        :param obs: As ``forward`` takes them
        """
        self._flat = flat_observations(self.policy, obs)
        self._noise = None if self._extractor is None else self._extractor.draw_noise(self._flat)
        self.latents = None

    @property
    def kind(self) -> Hashable:
        """Equal for requests that can be answered in one batch."""
        history = None if self._extractor is None else self._extractor.history
        if history is not None and self._valid.changed([history.valid]):
            self._n_rows = int(history.valid.sum())
        return self.signature, self._flat.shape, self._n_rows

    def answer_alone(self) -> None:
        """Make a pass of its own."""
        self.latents = self._own_latents(self._flat, self._noise)

    def answer_with(self, others: list["ForwardRequest"], kind: Hashable) -> bool:
        """
        Make the passes of several requests in one batch.

        :param others: The other requests, of the same kind
        :param kind: Their kind
        :return: Whether they were made: not if their own passes would have other results
        """
        group, shape = [self, *others], (1 + len(others), kind)
        if shape in _agrees and not _agrees[shape]:
            return False
        if others != self._others:
            self._others, self._networks = others, StackedNetworks([request.policy for request in group], self.watches)
        assert self._networks is not None
        if shape not in _agrees:
            _agrees[shape] = self._try_out(group, self._networks)
            if not _agrees[shape]:
                return False
        noise = None if self._noise is None else th.stack([request._noise for request in group])  # type: ignore[misc]
        batch = self._networks(th.stack([request._flat for request in group]), noise)
        for i, request in enumerate(group):
            request.latents = _of_agent(i, *batch)
        return True

    def _own_latents(self, flat: th.Tensor, noise: th.Tensor | None) -> Latents:
        belief: BeliefOutput | None = None
        features: Any = flat
        if self._extractor is not None:
            belief = self._extractor.infer(flat, noise, predict=False)
            features = self._extractor.with_belief(flat, belief)
        policy, value = self.policy.mlp_extractor(features)
        return Latents(policy, value, belief)

    def _try_out(self, group: list["ForwardRequest"], networks: StackedNetworks) -> bool:
        """Compare a batch with single passes, on random observations: the present ones may be all zero."""
        device = self._flat.device
        generator = th.Generator(device).manual_seed(0)
        flat = th.randn(len(group), *self._flat.shape, generator=generator, device=device)
        noise = None
        if self._noise is not None:
            noise = th.randn(len(group), *self._noise.shape, generator=generator, device=device)
        batch = networks(flat, noise)
        own = [request._own_latents(flat[i], None if noise is None else noise[i]) for i, request in enumerate(group)]
        return all(_equal(_of_agent(i, *batch), latents) for i, latents in enumerate(own))

    def finish(self, *args: Any, **kwargs: Any) -> Any:
        """
        Make the rest of the pass, by the policy's own ``forward``.

        :param args: Arguments of ``forward``
        :param kwargs: Arguments of ``forward``
        :return: What ``forward`` returns
        """
        assert self.latents is not None
        latents, attributes = self.latents, vars(self.policy)

        def extract_features(obs: Any) -> tuple[th.Tensor, th.Tensor]:
            if latents.belief is not None:
                belief_pass: BeliefPass = attached(obs)
                belief_pass.output, belief_pass.noise = latents.belief, self._noise
            return latents.policy, latents.value

        # SB3's forward() calls these two, one after the other, and nothing else before the distribution
        attributes["extract_features"], attributes["mlp_extractor"] = extract_features, _identity
        try:
            return type(self.policy).forward(self.policy, *args, **kwargs)
        finally:
            del attributes["extract_features"], attributes["mlp_extractor"]


def _identity(features: Any) -> Any:
    return features


def _of_agent(i: int, policy: th.Tensor, value: th.Tensor, belief: BeliefOutput | None) -> Latents:
    own = None if belief is None else BeliefOutput(*(None if each is None else each[i] for each in belief))  # type: ignore
    return Latents(policy[i], value[i], own)


def _equal(a: Latents, b: Latents) -> bool:
    if a.policy.device.type != "cpu":
        # No device but the CPU promises equal bits
        return th.allclose(a.policy, b.policy, atol=1e-5) and th.allclose(a.value, b.value, atol=1e-5)
    same_rows = a.belief is None or b.belief is None or th.equal(a.belief.selected, b.belief.selected)
    return same_rows and th.equal(a.policy, b.policy) and th.equal(a.value, b.value)


class ForwardBatcher:
    """Collects the requests of policies that wait for each other, and answers them."""

    def __init__(self) -> None:
        self._waiting: list[ForwardRequest] = []

    def add(self, request: ForwardRequest) -> None:
        """
        Add a request that is answered with the next batch.

        :param request: Prepared
        """
        self._waiting.append(request)

    @th.no_grad()
    def answer(self) -> None:
        """Make the passes of all requests that wait, those of one kind in one batch."""
        kinds: dict[Hashable, list[ForwardRequest]] = defaultdict(list)
        for request in self._waiting:
            kinds[request.kind].append(request)
        self._waiting = []
        for kind, (first, *others) in kinds.items():
            if not (others and first.answer_with(others, kind)):
                for request in (first, *others):
                    request.answer_alone()


class BatchedForward:
    """
    Replaces the ``forward`` of a policy while its team learns: it waits until all policies of the process want to act.

    :param scheduler: Of the agent's process
    :param agent: Name of the agent
    :param request: Of its policy
    :param batcher: Of the process
    """

    def __init__(self, scheduler: Scheduler, agent: str, request: ForwardRequest, batcher: ForwardBatcher):
        self._scheduler, self._agent, self._policy, self._batcher = scheduler, agent, request.policy, batcher
        self._request, self._rollout = request, 0

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        # A copy of the policy makes its passes alone
        return _own_forward, (self._policy,)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        if not self._scheduler.chooses_actions(self._agent):
            return _own_forward(self._policy)(*args, **kwargs)
        if self._rollout != self._scheduler.n_rounds or self._request.is_outdated():
            self._request = ForwardRequest(self._policy, self._request.watches)
            self._rollout = self._scheduler.n_rounds
        is_batched = self._request.accepts(*args, **kwargs)
        if is_batched:
            self._request.prepare(args[0])
            self._batcher.add(self._request)
        # Also if not batched: all agents then act in the same order
        self._scheduler.wait(self._agent, BATCHES_FORWARD)
        if not is_batched:
            return _own_forward(self._policy)(*args, **kwargs)
        if self._request.latents is None:
            # The first that is resumed answers the requests of all
            self._batcher.answer()
        return self._request.finish(*args, **kwargs)


def _own_forward(policy: Any) -> Any:
    return type(policy).forward.__get__(policy)


@contextmanager
def batched_forwards(scheduler: Scheduler, models: Mapping[str, OnPolicyAlgorithm], watches: bool) -> Iterator[None]:
    """
    Batch the forward passes of those policies that have equals, within the block.

    :param scheduler: Of this process
    :param models: The models that learn in this process, by agent
    :param watches: Whether to look before each pass whether weights or histories have been written to, as only a user's own
        code does within a rollout. For ten agents with a belief on Traffic Junction it takes a fifth of a rollout
    """
    batcher = ForwardBatcher()
    requests = {agent: ForwardRequest(model.policy, watches) for agent, model in models.items()}
    counts: Counter[int | None] = Counter(r.signature for r in requests.values() if r.signature is not None)
    try:
        for agent, model in models.items():
            # A forward that a user has replaced stays
            if "forward" not in vars(model.policy) and counts[requests[agent].signature] > 1:
                model.policy.forward = BatchedForward(scheduler, agent, requests[agent], batcher)  # type: ignore[method-assign]
        yield
    finally:
        for model in models.values():
            if isinstance(vars(model.policy).get("forward"), BatchedForward):
                del vars(model.policy)["forward"]
