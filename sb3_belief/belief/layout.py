"""Where in the vector of the others' actions each of them stands."""

from collections.abc import Sequence
from typing import NamedTuple


class Block(NamedTuple):
    """Columns ``start`` to ``start + width`` hold one action component of other number ``owner``, as a one-hot vector."""

    owner: int
    start: int
    width: int


class ActionLayout:
    """
    The others' actions lie side by side in one vector of width ``W``, in a fixed order of the others.

    :param widths: For each other, the widths of the parts of its flattened action: one part for a Discrete space
        (its one-hot vector) or a Box, one part a dimension for MultiDiscrete
    :param categorical: For each other, whether its parts are one-hot vectors (Discrete, MultiDiscrete) or numbers
    """

    def __init__(self, widths: Sequence[Sequence[int]], categorical: Sequence[bool]) -> None:
        if len(widths) != len(categorical):
            raise ValueError(f"widths speaks of {len(widths)} others, categorical of {len(categorical)}")
        self.owners: list[int] = []
        self.blocks: list[Block] = []
        for owner, (parts, is_categorical) in enumerate(zip(widths, categorical, strict=True)):
            for width in parts:
                if is_categorical:
                    self.blocks.append(Block(owner, len(self.owners), width))
                self.owners += [owner] * width
        self.n_others = len(widths)
        self.width = len(self.owners)
