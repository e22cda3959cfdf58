"""A loss that joins SB3's own."""

from typing import Any

import torch as th


class _AddLoss(th.autograd.Function):
    """The identity on ``values``, whose backward pass scales their gradient, and hands ``loss`` a gradient of one."""

    @staticmethod
    def forward(ctx: Any, values: th.Tensor, loss: th.Tensor, scale: float | th.Tensor) -> th.Tensor:
        ctx.scale = scale
        return values.view_as(values)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: th.Tensor) -> tuple[th.Tensor, th.Tensor, None]:
        (grad_values,) = grad_outputs
        # Times one would be the same bits, and a kernel more
        scaled = grad_values if isinstance(ctx.scale, float) and ctx.scale == 1.0 else ctx.scale * grad_values
        return scaled, grad_values.new_ones(()), None


def add_loss(values: th.Tensor, loss: th.Tensor, scale: float | th.Tensor = 1.0) -> th.Tensor:
    """
    Let ``loss`` be minimised together with whatever is computed from ``values``.

    SB3's PPO asks the policy for the values of a minibatch, builds its own loss from them, and calls ``backward()`` once on
    it. That pass goes through the values exactly once, whatever the value coefficient; there the loss joins with the weight
    one. The gradient equals that of the explicit sum ``loss_of_PPO + loss``, and SB3's own gradient clipping, schedules and
    early stopping apply to it. So ``train()`` need not be copied, and cannot drift from SB3's.

    :param values: Values as the policy returns them, in the graph that is differentiated
    :param loss: A scalar
    :param scale: Weight of whatever is computed from the values, a constant: the sum is then ``scale * loss_of_SB3 + loss``
    :return: The same values
    """
    return _AddLoss.apply(values, loss, scale)
