"""A baseline of the advantages that sees what the others did in the same step."""

from typing import Any

import numpy as np
import torch as th
from torch import nn

from sb3_belief.belief_ppo.buffers import BeliefBufferMixin, BeliefMinibatch, attach
from sb3_belief.belief_ppo.extractor import BeliefFeatures, BeliefPass, rollout_rows
from sb3_belief.belief_ppo.value_loss import ValueTargets, losses_of

_HIDDEN = 64
# Of how many steps it is computed at a time
_ROWS = 1024


class OthersBaseline(nn.Module):
    """
    What an advantage owes to the others: ``b(o, belief, u)``, an estimate of ``A`` from what the agent knew and what it then
    saw the others do in the same step.

    With ``A = G - V(o, belief)`` the policy learns from ``A - b = G - Q(o, belief, u)``, where ``Q = V + b``. Given what the
    agent acts on, its action is independent of theirs, so that the expectation of the policy's gradient stays what it is, and
    its variance lacks what their exploration adds. Values, and what is bootstrapped from them, remain ``V``.

    Features and belief get no gradient of it. It begins at zero.

    :param width: Width of the features of the observation and of the belief together
    :param seen_width: ``W + n_others``, width of the others' actions and of whose was visible
    :param device: Device of the weights
    """

    def __init__(self, width: int, seen_width: int, device: th.device | str) -> None:
        super().__init__()
        last = nn.Linear(_HIDDEN, 1)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.layers = nn.Sequential(nn.Linear(width + seen_width, _HIDDEN), nn.Tanh(), last).to(device)

    def forward(self, features: BeliefFeatures | th.Tensor, seen: th.Tensor, unit: th.Tensor | float = 1.0) -> th.Tensor:
        """
        Estimate advantages.

        :param features: Features and belief
        :param seen: What the agent saw at once of the others, ``[B, W + n_others]``
        :param unit: In which the layers predict: the deviation of the returns where values are normalised
        :return: ``[B]``
        """
        known = features if isinstance(features, th.Tensor) else th.cat(features, dim=-1)
        return self.layers(th.cat([known.detach(), seen], dim=-1)).flatten() * unit

    def loss(
        self,
        features: BeliefFeatures | th.Tensor,
        minibatch: BeliefMinibatch,
        targets: ValueTargets,
        unit: th.Tensor | float = 1.0,
        huber_delta: float | None = None,
    ) -> th.Tensor:
        """
        Return the error of the estimates, which counts as that of the values does.

        :param features: Features and belief of a minibatch
        :param minibatch: What the others did
        :param targets: Returns, and the values while acting, whose differences are estimated
        :param unit: As of :meth:`forward`
        :param huber_delta: As of the values' loss; None for squared errors
        :return: A scalar
        """
        assert minibatch.seen_at_once is not None
        advantages = targets.returns - targets.old_values
        return losses_of((advantages - self(features, minibatch.seen_at_once, unit)) / unit, huber_delta).mean()


@th.no_grad()
def take_off(baseline: OthersBaseline, policy: Any, buffer: BeliefBufferMixin) -> float:
    """
    Take off a rollout's advantages what they owe to the others, by a baseline that has not been trained on it.

    :param baseline: The baseline
    :param policy: The policy that has acted, a :class:`~sb3_belief.belief_ppo.policies.BeliefPolicyMixin`
    :param buffer: The complete rollout, whose ``advantages`` are changed at active steps
    :return: Variance of the advantages afterwards, in units of that before; 1 where they were all alike
    """
    policy.set_training_mode(False)
    estimates = []
    steps = buffer.active_steps()
    for first in range(0, len(steps), _ROWS):
        rows = buffer.rows_of(steps[first : first + _ROWS])
        minibatch = buffer.belief_minibatch(rows)
        belief_pass = BeliefPass(minibatch.noise, minibatch.selected, stamps=minibatch.stamps)
        features = policy.extract_features(attach(rollout_rows(buffer.observations, rows, policy.device), belief_pass))
        assert minibatch.seen_at_once is not None
        estimates.append(baseline(features, minibatch.seen_at_once, policy.value_unit).cpu().numpy())
    rows = buffer.rows_of(steps)
    # SB3 keeps a column where the copies stand one after the other
    before = buffer.advantages[rows].flatten()
    after = before - np.concatenate(estimates)
    buffer.advantages[rows] = after.reshape(buffer.advantages[rows].shape)
    return float(after.var() / before.var()) if before.var() > 0 else 1.0
