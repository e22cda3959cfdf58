"""How PPO's values are trained where it is not by SB3's squared error: as MAPPO does (Yu et al. 2022, arXiv:2103.01955)."""

from dataclasses import dataclass
from numbers import Real
from typing import NamedTuple

import torch as th
from torch import nn
from torch.nn import functional as F


@dataclass(frozen=True)
class ValueOptions:
    """
    The arguments of the value's loss, as :class:`~sb3_belief.BeliefPPO` explains them.

    :raises ValueError: For a value that makes no sense; the message says what is allowed
    """

    value_norm: bool = False
    huber_delta: float | None = None
    value_clip: float | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.value_norm, bool):
            raise ValueError(f"value_norm is {self.value_norm!r}; it must be True or False")
        for name, value in (("huber_delta", self.huber_delta), ("value_clip", self.value_clip)):
            is_number = isinstance(value, Real) and not isinstance(value, bool)
            if value is not None and not (is_number and value > 0):
                raise ValueError(f"{name} is {value!r}; it must be a number above 0, or None to leave it out")

    @property
    def is_of_sb3(self) -> bool:
        """Whether nothing differs from SB3's own loss."""
        return self == ValueOptions()


class ValueTargets(NamedTuple):
    """
    What the values of a minibatch are trained on.

    :param returns: The returns, ``[B]``
    :param old_values: The values as they were while acting, ``[B]``
    """

    returns: th.Tensor
    old_values: th.Tensor


class NormalizedValue(nn.Module):
    """
    A value head that predicts returns in units of their running mean and deviation, and gives them as they are.

    With each batch of returns G: ``m <- b m + (1-b) mean G``, ``q <- b q + (1-b) mean G^2``, ``d <- b d + (1-b)``. The mean is
    ``m/d``, the variance ``max(q/d - (m/d)^2, 0.01)``. Before the first batch they are 0 and 1.

    :param head: Predicts the normalised value from the critic's latents
    """

    BETA = 0.99999
    LEAST_VARIANCE = 0.01

    mean_sum: th.Tensor
    square_sum: th.Tensor
    weight_sum: th.Tensor

    def __init__(self, head: nn.Module) -> None:
        super().__init__()
        self.head = head
        # As doubles, since the variance is a difference of large numbers where the mean is large
        for name in ("mean_sum", "square_sum", "weight_sum"):
            self.register_buffer(name, th.zeros((), dtype=th.float64, device=next(head.parameters()).device))

    @th.no_grad()
    def update(self, returns: th.Tensor) -> None:
        """
        Take in a batch of returns.

        :param returns: ``[N]``, at least one
        """
        returns = returns.to(self.mean_sum)
        for total, new in (
            (self.mean_sum, returns.mean()),
            (self.square_sum, returns.square().mean()),
            (self.weight_sum, 1.0),
        ):
            total.mul_(self.BETA).add_(new, alpha=1 - self.BETA)

    def statistics(self) -> tuple[th.Tensor, th.Tensor]:
        """Return mean and standard deviation of the returns, float32 scalars."""
        if not self.weight_sum:
            return th.zeros_like(self.mean_sum).float(), th.ones_like(self.mean_sum).float()
        mean = self.mean_sum / self.weight_sum
        variance = self.square_sum / self.weight_sum - mean.square()
        return mean.float(), variance.clamp(min=self.LEAST_VARIANCE).sqrt().float()

    def forward(self, latents: th.Tensor) -> th.Tensor:
        """
        Predict values.

        :param latents: Of the critic, ``[B, width]``
        :return: Values in the unit of the returns, ``[B, 1]``
        """
        mean, std = self.statistics()
        return self.head(latents) * std + mean


def value_loss(values: th.Tensor, targets: ValueTargets, std: th.Tensor | float, options: ValueOptions) -> th.Tensor:
    """
    Return the loss of the values of a minibatch.

    The error is ``e = (return - value) / std``. Its loss is ``e^2`` as in SB3, or with ``huber_delta`` the Huber loss, which
    is ``e^2 / 2`` up to delta and ``delta (|e| - delta / 2)`` beyond. With ``value_clip`` the loss of a value that has moved
    by more than this (in units of ``std``) is the larger one of its own and that of the value at which it would have stopped.

    :param values: Values, ``[B]``
    :param targets: What they are trained on
    :param std: Unit of the errors: the deviation of the returns where values are normalised, else 1
    :param options: The options
    :return: A scalar
    """
    losses = losses_of((targets.returns - values) / std, options.huber_delta)
    if options.value_clip is not None:
        most = options.value_clip * th.as_tensor(std, device=values.device)
        stopped = targets.old_values + (values - targets.old_values).clamp(-most, most)
        losses = th.max(losses, losses_of((targets.returns - stopped) / std, options.huber_delta))
    return losses.mean()


def losses_of(errors: th.Tensor, huber_delta: float | None) -> th.Tensor:
    """
    Return the loss of each error.

    :param errors: In their unit, ``[B]``
    :param huber_delta: Where the loss becomes linear; None for the square
    :return: ``[B]``
    """
    if huber_delta is None:
        return errors.square()
    return F.huber_loss(errors, th.zeros_like(errors), reduction="none", delta=huber_delta)
