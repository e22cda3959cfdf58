"""Where in the vector of the others' actions each of them stands."""

from collections.abc import Sequence
from typing import NamedTuple

import torch as th

#: How the parts of a flattened action are coded: one-hot vectors, zeros and ones, or numbers
KINDS = ("categorical", "binary", "number")


class Block(NamedTuple):
    """Columns ``start`` to ``start + width`` hold one action component of other number ``owner``, as a one-hot vector."""

    owner: int
    start: int
    width: int


class ActionLayout:
    """
    The others' actions lie side by side in one vector of width ``W``, in a fixed order of the others.

    :param widths: For each other, the widths of the parts of its flattened action: one part for a Discrete space
        (its one-hot vector), a MultiBinary or a Box, one part a dimension for MultiDiscrete
    :param kinds: For each other, how its parts are coded: ``"categorical"`` (Discrete, MultiDiscrete), ``"binary"``
        (MultiBinary) or ``"number"`` (Box)
    """

    def __init__(self, widths: Sequence[Sequence[int]], kinds: Sequence[str]) -> None:
        if len(widths) != len(kinds) or not set(kinds) <= set(KINDS):
            raise ValueError(
                f"widths speaks of {len(widths)} others, kinds is {list(kinds)}; there must be one kind for each other, "
                f"of {', '.join(KINDS)}"
            )
        self.kinds = list(kinds)
        #: The other to whom each column belongs
        self.owners: list[int] = []
        self.blocks: list[Block] = []
        for owner, (parts, kind) in enumerate(zip(widths, kinds, strict=True)):
            for width in parts:
                if kind == "categorical":
                    self.blocks.append(Block(owner, len(self.owners), width))
                self.owners += [owner] * width
        self.n_others = len(widths)
        self.width = len(self.owners)
        self.binary_columns = [column for column, owner in enumerate(self.owners) if kinds[owner] == "binary"]
        #: The columns of the one-hot vectors, those of equal width together so that they are normalised at once
        self.block_columns: list[list[list[int]]] = [
            [list(range(start, start + width)) for _, start, width in self.blocks if width == common]
            for common in sorted({block.width for block in self.blocks})
        ]
        #: ``owners`` as an index
        self.owner_index = th.as_tensor(self.owners, dtype=th.long)

    def columns_of(self, owner: int) -> slice:
        """
        :param owner: Number of one of the others
        :return: Where its action stands
        """
        start = self.owners.index(owner)
        return slice(start, start + self.owners.count(owner))
