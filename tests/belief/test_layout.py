"""Where each of the others stands."""

import pytest

from sb3_belief.belief import ActionLayout


def test_layout_says_whose_columns_are_whose():
    layout = ActionLayout([[3], [2], [2, 3], [2]], ["categorical", "number", "categorical", "binary"])
    assert layout.n_others == 4 and layout.width == 12
    assert layout.owners == [0, 0, 0, 1, 1, 2, 2, 2, 2, 2, 3, 3]
    assert layout.blocks == [(0, 0, 3), (2, 5, 2), (2, 7, 3)]
    assert layout.block_columns == [[[5, 6]], [[0, 1, 2], [7, 8, 9]]] and layout.binary_columns == [10, 11]
    assert [layout.columns_of(owner) for owner in range(4)] == [slice(0, 3), slice(3, 5), slice(5, 10), slice(10, 12)]


def test_layout_of_nobody():
    layout = ActionLayout([], [])
    assert (layout.n_others, layout.width, layout.blocks, layout.block_columns, layout.binary_columns) == (0, 0, [], [], [])


def test_layout_refuses_what_does_not_fit():
    with pytest.raises(ValueError, match="2 others"):
        ActionLayout([[3], [2]], ["categorical"])
    with pytest.raises(ValueError, match="categorical, binary, number"):
        ActionLayout([[3]], ["discrete"])
