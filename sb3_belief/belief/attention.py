"""Attention to a few selected rows (eq. 4 of the paper), with a backward pass of its own."""

from typing import Any

import numpy as np
import torch as th
import torch.nn.functional as F


def largest(values: th.Tensor, n: int) -> th.Tensor:
    """
    :param values: ``[B, T]``, no gradient flows from them
    :param n: How many are wanted, at most T
    :return: Where the largest values of each row stand, in no particular order, long ``[B, n]``
    """
    if n == 0 or values.device.type != "cpu":
        return values.topk(n, dim=1, sorted=False).indices
    # A third of the time of topk()
    columns = np.argpartition(values.detach().numpy(), -n, axis=1)[:, -n:]
    return th.from_numpy(np.ascontiguousarray(columns))


def attend(queries: th.Tensor, rows: th.Tensor, kept: th.Tensor, scale: float) -> tuple[th.Tensor, th.Tensor]:
    """
    Each query's mean of its kept rows, weighted by a softmax over the scaled products with them.

    :param queries: ``[B, d]``
    :param rows: ``[T, d]``
    :param kept: The rows that each query attends to, no row twice, long ``[B, N]``, N at least 1
    :param scale: What the products are multiplied by
    :return: The weighted means ``[B, d]``, and the weights ``[B, N]``, which are to be looked at: no gradient flows from them
    """
    return _Attend.apply(queries, rows, kept, scale)


class _Attend(th.autograd.Function):
    """
    Softmax attention with the usual gradient. Written out because the graph that PyTorch would record takes half as long
    again: it keeps and passes through several [B, T] matrices, of which the backward pass here needs one. Products with all
    rows are dense matrix products (on a CPU these are faster than gathering [B, N, d]); sums over the kept rows are
    `embedding_bag`, which touches no other. benchmarks/attention.py measures it against both alternatives.
    """

    @staticmethod
    def forward(ctx: Any, queries: th.Tensor, rows: th.Tensor, kept: th.Tensor, scale: float) -> tuple[th.Tensor, th.Tensor]:
        weights = (queries @ rows.T).gather(1, kept).mul_(scale).softmax(dim=1)
        ctx.save_for_backward(queries, rows, kept, weights)
        ctx.scale = scale
        ctx.mark_non_differentiable(weights)
        return _sum_kept(rows, kept, weights), weights

    @staticmethod
    def backward(ctx: Any, *grad_outputs: th.Tensor) -> tuple[th.Tensor | None, ...]:
        queries, rows, kept, weights = ctx.saved_tensors
        grad_means = grad_outputs[0]
        dense = grad_means @ rows.T
        grad_weights = dense.gather(1, kept)
        grad_scores = weights * (grad_weights - (grad_weights * weights).sum(dim=1, keepdim=True)) * ctx.scale
        # Rows are averaged, and multiplied with queries. One matrix for both: the second fills the places of the first
        dense = dense.zero_().scatter_(1, kept, weights)
        grad_rows = dense.T @ grad_means
        grad_rows.addmm_(dense.scatter_(1, kept, grad_scores).T, queries)
        return _sum_kept(rows, kept, grad_scores), grad_rows, None, None


def _sum_kept(rows: th.Tensor, kept: th.Tensor, weights: th.Tensor) -> th.Tensor:
    """Sums of the kept rows by these weights, ``[B, d]``."""
    return F.embedding_bag(kept, rows, per_sample_weights=weights, mode="sum")
