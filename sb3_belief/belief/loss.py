"""The two terms that train a belief (eq. 7 and 8 of the paper), and what a prediction says of the others' actions."""

from collections.abc import Callable
from types import MappingProxyType

import torch as th
import torch.nn.functional as F

from sb3_belief.belief.layout import ActionLayout

Loss = Callable[[th.Tensor, th.Tensor, th.Tensor, ActionLayout], th.Tensor]


def squared_error(prediction: th.Tensor, actions: th.Tensor, visible: th.Tensor, layout: ActionLayout) -> th.Tensor:
    """
    Squared error of the predicted actions of the visible others (eq. 7), summed over the components of an action
    and averaged over the visible others of the batch. The paper writes a norm and calls it a mean squared error;
    the square is what its derivation from the likelihood (eq. 6) gives.

    :param prediction: Predicted actions ``[B, W]``
    :param actions: Actions taken ``[B, W]``
    :param visible: Whose action was visible, bool ``[B, n_others]``
    :param layout: Where each of the others stands
    :return: A scalar, zero where nobody is visible
    """
    return _mean_over_visible((actions - prediction).square(), visible, layout)


def cross_entropy(prediction: th.Tensor, actions: th.Tensor, visible: th.Tensor, layout: ActionLayout) -> th.Tensor:
    """
    Negative log-likelihood of the actions of the visible others (eq. 6) where the prediction holds logits: of a softmax for
    each one-hot vector, of a sigmoid for each binary action. Summed and averaged as :func:`squared_error`.

    :param prediction: Logits ``[B, W]``
    :param actions: Actions taken, zeros and ones ``[B, W]``
    :param visible: Whose action was visible, bool ``[B, n_others]``
    :param layout: Where each of the others stands; none of them with numbers (Box)
    :return: A scalar, zero where nobody is visible
    """
    errors = th.zeros_like(prediction)
    for columns in layout.block_columns:
        errors[:, columns] = -actions[:, columns] * prediction[:, columns].log_softmax(dim=-1)
    if layout.binary_columns:
        binary = layout.binary_columns
        errors[:, binary] = F.binary_cross_entropy_with_logits(prediction[:, binary], actions[:, binary], reduction="none")
    return _mean_over_visible(errors, visible, layout)


def _mean_over_visible(errors: th.Tensor, visible: th.Tensor, layout: ActionLayout) -> th.Tensor:
    # Selecting columns of numbers is twice as fast as of truth values
    weights = visible.to(errors.dtype).index_select(1, layout.owner_index.to(errors.device))
    return (errors * weights).sum() / visible.sum().clamp(min=1)


#: By the name that ``action_loss`` has for it
ACTION_LOSSES: MappingProxyType[str, Loss] = MappingProxyType({"mse": squared_error, "cross_entropy": cross_entropy})


def kl_divergence(mean: th.Tensor, log_std: th.Tensor) -> th.Tensor:
    """
    Divergence of the belief from the standard normal prior (eq. 6), summed over the latent's components and averaged
    over the batch.

    :param mean: ``[B, z]``
    :param log_std: ``[B, z]``
    :return: A scalar, at least zero
    """
    # exp() and one sum are faster than expm1() and two
    total = 0.5 * (mean.square() + (2 * log_std).exp()) - log_std
    return (total - 0.5).sum() / len(mean)


def expected_actions(prediction: th.Tensor, layout: ActionLayout, action_loss: str) -> th.Tensor:
    """
    What a prediction says: probabilities for one-hot and binary actions, the mean for numbers. Trained by the squared error
    the prediction itself estimates these probabilities, but may lie outside [0, 1] and needs not add up to one: it is clipped
    and scaled (an estimate with nothing above zero says nothing, and becomes uniform).

    :param prediction: Output of the decoder ``[B, W]``
    :param layout: Where each of the others stands
    :param action_loss: What it was trained with, ``"mse"`` or ``"cross_entropy"``
    :return: ``[B, W]``
    """
    result = prediction.clone()
    for columns in layout.block_columns:
        part = prediction[:, columns]
        if action_loss == "cross_entropy":
            result[:, columns] = part.softmax(dim=-1)
        else:
            # Far below what a float32 adds to anything else, so it matters only where all are zero
            positive = part.clamp(min=0) + 1e-30
            result[:, columns] = positive / positive.sum(dim=-1, keepdim=True)
    if layout.binary_columns:
        binary = prediction[:, layout.binary_columns]
        result[:, layout.binary_columns] = binary.sigmoid() if action_loss == "cross_entropy" else binary.clamp(0, 1)
    return result
