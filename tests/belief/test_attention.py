"""The attention's own backward pass, against the graph that PyTorch records."""

import math
import subprocess
import sys

import pytest
import torch as th

from sb3_belief.belief.attention import attend, attend_beside_null, reference_attention, topk_indices


def plain(queries, keys, values, kept):
    """Eq. 4, row by row."""
    means = []
    for query, own in zip(queries, kept.long(), strict=True):
        weights = (keys[own] @ query).softmax(dim=0)
        means.append(weights @ values[own])
    return th.stack(means)


def chosen(n_queries, n_rows, n_selected):
    return th.rand(n_queries, n_rows).topk(n_selected, dim=1).indices.sort(dim=1).values.int()


@pytest.mark.parametrize("n_queries, n_rows, n_selected, width", [(1, 1, 1, 1), (5, 9, 3, 4), (7, 6, 6, 2)])
def test_gradients_of_queries_keys_and_values(n_queries, n_rows, n_selected, width):
    th.manual_seed(0)
    queries, keys = (th.randn(n, width, dtype=th.float64, requires_grad=True) for n in (n_queries, n_rows))
    values = th.randn(n_rows, width + 1, dtype=th.float64, requires_grad=True)
    inputs = [queries, keys, values]
    kept = chosen(n_queries, n_rows, n_selected)
    assert th.autograd.gradcheck(lambda q, k, v: attend(q, k, v, kept)[0], inputs)
    upstream = th.randn(n_queries, width + 1, dtype=th.float64)
    found = th.autograd.grad(attend(queries, keys, values, kept)[0], inputs, upstream)
    expected = th.autograd.grad(plain(queries, keys, values, kept), inputs, upstream)
    for ours, theirs in zip(found, expected, strict=True):
        th.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("n_queries, n_rows, n_selected, width", [(1, 1, 1, 1), (5, 9, 3, 4), (7, 6, 6, 2), (64, 800, 40, 16)])
def test_the_fast_path_agrees_with_the_reference(n_queries, n_rows, n_selected, width):
    th.manual_seed(0)
    queries, keys, values = inputs = [
        th.randn(n, width, dtype=th.float64, requires_grad=True) for n in (n_queries, n_rows, n_rows)
    ]
    selected, upstream = chosen(n_queries, n_rows, n_selected), th.randn(n_queries, width, dtype=th.float64)
    means, weights = attend(queries, keys, values, selected)
    expected_means, expected_weights = reference_attention(queries, keys, values, selected)
    th.testing.assert_close(expected_means, plain(queries, keys, values, selected), rtol=1e-12, atol=1e-12)
    th.testing.assert_close(means, expected_means, rtol=1e-12, atol=1e-12)
    th.testing.assert_close(weights, expected_weights, rtol=1e-12, atol=1e-12)
    expected = th.autograd.grad(expected_means, inputs, upstream)
    for ours, theirs in zip(th.autograd.grad(means, inputs, upstream), expected, strict=True):
        th.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("n_rows", [2**16, 2**16 + 1])
def test_gradients_of_more_rows_than_short_integers_count(n_rows):
    th.manual_seed(0)
    rows = th.randn(n_rows, 2, requires_grad=True)
    queries, kept = th.randn(2, 2), th.tensor([[0, n_rows - 1], [1, n_rows - 1]], dtype=th.int)
    (found,) = th.autograd.grad(attend(queries, rows, rows, kept)[0].sum(), rows)
    (expected,) = th.autograd.grad(plain(queries, rows, rows, kept).sum(), rows)
    th.testing.assert_close(found, expected)


@pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU")
def test_gradients_are_the_same_on_a_gpu():
    th.manual_seed(0)
    kept, upstream = chosen(64, 200, 10), th.randn(64, 8)
    queries, keys, values = (th.randn(n, 8, requires_grad=True) for n in (64, 200, 200))
    expected = th.autograd.grad(attend(queries, keys, values, kept)[0], [queries, keys, values], upstream)
    queries, keys, values = (tensor.detach().cuda().requires_grad_() for tensor in (queries, keys, values))
    means, _ = attend(queries, keys, values, kept.cuda())
    found = th.autograd.grad(means, [queries, keys, values], upstream.cuda())
    for ours, theirs in zip(found, expected, strict=True):
        th.testing.assert_close(ours.cpu(), theirs, rtol=1e-4, atol=1e-5)


def test_weights_are_a_distribution_over_the_kept_rows_and_carry_no_gradient():
    th.manual_seed(0)
    queries, rows = (th.randn(n, 3, requires_grad=True) for n in (4, 8))
    kept = chosen(4, 8, 2)
    means, weights = attend(queries, rows, rows, kept)
    th.testing.assert_close(weights.sum(dim=1), th.ones(4))
    th.testing.assert_close((weights[:, :, None] * rows[kept.long()]).sum(dim=1), means)
    assert means.requires_grad and not weights.requires_grad


def test_without_gradients_the_result_is_the_same():
    th.manual_seed(0)
    queries, keys, values = (th.randn(n, 3) for n in (4, 8, 8))
    kept = chosen(4, 8, 2)
    recorded = attend(queries, keys, values, kept)
    with th.no_grad():
        th.testing.assert_close(attend(queries, keys, values, kept), recorded)


@pytest.mark.parametrize("kept", [[[0, 3]], [[-1, 0]]])
def test_rows_that_there_are_not_cannot_be_kept(kept):
    rows = th.randn(3, 2, requires_grad=True)
    with pytest.raises(ValueError, match=r"rows (0 to 3|-1 to 0) are selected from a history of 3"):
        attend(th.randn(1, 2), rows, rows, th.tensor(kept, dtype=th.int))


def test_a_row_that_nobody_keeps_gets_no_gradient():
    keys, values = (th.randn(5, 3, requires_grad=True) for _ in range(2))
    attend(th.randn(2, 3), keys, values, th.tensor([[0, 1], [1, 3]]))[0].sum().backward()
    for rows in (keys, values):
        assert rows.grad is not None
        assert not rows.grad[[2, 4]].any() and rows.grad[1].any()


def test_nobody_is_told_of_sparse_tensors():
    program = (
        "import torch as th; from sb3_belief.belief.attention import attend;"
        "rows = th.ones(2, 2, requires_grad=True); attend(rows, rows, rows, th.tensor([[0], [1]]))[0].sum().backward()"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", program], check=True)


@pytest.mark.parametrize("n", [0, 1, 3, 8])
def test_the_largest_are_those_of_a_sort(n):
    values = th.randn(6, 8, generator=th.Generator().manual_seed(0), requires_grad=True)
    found = topk_indices(values, n)
    assert found.shape == (6, n) and found.dtype == th.int and found.is_contiguous()
    assert found.equal(values.argsort(dim=1)[:, 8 - n :].sort(dim=1).values.int())


@pytest.mark.parametrize("n_selected", [0, 3])
def test_stacked_agents_attend_each_to_its_own_rows(n_selected):
    th.manual_seed(0)
    queries, keys, values = th.randn(2, 5, 4), th.randn(2, 9, 4), th.randn(2, 9, 3)
    kept = topk_indices(queries @ keys.mT, n_selected)
    assert all(
        th.equal(own, chosen_rows)
        for own, chosen_rows in zip(kept, map(topk_indices, queries @ keys.mT, [n_selected] * 2), strict=True)
    )
    with th.no_grad():
        without_graph = attend(queries, keys, values, kept)
    for inputs in (queries, keys, values):
        inputs.requires_grad_()
    means, weights = attend(queries, keys, values, kept)
    for ours, theirs in zip(without_graph, (means, weights), strict=True):
        th.testing.assert_close(ours, theirs)
    found = th.autograd.grad(means.square().sum(), [queries, keys, values]) if n_selected else ()
    for i in range(2):
        own = [part[i].detach().requires_grad_() for part in (queries, keys, values)]
        expected = attend(own[0], own[1], own[2], kept[i])
        th.testing.assert_close(means[i], expected[0])
        th.testing.assert_close(weights[i], expected[1])
        for ours, theirs in zip(found, th.autograd.grad(expected[0].square().sum(), own) if n_selected else (), strict=True):
            th.testing.assert_close(ours[i], theirs)


@pytest.mark.parametrize("n_rows", [3, 30])
def test_attention_beside_a_null_row_equals_its_definition(n_rows):
    """Values and gradients, with rows that take no part; also where more rows are selected than there are."""
    generator = th.Generator().manual_seed(0)
    b, n, d = 7, 6, 5
    queries, rows, bias, null, weighting = (
        th.randn(*shape, generator=generator, dtype=th.double) for shape in ((b, d), (n_rows, d), (b, n), (b,), (b, n + 1))
    )
    selected = th.randint(n_rows, (b, n), generator=generator).int()
    bias[0, :] = -math.inf
    bias[1, 2:] = -math.inf
    inputs = [each.requires_grad_() for each in (queries, rows, bias, null)]

    scores = th.cat([(queries[:, None] * rows[selected.long()]).sum(dim=-1) + bias, null[:, None]], dim=1)
    weights = scores.softmax(dim=-1)
    sums = (weights[:, :-1, None] * rows[selected.long()]).sum(dim=1)
    expected = th.autograd.grad((sums.square().sum() + (weights * weighting).sum()), inputs)
    found_sums, found_weights = attend_beside_null(queries, rows, bias, null, selected)
    found = th.autograd.grad((found_sums.square().sum() + (found_weights * weighting).sum()), inputs)
    assert th.allclose(found_sums, sums) and th.allclose(found_weights, weights)
    # Nothing is known of a row that takes no part but its bias, whose gradient is zero
    for a, e in zip(found, expected, strict=True):
        assert th.allclose(a, e.nan_to_num())
    with th.no_grad():
        acting = attend_beside_null(queries, rows, bias, null, selected)
    assert th.allclose(acting[0], sums) and th.allclose(acting[1], weights)
