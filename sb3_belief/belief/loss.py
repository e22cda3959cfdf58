"""The two terms that train a belief (eq. 7 and 8 of the paper)."""

import torch as th


def action_loss(prediction: th.Tensor, actions: th.Tensor, visible: th.Tensor, owners: th.Tensor) -> th.Tensor:
    """
    Squared error of the predicted actions of the visible others (eq. 7), summed over the components of an action
    and averaged over the visible others of the batch. The paper writes a norm and calls it a mean squared error;
    the square is what its derivation from the likelihood (eq. 6) gives.

    :param prediction: Predicted actions ``[B, W]``
    :param actions: Actions taken ``[B, W]``
    :param visible: Whose action was visible, bool ``[B, n_others]``
    :param owners: The other to whom each column belongs, long ``[W]``
    :return: A scalar, zero where nobody is visible
    """
    errors = (actions - prediction).square() * visible[:, owners]
    return errors.sum() / visible.sum().clamp(min=1)


def kl_divergence(mean: th.Tensor, log_std: th.Tensor) -> th.Tensor:
    """
    Divergence of the belief from the standard normal prior (eq. 6), summed over the latent's components and averaged
    over the batch.

    :param mean: ``[B, z]``
    :param log_std: ``[B, z]``
    :return: A scalar, at least zero
    """
    return 0.5 * (mean.square() + (2 * log_std).exp() - 1 - 2 * log_std).sum(dim=1).mean()
