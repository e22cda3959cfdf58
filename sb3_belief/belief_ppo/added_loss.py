"""A loss that joins SB3's own."""

from typing import Any

import torch as th


class _AddLoss(th.autograd.Function):
    """The identity on ``values``, whose backward pass also hands ``loss`` a gradient of one."""

    @staticmethod
    def forward(ctx: Any, values: th.Tensor, loss: th.Tensor) -> th.Tensor:
        return values.view_as(values)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        (grad_values,) = grad_outputs
        return grad_values, grad_values.new_ones(())


def add_loss(values: th.Tensor, loss: th.Tensor) -> th.Tensor:
    """
    Let ``loss`` be minimised together with whatever is computed from ``values``.

    SB3's PPO asks the policy for the values of a minibatch, builds its own loss from them, and calls ``backward()`` once on
    it. That pass goes through the values exactly once, whatever the value coefficient; there the loss joins with the weight
    one. The gradient equals that of the explicit sum ``loss_of_PPO + loss``, and SB3's own gradient clipping, schedules and
    early stopping apply to it. So ``train()`` need not be copied, and cannot drift from SB3's.

    :param values: Values as the policy returns them, in the graph that is differentiated
    :param loss: A scalar
    :return: The same values
    """
    return _AddLoss.apply(values, loss)
