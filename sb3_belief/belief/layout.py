"""The layout of the vector that holds the actions of the other agents."""

from collections.abc import Sequence
from typing import NamedTuple

import torch as th

#: The encodings of an action: one-hot vectors, zeros and ones, or the numbers themselves
KINDS = ("categorical", "binary", "number")


class Block(NamedTuple):
    """The columns ``start`` to ``start + width``, a one-hot vector of one action component of the other agent ``owner``."""

    owner: int
    start: int
    width: int


class ActionLayout:
    """
    Layout of the others' actions, which lie side by side in one vector of width ``W``, in a fixed order of the others.

    :param widths: For each of the others, the widths of the parts of its flattened action. A Discrete space (a one-hot
        vector), a MultiBinary and a Box space have one part, a MultiDiscrete space has one for each dimension
    :param kinds: For each of the others, the encoding of its parts: ``"categorical"`` (Discrete, MultiDiscrete),
        ``"binary"`` (MultiBinary) or ``"number"`` (Box)
    :raises ValueError: If the two differ in length, or a kind is none of these
    """

    def __init__(self, widths: Sequence[Sequence[int]], kinds: Sequence[str]) -> None:
        if len(widths) != len(kinds) or not set(kinds) <= set(KINDS):
            raise ValueError(
                f"widths describes {len(widths)} others, kinds is {list(kinds)}; there must be one kind for each other, "
                f"of {', '.join(KINDS)}"
            )
        self.kinds = list(kinds)
        #: For each column, the number of the other agent to which it belongs
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
        #: The columns of the one-hot vectors. Vectors of equal width are grouped, so that one softmax normalises them all
        self.block_columns: list[list[list[int]]] = [
            [list(range(start, start + width)) for _, start, width in self.blocks if width == common]
            for common in sorted({block.width for block in self.blocks})
        ]
        #: ``owners`` as a tensor that indexes columns
        self.owner_index = th.as_tensor(self.owners, dtype=th.long)

    def columns_of(self, owner: int) -> slice:
        """
        Return the columns of one of the others.

        :param owner: Number of the other agent, from 0
        :return: Slice of the columns that hold its action
        """
        start = self.owners.index(owner)
        return slice(start, start + self.owners.count(owner))
