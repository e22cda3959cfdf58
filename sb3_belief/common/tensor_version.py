"""Whether tensors are still what they were, so that what was made from them can be kept."""

from collections.abc import Iterable
from typing import Any

import torch as th
from torch.autograd.graph import increment_version


class TensorVersions:
    """
    Tells when tensors have been written to, or others have taken their places. Told by PyTorch's version counters, which each
    write moves: no caller has to think of it.
    """

    def __init__(self) -> None:
        self._state: list[tuple[int, int]] | None = None

    def changed(self, tensors: Iterable[th.Tensor]) -> bool:
        """
        :param tensors: in a fixed order
        :return: whether anything has changed since this was asked last; also the first time
        """
        tensors = list(tensors)
        state = [(tensor.data_ptr(), tensor._version) for tensor in tensors]
        if state == self._state:
            return False
        # Those that were seen are held: no other tensor comes to lie in their memory
        self._state, self._tensors = state, tensors
        return True


def count_fused_step(optimizer: th.optim.Optimizer, *_: Any) -> None:
    """
    Move the version counters that PyTorch's fused optimisers leave where they are. A hook for after their steps.

    :param optimizer: which has done a step
    """
    for group in optimizer.param_groups:
        for weights in group["params"] if group.get("fused") else ():
            increment_version(weights)
