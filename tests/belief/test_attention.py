"""The attention's own backward pass, against the graph that PyTorch records."""

import pytest
import torch as th

from sb3_belief.belief.attention import attend


def plain(queries, keys, values, kept, scale):
    """Eq. 4, row by row."""
    rows = []
    for query, own in zip(queries, kept, strict=True):
        weights = (keys[own] @ query * scale).softmax(dim=0)
        rows.append(weights @ values[own])
    return th.stack(rows)


@pytest.mark.parametrize("n_queries, n_rows, n_kept, width", [(1, 1, 1, 1), (5, 9, 3, 4), (7, 6, 6, 2)])
def test_gradients_of_queries_keys_and_values(n_queries, n_rows, n_kept, width):
    th.manual_seed(0)
    queries, keys, values = (th.randn(n, width, dtype=th.float64, requires_grad=True) for n in (n_queries, n_rows, n_rows))
    kept = th.rand(n_queries, n_rows).topk(n_kept, dim=1).indices
    inputs = (queries, keys, values)
    assert th.autograd.gradcheck(lambda q, k, v: attend(q, k, v, kept, 0.7)[0], inputs)
    upstream = th.randn(n_queries, width, dtype=th.float64)
    found = th.autograd.grad(attend(queries, keys, values, kept, 0.7)[0], inputs, upstream)
    expected = th.autograd.grad(plain(queries, keys, values, kept, 0.7), inputs, upstream)
    for ours, theirs in zip(found, expected, strict=True):
        th.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-12)


def test_weights_are_a_distribution_over_the_kept_rows_and_carry_no_gradient():
    th.manual_seed(0)
    queries, keys, values = (th.randn(n, 3, requires_grad=True) for n in (4, 8, 8))
    kept = th.rand(4, 8).topk(2, dim=1).indices
    sums, weights = attend(queries, keys, values, kept, 1.0)
    th.testing.assert_close(weights.sum(dim=1), th.ones(4))
    th.testing.assert_close((weights[:, :, None] * values[kept]).sum(dim=1), sums)
    assert sums.requires_grad and not weights.requires_grad


def test_a_row_that_nobody_keeps_gets_no_gradient():
    keys, values = (th.randn(5, 3, requires_grad=True) for _ in range(2))
    attend(th.randn(2, 3), keys, values, th.tensor([[0, 1], [1, 3]]), 1.0)[0].sum().backward()
    for rows in (keys.grad, values.grad):
        assert rows is not None
        assert not rows[[2, 4]].any() and rows[1].any()
