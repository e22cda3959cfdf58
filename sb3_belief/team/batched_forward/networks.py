"""The networks of several policies as one, with their weights stacked."""

import copy
from collections.abc import Hashable, Sequence
from typing import Any

import torch as th
from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor, MlpExtractor
from torch import nn

from sb3_belief.belief import BeliefOutput, DynamicBelief, HistoryContext
from sb3_belief.belief_ppo.extractor import BeliefExtractor, BeliefFusion
from sb3_belief.belief_ppo.maskable import MaskableBeliefActorCriticPolicy, MaskableBeliefMlpPolicy
from sb3_belief.belief_ppo.policies import BeliefActorCriticPolicy, BeliefMlpPolicy
from sb3_belief.common.tensor_version import TensorVersions

_POLICIES = {
    ActorCriticPolicy,
    MaskableActorCriticPolicy,
    BeliefActorCriticPolicy,
    BeliefMlpPolicy,
    MaskableBeliefActorCriticPolicy,
    MaskableBeliefMlpPolicy,
}
_COMPOSED = {nn.Sequential, nn.Flatten, FlattenExtractor, MlpExtractor, BeliefExtractor, DynamicBelief, BeliefFusion}
# Those whose result for a number is the same to the bit wherever it stands; of others PyTorch computes the last numbers of a
# tensor in another way
_ACTIVATIONS = {nn.Identity, nn.Tanh, nn.ReLU, nn.LeakyReLU}
_HOOKS = ("_forward_hooks", "_forward_pre_hooks")


def signature(policy: nn.Module) -> Hashable | None:
    """
    :param policy: a policy
    :return: equal for policies whose networks can be stacked; None for one whose cannot: where there is more in them than
        linear layers, the usual activations and a belief, or are hooks
    """
    if type(policy) not in _POLICIES or not policy.share_features_extractor:
        return None
    found: list[Any] = [type(policy), getattr(policy, "options", None)]
    for path, module in policy.named_modules():
        if any(getattr(module, hooks) for hooks in _HOOKS):
            return None
        if type(module) is nn.Linear:
            found.append((path, *((w.shape, w.dtype, w.device) for w in module.parameters())))
        elif type(module) in _ACTIVATIONS:
            # With its arguments
            found.append((path, repr(module)))
        elif module is not policy and type(module) not in _COMPOSED:
            return None
    return tuple(found)


class StackedLinear(nn.Module):
    """
    Linear layers of several agents, each on the inputs of its own agent.

    :param layers: of equal shape
    """

    weight: th.Tensor
    bias: th.Tensor | None

    def __init__(self, layers: Sequence[nn.Module]):
        super().__init__()
        #: Where each agent keeps its weights, rather than the weights
        self.own = [layer._parameters for layer in layers]
        self.read_weights()

    def read_weights(self) -> None:
        """Take over the agents' weights as they are now."""
        for name, first in self.own[0].items():
            stacked = None if first is None else th.stack([weights[name].detach() for weights in self.own])  # type: ignore
            self.register_buffer(name, stacked)

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """
        :param inputs: ``[agents, B, in]``
        :return: ``[agents, B, out]``
        """
        weights = self.weight.mT
        return inputs @ weights if self.bias is None else th.baddbmm(self.bias[:, None], inputs, weights)


def stack(modules: Sequence[nn.Module]) -> nn.Module:
    """
    :param modules: with one signature
    :return: a module like each of them, for stacked inputs
    """
    if type(modules[0]) is nn.Linear:
        return StackedLinear(modules)
    result = copy.copy(modules[0])
    result._modules = {name: stack([module._modules[name] for module in modules]) for name in modules[0]._modules}  # type: ignore
    return result


class StackedNetworks:
    """
    The networks of several policies from observations to latent codes.

    :param policies: with one signature
    """

    def __init__(self, policies: Sequence[Any]):
        self._codes = stack([policy.mlp_extractor for policy in policies])
        networks = [self._codes]
        self._extractors = [p.features_extractor for p in policies if isinstance(p.features_extractor, BeliefExtractor)]
        if self._extractors:
            self._belief = stack([extractor.belief for extractor in self._extractors])
            networks.append(self._belief)
        self._layers = [layer for network in networks for layer in network.modules() if isinstance(layer, StackedLinear)]
        self._read = TensorVersions()
        self._context: HistoryContext | None = None

    def __call__(self, flat: th.Tensor, noise: th.Tensor | None) -> tuple[th.Tensor, th.Tensor, BeliefOutput | None]:
        """
        :param flat: preprocessed flat observations, ``[agents, B, d_o]``
        :param noise: for the beliefs, ``[agents, B, z]``
        :return: latent codes of policies and values, ``[agents, B, ...]``, and the beliefs
        """
        self._refresh()
        if not self._extractors:
            return *self._codes(flat), None
        belief = self.believe(flat, noise)
        return *self._codes(self._extractors[0].beside(flat, belief)), belief

    def believe(self, flat: th.Tensor, noise: th.Tensor | None) -> BeliefOutput:
        """
        :param flat: as above
        :param noise: as above
        :return: the beliefs
        """
        return self._belief(flat, None, noise, None, self._context, predict=False)

    def _refresh(self) -> None:
        histories = [extractor.history for extractor in self._extractors]
        weights = [tensor for layer in self._layers for own in layer.own for tensor in own.values() if tensor is not None]
        rows = [tensor for history in histories if history is not None for tensor in history]
        if not self._read.changed((*weights, *rows)):
            return
        for layer in self._layers:
            layer.read_weights()
        contexts = [e.encoded(h) for e, h in zip(self._extractors, histories, strict=True) if h is not None]
        if contexts:
            self._context = HistoryContext(*map(th.stack, zip(*contexts, strict=True)))
