"""
Attention to a few selected rows (eq. 4 of the paper).

:func:`reference_attention` is the definition. :func:`attend` computes the same, several times faster: what PyTorch would
    record of the definition gathers ``[B, N, d]``, and the obvious alternative multiplies each query with all rows, although a
    twentieth of these products is needed. ``benchmarks/attention.py`` measures it against both.
"""

import warnings
from typing import Any

import numpy as np
import torch as th
import torch.nn.functional as F

with warnings.catch_warnings():
    # PyTorch warns once that its sparse tensors are in beta state; the part used here is tested
    warnings.filterwarnings("ignore", "Sparse CSR tensor support")
    _none = th.zeros(0, dtype=th.int)
    th.sparse_csr_tensor(th.zeros(2, dtype=th.int), _none, th.zeros(0), size=(1, 1), check_invariants=False)


def reference_attention(
    queries: th.Tensor, keys: th.Tensor, values: th.Tensor, selected: th.Tensor
) -> tuple[th.Tensor, th.Tensor]:
    """
    Return each query's mean of the values of its selected rows, weighted by a softmax over its products with their keys.

    :param queries: ``[B, d]``
    :param keys: ``[T, d]``
    :param values: ``[T, v]``
    :param selected: The rows that each query attends to, ``[B, N]``
    :return: The weighted means ``[B, v]`` and the weights ``[B, N]``
    """
    scores = (queries[:, None] * keys[selected]).sum(dim=-1)
    weights = scores.softmax(dim=-1)
    return (weights[:, :, None] * values[selected]).sum(dim=1), weights


def topk_indices(values: th.Tensor, n: int) -> th.Tensor:
    """
    Return the indices of the largest values of each row.

    :param values: ``[..., T]``; no gradient flows from them
    :param n: How many, at most T
    :return: Their indices in ascending order, int32 ``[..., n]``
    """
    # A graph that is being exported consists of PyTorch's operations
    if n == 0 or values.device.type != "cpu" or th.compiler.is_compiling():
        return values.topk(n, dim=-1, sorted=False).indices.int().sort(dim=-1).values
    # A third of the time of topk()
    columns = np.argpartition(values.detach().numpy(), -n, axis=-1)[..., -n:].astype(np.int32)
    columns.sort(axis=-1)
    return th.from_numpy(columns)


def attend(queries: th.Tensor, keys: th.Tensor, values: th.Tensor, selected: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """
    Compute :func:`reference_attention` fast.

    The queries of several agents can be computed at once, stacked along a first dimension of all arguments.

    :param queries: ``[B, d]``
    :param keys: ``[T, d]``
    :param values: ``[T, v]``
    :param selected: The rows that each query attends to, in ascending order and none twice, int32 ``[B, N]``
    :return: The weighted means ``[B, v]``, zero where N is 0, and the weights ``[B, N]``, from which no gradient flows
    :raises ValueError: If more rows are selected than there are, or rows that do not exist
    """
    n_rows = keys.shape[-2]
    if selected.shape[-1] > n_rows:
        raise ValueError(f"{selected.shape[-1]} rows are selected from a history of {n_rows}; select at most as many")
    if selected.numel() == 0:
        return queries.new_zeros(*queries.shape[:-1], values.shape[-1]), queries.new_zeros(selected.shape)
    if th.compiler.is_compiling():
        return reference_attention(queries, keys, values, selected.long())
    first, last = (int(row) for row in selected.aminmax())
    if first < 0 or last >= n_rows:
        raise ValueError(
            f"rows {first} to {last} are selected from a history of {n_rows}; select rows that it has, from "
            "the history as it is now"
        )
    in_table = selected
    if selected.dim() == 3:
        # The rows of several agents lie below each other in one table
        in_table = selected + n_rows * th.arange(len(selected), device=selected.device).int()[:, None, None]
    flat_values, in_table = values.flatten(0, -2), in_table.flatten(0, -2)
    if th.is_grad_enabled():
        means, weights = _Attend.apply(queries.flatten(0, -2), keys.flatten(0, -2), flat_values, in_table)
    else:
        # For the few queries of a rollout a product with all keys is faster than picking the needed ones
        weights = (queries @ keys.mT).gather(-1, selected.long()).softmax(dim=-1)
        means = _sums(flat_values, in_table, weights.flatten(0, -2))
    return means.view(*queries.shape[:-1], -1), weights.view(selected.shape)


class _Attend(th.autograd.Function):
    """Softmax attention with its gradient written out, so that both passes multiply each query with its selected rows only."""

    @staticmethod
    def forward(
        ctx: Any, queries: th.Tensor, keys: th.Tensor, values: th.Tensor, selected: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        # The backward pass needs products at the same places
        ctx.mask = _mask(selected, len(keys), queries.dtype)
        weights = _products(queries, keys, ctx.mask).softmax(dim=-1)
        ctx.save_for_backward(queries, keys, values, selected, weights)
        ctx.mark_non_differentiable(weights)
        return _sums(values, selected, weights), weights

    @staticmethod
    def backward(ctx: Any, *grad_outputs: th.Tensor) -> tuple[th.Tensor | None, ...]:
        queries, keys, values, selected, weights = ctx.saved_tensors
        grad_means = grad_outputs[0]
        grad_weights = _products(grad_means, values, ctx.mask)
        grad_scores = weights * (grad_weights - (grad_weights * weights).sum(dim=1, keepdim=True))
        by_row = _ByRow(selected, len(keys))
        grad_keys, grad_values = by_row.sums(queries, grad_scores), by_row.sums(grad_means, weights)
        return _sums(keys, selected, grad_scores), grad_keys, grad_values, None


def _mask(selected: th.Tensor, n_rows: int, dtype: th.dtype) -> th.Tensor:
    """Return a sparse ``[B, T]`` that has entries, all zero, at the selected rows of each query."""
    starts = th.arange(0, selected.numel() + 1, selected.shape[1], dtype=selected.dtype, device=selected.device)
    zeros = th.zeros(selected.numel(), dtype=dtype, device=selected.device)
    return th.sparse_csr_tensor(starts, selected.flatten(), zeros, size=(len(selected), n_rows), check_invariants=False)


def _products(queries: th.Tensor, rows: th.Tensor, mask: th.Tensor) -> th.Tensor:
    """Return the products of each query with its selected rows, ``[B, N]``."""
    return th.sparse.sampled_addmm(mask, queries, rows.T).values().view(len(queries), -1)


def _sums(rows: th.Tensor, selected: th.Tensor, weights: th.Tensor) -> th.Tensor:
    """Return the weighted sums of the selected rows, ``[B, d]``."""
    return F.embedding_bag(selected, rows, per_sample_weights=weights, mode="sum")


class _ByRow:
    """
    Sums over the queries that have selected a row: the transposed of the forward pass.

    The selected rows are sorted by row once, so that the sums for the gradients of keys and of values are segment sums.

    :param selected: ``[B, N]``
    :param n_rows: T
    """

    def __init__(self, selected: th.Tensor, n_rows: int) -> None:
        # On a CPU numpy's sort of short integers takes a tenth of PyTorch's time
        if selected.device.type == "cpu":
            rows = selected.numpy().ravel().astype(np.uint16 if n_rows <= 2**16 else np.int32)
            order = rows.argsort(kind="stable")
            # PyTorch's integer division is slow, too
            self._order, self._queries = th.from_numpy(order), th.from_numpy(order // selected.shape[1]).int()
            counts = th.from_numpy(np.bincount(rows, minlength=n_rows))
        else:
            self._order = selected.flatten().argsort(stable=True)
            self._queries = (self._order // selected.shape[1]).int()
            counts = selected.flatten().bincount(minlength=n_rows)
        self._starts = (counts.cumsum(0) - counts).int()

    def sums(self, queries: th.Tensor, weights: th.Tensor) -> th.Tensor:
        """Return for each row the weighted sum of the queries that have selected it, ``[T, d]``; weights are ``[B, N]``."""
        by_row = weights.flatten().index_select(0, self._order)
        return F.embedding_bag(self._queries, queries, self._starts, per_sample_weights=by_row, mode="sum")


def attend_beside_null(
    queries: th.Tensor, rows: th.Tensor, bias: th.Tensor, null: th.Tensor, selected: th.Tensor
) -> tuple[th.Tensor, th.Tensor]:
    """
    Return each query's weighted sum of its selected rows, which share a softmax with a null row of no content.

    The scores are products of queries and rows plus a bias. Unlike those of :func:`attend`, the weights have gradients.

    :param queries: ``[B, d]``
    :param rows: ``[T, d]``, T at least 1
    :param bias: Added to the scores, ``[B, N]``; minus infinity for a row that takes no part
    :param null: Scores of the null row, ``[B]``
    :param selected: The rows, int32 ``[B, N]`` in [0, T)
    :return: The weighted sums, ``[B, d]``, and the weights, those of the null row last, ``[B, N + 1]``
    """
    # A sparse matrix has no more entries in a row than columns
    if th.compiler.is_compiling() or selected.shape[1] > len(rows):
        scores = (queries[:, None] * rows[selected.long()]).sum(dim=-1) + bias
        return sum_beside_null(rows, scores, null, selected)
    return _AttendBesideNull.apply(queries, rows, bias, null, selected)


def sum_beside_null(rows: th.Tensor, scores: th.Tensor, null: th.Tensor, selected: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """
    Return what :func:`attend_beside_null` does where the scores are known.

    :param rows: ``[T, d]``, T at least 1
    :param scores: Scores of the selected rows, ``[B, N]``; minus infinity for a row that takes no part
    :param null: Scores of the null row, ``[B]``
    :param selected: The rows, int32 ``[B, N]`` in [0, T)
    :return: The weighted sums, ``[B, d]``, and the weights, those of the null row last, ``[B, N + 1]``
    """
    weights = th.cat([scores, null[:, None]], dim=1).softmax(dim=1)
    if th.compiler.is_compiling():
        return (weights[:, :-1, None] * rows[selected.long()]).sum(dim=1), weights
    return _sums(rows, selected, weights[:, :-1].contiguous()), weights


class _AttendBesideNull(th.autograd.Function):
    """As :class:`_Attend`, in which a gather of ``[B, N, d]`` and its gradient would take most of the time."""

    @staticmethod
    def forward(
        ctx: Any, queries: th.Tensor, rows: th.Tensor, bias: th.Tensor, null: th.Tensor, selected: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        ctx.mask = _mask(selected, len(rows), queries.dtype)
        weights = th.cat([_products(queries, rows, ctx.mask) + bias, null[:, None]], dim=1).softmax(dim=1)
        ctx.save_for_backward(queries, rows, selected, weights)
        return _sums(rows, selected, weights[:, :-1].contiguous()), weights

    @staticmethod
    def backward(ctx: Any, *grad_outputs: th.Tensor) -> tuple[th.Tensor | None, ...]:
        queries, rows, selected, weights = ctx.saved_tensors
        grad_sums, grad_weights = grad_outputs
        grad_weights = grad_weights.clone()
        grad_weights[:, :-1] += _products(grad_sums, rows, ctx.mask)
        grad_scores = weights * (grad_weights - (grad_weights * weights).sum(dim=1, keepdim=True))
        of_rows = grad_scores[:, :-1].contiguous()
        by_row = _ByRow(selected, len(rows))
        grad_rows = by_row.sums(queries, of_rows) + by_row.sums(grad_sums, weights[:, :-1].contiguous())
        return _sums(rows, selected, of_rows), grad_rows, of_rows, grad_scores[:, -1], None
