"""The two losses that train a belief (eq. 7 and 8 of the paper), and the actions that a prediction stands for."""

from collections.abc import Callable
from types import MappingProxyType

import torch as th
import torch.nn.functional as F

from sb3_belief.belief.layout import ActionLayout

# (prediction, actions, visible, layout) -> scalar
Loss = Callable[[th.Tensor, th.Tensor, th.Tensor, ActionLayout], th.Tensor]


def squared_error(prediction: th.Tensor, actions: th.Tensor, visible: th.Tensor, layout: ActionLayout) -> th.Tensor:
    """
    Return the squared error of the predicted actions of the visible others (eq. 7).

    It is summed over the components of an action and averaged over all visible others of the batch. The paper writes a norm
    and calls it a mean squared error. We take the square, which its derivation from the likelihood (eq. 6) gives.

    :param prediction: Predicted actions, float ``[B, W]``
    :param actions: Actions taken, float ``[B, W]``
    :param visible: Whether each of the others' actions was visible, bool ``[B, n_others]``
    :param layout: Layout of the others' actions
    :return: A scalar, zero if no action is visible
    """
    return _mean_over_visible((actions - prediction).square(), visible, layout)


def cross_entropy(prediction: th.Tensor, actions: th.Tensor, visible: th.Tensor, layout: ActionLayout) -> th.Tensor:
    """
    Return the negative log-likelihood of the actions of the visible others (eq. 6), for a prediction that holds logits.

    The logits are those of a softmax for each one-hot vector and of a sigmoid for each binary action. The loss is summed and
    averaged as in :func:`squared_error`.

    :param prediction: Logits, float ``[B, W]``
    :param actions: Actions taken, zeros and ones ``[B, W]``
    :param visible: Whether each of the others' actions was visible, bool ``[B, n_others]``
    :param layout: Layout of the others' actions, none of them numbers (Box)
    :return: A scalar, zero if no action is visible
    """
    errors = th.zeros_like(prediction)
    for columns in layout.block_columns:
        errors[:, columns] = -actions[:, columns] * prediction[:, columns].log_softmax(dim=-1)
    if layout.binary_columns:
        binary = layout.binary_columns
        errors[:, binary] = F.binary_cross_entropy_with_logits(prediction[:, binary], actions[:, binary], reduction="none")
    return _mean_over_visible(errors, visible, layout)


def _mean_over_visible(errors: th.Tensor, visible: th.Tensor, layout: ActionLayout) -> th.Tensor:
    # One weight per column, copied from the agent that owns it. index_select is twice as fast on floats as on bools
    weights = visible.to(errors.dtype).index_select(1, layout.owner_index.to(errors.device))
    return (errors * weights).sum() / visible.sum().clamp(min=1)


#: The losses by the value of ``action_loss``
ACTION_LOSSES: MappingProxyType[str, Loss] = MappingProxyType({"mse": squared_error, "cross_entropy": cross_entropy})


def kl_divergence(mean: th.Tensor, log_std: th.Tensor) -> th.Tensor:
    """
    Return the KL divergence of the belief from the standard normal prior (eq. 6).

    It is summed over the components of the latent and averaged over the batch.

    :param mean: Mean of the belief, float ``[B, z]``
    :param log_std: Logarithm of its standard deviation, float ``[B, z]``
    :return: A scalar, at least zero
    """
    # exp() with one sum is faster than expm1() with two
    total = 0.5 * (mean.square() + (2 * log_std).exp()) - log_std
    return (total - 0.5).sum() / len(mean)


def expected_actions(prediction: th.Tensor, layout: ActionLayout, action_loss: str) -> th.Tensor:
    """
    Return the actions that a prediction stands for: probabilities for one-hot and binary actions, the mean for numbers.

    A decoder that was trained by the squared error estimates these probabilities directly, but its output may lie outside
    [0, 1] and need not sum to one. It is therefore clipped and scaled. A one-hot vector for which no value is above zero
    becomes uniform.

    :param prediction: Output of the decoder, float ``[B, W]``
    :param layout: Layout of the others' actions
    :param action_loss: The loss that trained the decoder, ``"mse"`` or ``"cross_entropy"``
    :return: Expected actions, float ``[B, W]``
    """
    result = prediction.clone()
    for columns in layout.block_columns:
        part = prediction[:, columns]
        if action_loss == "cross_entropy":
            result[:, columns] = part.softmax(dim=-1)
        else:
            # Not zero, so that the sum is positive where no value is. Beside any other value this is nothing
            positive = part.clamp(min=1e-30)
            result[:, columns] = positive / positive.sum(dim=-1, keepdim=True)
    if layout.binary_columns:
        binary = prediction[:, layout.binary_columns]
        result[:, layout.binary_columns] = binary.sigmoid() if action_loss == "cross_entropy" else binary.clamp(0, 1)
    return result
