"""Attention to a few selected rows (eq. 4 of the paper), with a backward pass of its own."""

import warnings
from typing import Any

import numpy as np
import torch as th
import torch.nn.functional as F

with warnings.catch_warnings():
    # PyTorch says once that its sparse tensors are in beta state; what is used of them here is tested
    warnings.filterwarnings("ignore", "Sparse CSR tensor support")
    _none = th.zeros(0, dtype=th.int)
    th.sparse_csr_tensor(th.zeros(2, dtype=th.int), _none, th.zeros(0), size=(1, 1), check_invariants=False)


def topk_indices(values: th.Tensor, n: int) -> th.Tensor:
    """
    :param values: ``[..., T]``, no gradient flows from them
    :param n: How many are wanted, at most T
    :return: Where the largest values of each row stand, in ascending order, int32 ``[..., n]``
    """
    if n == 0 or values.device.type != "cpu":
        return values.topk(n, dim=-1, sorted=False).indices.int().sort(dim=-1).values
    # A third of the time of topk()
    columns = np.argpartition(values.detach().numpy(), -n, axis=-1)[..., -n:].astype(np.int32)
    columns.sort(axis=-1)
    return th.from_numpy(columns)


def attend(queries: th.Tensor, keys: th.Tensor, values: th.Tensor, kept: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """
    Each query's mean of the values of its kept rows, weighted by a softmax over its products with their keys.

    Several agents' can be computed at once, stacked along a first dimension of all arguments.

    :param queries: ``[B, d]``
    :param keys: ``[T, d]``
    :param values: ``[T, v]``
    :param kept: The rows that each query attends to, in ascending order and none twice, int32 ``[B, N]``
    :return: The weighted means ``[B, v]``, zero where N is 0, and the weights ``[B, N]``, which are to be looked at: no
        gradient flows from them
    :raises ValueError: if more rows are to be kept than there are, or others
    """
    n_rows = keys.shape[-2]
    if kept.shape[-1] > n_rows:
        raise ValueError(f"{kept.shape[-1]} rows are to be kept of a history of {n_rows}; keep at most as many")
    if kept.numel() == 0:
        return queries.new_zeros(*queries.shape[:-1], values.shape[-1]), queries.new_zeros(kept.shape)
    first, last = (int(row) for row in kept.aminmax())
    if first < 0 or last >= n_rows:
        raise ValueError(
            f"rows {first} to {last} are to be kept of a history of {n_rows}; keep rows that it has, selected from "
            "the history as it is now"
        )
    # Several agents' rows stand below each other in one table
    in_table = kept if kept.dim() == 2 else kept + n_rows * th.arange(len(kept), device=kept.device).int()[:, None, None]
    flat_values, in_table = values.flatten(0, -2), in_table.flatten(0, -2)
    if th.is_grad_enabled():
        means, weights = _Attend.apply(queries.flatten(0, -2), keys.flatten(0, -2), flat_values, in_table)
    else:
        # For the few queries of a rollout a product with all keys is quicker than naming the wanted ones
        weights = (queries @ keys.mT).gather(-1, kept.long()).softmax(dim=-1)
        means = _sums(flat_values, in_table, weights.flatten(0, -2))
    return means.view(*queries.shape[:-1], -1), weights.view(kept.shape)


class _Attend(th.autograd.Function):
    """
    Softmax attention with the usual gradient. Written out because what PyTorch would record multiplies each query with all
    rows, and each row with all queries, although a twentieth of these products is wanted; and gathering [B, N, d] to have the
    wanted ones only takes longer still. benchmarks/attention.py measures it against both.
    """

    @staticmethod
    def forward(
        ctx: Any, queries: th.Tensor, keys: th.Tensor, values: th.Tensor, kept: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        # Kept for the backward pass, which needs products at the same places
        ctx.wanted = _wanted(kept, len(keys), queries.dtype)
        weights = _products(queries, keys, ctx.wanted).softmax(dim=-1)
        ctx.save_for_backward(queries, keys, values, kept, weights)
        ctx.mark_non_differentiable(weights)
        return _sums(values, kept, weights), weights

    @staticmethod
    def backward(ctx: Any, *grad_outputs: th.Tensor) -> tuple[th.Tensor | None, ...]:
        queries, keys, values, kept, weights = ctx.saved_tensors
        grad_means = grad_outputs[0]
        grad_weights = _products(grad_means, values, ctx.wanted)
        grad_scores = weights * (grad_weights - (grad_weights * weights).sum(dim=1, keepdim=True))
        by_row = _ByRow(kept, len(keys))
        grad_keys, grad_values = by_row.sums(queries, grad_scores), by_row.sums(grad_means, weights)
        return _sums(keys, kept, grad_scores), grad_keys, grad_values, None


def _wanted(kept: th.Tensor, n_rows: int, dtype: th.dtype) -> th.Tensor:
    """A sparse ``[B, T]`` of zeros at the kept rows of each query."""
    starts = th.arange(0, kept.numel() + 1, kept.shape[1], dtype=kept.dtype, device=kept.device)
    zeros = th.zeros(kept.numel(), dtype=dtype, device=kept.device)
    return th.sparse_csr_tensor(starts, kept.flatten(), zeros, size=(len(kept), n_rows), check_invariants=False)


def _products(queries: th.Tensor, rows: th.Tensor, wanted: th.Tensor) -> th.Tensor:
    """Products of each query with its wanted rows, ``[B, N]``."""
    return th.sparse.sampled_addmm(wanted, queries, rows.T).values().view(len(queries), -1)


def _sums(rows: th.Tensor, kept: th.Tensor, weights: th.Tensor) -> th.Tensor:
    """Sums of the kept rows by these weights, ``[B, d]``."""
    return F.embedding_bag(kept, rows, per_sample_weights=weights, mode="sum")


class _ByRow:
    """
    Which queries keep each row, to sum over them.

    :param kept: ``[B, N]``
    :param n_rows: T
    """

    def __init__(self, kept: th.Tensor, n_rows: int) -> None:
        # On a CPU numpy's sort of short integers takes a tenth of PyTorch's time
        if kept.device.type == "cpu":
            rows = kept.numpy().ravel().astype(np.uint16 if n_rows <= 2**16 else np.int32)
            order = rows.argsort(kind="stable")
            # Nor is PyTorch quick to divide whole numbers
            self._order, self._queries = th.from_numpy(order), th.from_numpy(order // kept.shape[1]).int()
            counts = th.from_numpy(np.bincount(rows, minlength=n_rows))
        else:
            self._order = kept.flatten().argsort(stable=True)
            self._queries = (self._order // kept.shape[1]).int()
            counts = kept.flatten().bincount(minlength=n_rows)
        self._starts = (counts.cumsum(0) - counts).int()

    def sums(self, queries: th.Tensor, weights: th.Tensor) -> th.Tensor:
        """For each row the sum of the queries that keep it, by these weights ``[B, N]``: ``[T, d]``."""
        by_row = weights.flatten().index_select(0, self._order)
        return F.embedding_bag(self._queries, queries, self._starts, per_sample_weights=by_row, mode="sum")
