"""
The members of a pool that act at the same time, as one pass.

Where each copy draws its own member, a pass for each would take most of its time for calls. With four saved teams as nine
partners in 32 copies the environment makes three times as many steps per CPU second in one (benchmarks/partners.py: 0.87
times those of a single team, instead of 0.31).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import sb3_contrib
import stable_baselines3
import torch as th
from gymnasium import spaces
from sb3_contrib.common.maskable.distributions import MaskableDistribution

from sb3_belief.belief_ppo import BeliefPPO, MaskableBeliefPPO
from sb3_belief.belief_ppo.extractor import BeliefExtractor, flat_observations
from sb3_belief.team.batched_forward.batcher import StackedLinear, stack
from sb3_belief.team.batched_forward.signature import signature
from sb3_belief.team.predictor import Predictor

# Their predict() is what is done here, and is overridden by nobody
_ALGORITHMS = {
    *(stable_baselines3.PPO, stable_baselines3.A2C, sb3_contrib.TRPO, sb3_contrib.MaskablePPO),
    *(BeliefPPO, MaskableBeliefPPO),
}


class StackedMembers:
    """
    Networks of equal shape, all of which pass over the observations of all copies: each copy then takes the actions of the one
    that is present there.

    :param predictors: One for each member, as of :func:`can_be_stacked`. Their weights are copied
    """

    def __init__(self, predictors: Sequence[Predictor]):
        self._predictors = predictors
        policies: list[Any] = [predictor.model.policy for predictor in predictors]
        self._policy = policies[0]
        # Otherwise all of them see the same
        self._normalizes = any(predictor.normalizes for predictor in predictors)
        self._network = stack([policy.mlp_extractor.policy_net for policy in policies])
        self._logits = StackedLinear([policy.action_net for policy in policies])

    @th.no_grad()
    def act(self, present: np.ndarray, obs: np.ndarray, masks: np.ndarray | None, deterministic: bool) -> np.ndarray:
        """
        Choose actions, with PyTorch's present random numbers.

        :param present: Index of the member in each copy, int ``[n_envs]``
        :param obs: The agent's observations, ``[n_envs, ...]``
        :param masks: Its possible actions, bool ``[n_envs, k]``; None if the environment has no masks for it
        :param deterministic: Whether to take the most likely actions instead of samples
        :return: The actions, ``[n_envs, ...]``
        """
        policy = self._policy
        seen = [predictor.observed(obs) for predictor in self._predictors] if self._normalizes else [obs]
        flat = th.stack([flat_observations(policy, policy.obs_to_tensor(each)[0]) for each in seen]).expand(
            len(self._predictors), -1, -1
        )
        logits = self._logits(self._network(flat))[th.as_tensor(present), th.arange(len(present))]
        distribution = policy.action_dist.proba_distribution(action_logits=logits)
        if masks is not None and isinstance(distribution, MaskableDistribution):
            distribution.apply_masking(masks)
        actions = distribution.get_actions(deterministic=deterministic)
        return actions.numpy().reshape(len(present), *policy.action_space.shape)


def can_be_stacked(predictors: Sequence[Predictor | None]) -> bool:
    """
    Tell whether the members of a pool can act as one: several with policies of one kind, networks of linear layers of equal
    shapes without a belief, and discrete actions.

    :param predictors: One for each member, of models that nobody else changes; None for a function
    """
    if len(predictors) < 2 or any(predictor is None for predictor in predictors):
        return False
    models: list[Any] = [predictor.model for predictor in predictors]  # type: ignore[union-attr]
    if any(type(model) not in _ALGORITHMS for model in models):
        return False
    signatures = {signature(model.policy) for model in models}
    policy = models[0].policy
    return (
        None not in signatures
        and len(signatures) == 1
        and not isinstance(policy.features_extractor, BeliefExtractor)
        and isinstance(policy.action_space, (spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary))
        and policy.device.type == "cpu"
    )
