"""Which policies have networks that can be stacked."""

from collections.abc import Hashable, Iterable
from typing import Any

from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor, MlpExtractor
from torch import nn

from sb3_belief.belief import DynamicBelief
from sb3_belief.belief_ppo.extractor import BeliefExtractor, BeliefFusion
from sb3_belief.belief_ppo.maskable import MaskableBeliefActorCriticPolicy, MaskableBeliefMlpPolicy
from sb3_belief.belief_ppo.policies import BeliefActorCriticPolicy, BeliefMlpPolicy

_POLICIES = {
    ActorCriticPolicy,
    MaskableActorCriticPolicy,
    BeliefActorCriticPolicy,
    BeliefMlpPolicy,
    MaskableBeliefActorCriticPolicy,
    MaskableBeliefMlpPolicy,
}
_COMPOSED = {nn.Sequential, nn.Flatten, FlattenExtractor, MlpExtractor, BeliefExtractor, DynamicBelief, BeliefFusion}
# Only activations whose result for a number is the same to the bit wherever it lies in a tensor: for the others PyTorch uses
# vectorised code for most numbers and different code for the remainder
_ACTIVATIONS = {nn.Identity, nn.Tanh, nn.ReLU, nn.LeakyReLU}


def signature(policy: nn.Module) -> Hashable | None:
    """
    Return what must be equal for networks to be stacked.

    :param policy: A policy
    :return: Equal for policies whose networks can be stacked with each other; None for one whose cannot be, because it holds
        more than linear layers, the usual activations and a belief, or has hooks
    """
    if type(policy) not in _POLICIES or not policy.share_features_extractor:
        return None
    found: list[Any] = [type(policy), getattr(policy, "options", None)]
    if has_hooks(policy.modules()):
        return None
    for path, module in policy.named_modules():
        if type(module) is nn.Linear:
            found.append((path, *((w.shape, w.dtype, w.device) for w in module.parameters())))
        elif type(module) in _ACTIVATIONS:
            # With its arguments
            found.append((path, repr(module)))
        elif module is not policy and type(module) not in _COMPOSED:
            return None
    return tuple(found)


def has_hooks(modules: Iterable[nn.Module]) -> bool:
    """
    Tell whether there is a hook that a pass would call.

    :param modules: The modules of a policy
    """
    return any(module._forward_hooks or module._forward_pre_hooks for module in modules)
