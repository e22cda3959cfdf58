"""The last bits of matrix products, on which exact repetition rests."""

import pytest
import torch as th

import sb3_belief


@pytest.mark.parametrize("width", [3, 18, 79])
def test_a_product_does_not_depend_on_where_its_matrix_lies(width):
    assert sb3_belief.__version__
    generator = th.Generator().manual_seed(0)
    inputs, weights = th.randn(5, width, generator=generator), th.randn(8, width, generator=generator)
    expected = th.nn.functional.linear(inputs, weights)
    memory = th.empty(inputs.numel() + 16)
    for start in range(16):
        moved = memory[start : start + inputs.numel()].view_as(inputs).copy_(inputs)
        assert th.equal(th.nn.functional.linear(moved, weights), expected), start
