"""The attention's own backward pass, against the graph that PyTorch records."""

import pytest
import torch as th

from sb3_belief.belief.attention import attend, largest


def plain(queries, rows, kept, scale):
    """Eq. 4, row by row."""
    means = []
    for query, own in zip(queries, kept, strict=True):
        weights = (rows[own] @ query * scale).softmax(dim=0)
        means.append(weights @ rows[own])
    return th.stack(means)


@pytest.mark.parametrize("n_queries, n_rows, n_kept, width", [(1, 1, 1, 1), (5, 9, 3, 4), (7, 6, 6, 2)])
def test_gradients_of_queries_and_rows(n_queries, n_rows, n_kept, width):
    th.manual_seed(0)
    inputs = [th.randn(n, width, dtype=th.float64, requires_grad=True) for n in (n_queries, n_rows)]
    queries, rows = inputs
    kept = th.rand(n_queries, n_rows).topk(n_kept, dim=1).indices
    assert th.autograd.gradcheck(lambda q, r: attend(q, r, kept, 0.7)[0], inputs)
    upstream = th.randn(n_queries, width, dtype=th.float64)
    found = th.autograd.grad(attend(queries, rows, kept, 0.7)[0], inputs, upstream)
    expected = th.autograd.grad(plain(queries, rows, kept, 0.7), inputs, upstream)
    for ours, theirs in zip(found, expected, strict=True):
        th.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-12)


def test_weights_are_a_distribution_over_the_kept_rows_and_carry_no_gradient():
    th.manual_seed(0)
    queries, rows = (th.randn(n, 3, requires_grad=True) for n in (4, 8))
    kept = th.rand(4, 8).topk(2, dim=1).indices
    means, weights = attend(queries, rows, kept, 1.0)
    th.testing.assert_close(weights.sum(dim=1), th.ones(4))
    th.testing.assert_close((weights[:, :, None] * rows[kept]).sum(dim=1), means)
    assert means.requires_grad and not weights.requires_grad


def test_a_row_that_nobody_keeps_gets_no_gradient():
    rows = th.randn(5, 3, requires_grad=True)
    attend(th.randn(2, 3), rows, th.tensor([[0, 1], [1, 3]]), 1.0)[0].sum().backward()
    assert rows.grad is not None
    assert not rows.grad[[2, 4]].any() and rows.grad[1].any()


@pytest.mark.parametrize("n", [0, 1, 3, 8])
def test_the_largest_are_those_of_a_sort(n):
    values = th.randn(6, 8, generator=th.Generator().manual_seed(0), requires_grad=True)
    found = largest(values, n)
    assert found.shape == (6, n) and found.dtype == th.long and found.is_contiguous()
    assert found.sort(dim=1).values.equal(values.argsort(dim=1)[:, 8 - n :].sort(dim=1).values)
