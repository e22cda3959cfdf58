"""Whether tensors are still what they were, so that what was computed from them can be kept."""

from collections.abc import Iterable

import torch as th


class TensorVersions:
    """
    Tells whether tensors have been written to, or been replaced by others.

    PyTorch's version counters tell it, which every write increments, so no caller has to report its writes. A write through
    ``tensor.data`` is not counted, nor is a step of a fused optimiser (see ``sb3_belief.belief_ppo.policies``).
    """

    def __init__(self) -> None:
        self._state: list[tuple[int, int]] | None = None

    def changed(self, tensors: Iterable[th.Tensor]) -> bool:
        """
        Compare tensors with those of the last call.

        :param tensors: The tensors, always in the same order
        :return: Whether anything has changed since the last call; True at the first
        """
        tensors = list(tensors)
        state = [(tensor.data_ptr(), tensor._version) for tensor in tensors]
        if state == self._state:
            return False
        # They are kept alive, so that no other tensor can be allocated at the same address
        self._state, self._tensors = state, tensors
        return True
