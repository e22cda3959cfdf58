"""The encoding of actions as vectors, in which an agent gets the actions of the others."""

from typing import NamedTuple

import numpy as np
from gymnasium import spaces


class ActionEncoding(NamedTuple):
    """
    Description of how ``gymnasium.spaces.flatten`` encodes the actions of a space.

    :param kind: ``"categorical"`` for one-hot vectors (Discrete, MultiDiscrete), ``"binary"`` for zeros and ones (MultiBinary)
        or ``"number"`` for the values themselves (Box)
    :param widths: Widths of the vector's parts: one for each dimension of a MultiDiscrete space, a single one otherwise
    """

    kind: str
    widths: list[int]

    @property
    def width(self) -> int:
        """Width of the whole vector."""
        return sum(self.widths)


def action_encoding(name: str, space: spaces.Space) -> ActionEncoding:
    """
    Return the encoding of an agent's actions.

    :param name: Name of the agent, for the error message
    :param space: Its action space
    :return: The encoding
    :raises ValueError: If the space is not Discrete, MultiDiscrete, MultiBinary or Box
    """
    if isinstance(space, spaces.Discrete):
        return ActionEncoding("categorical", [int(space.n)])
    if isinstance(space, spaces.MultiDiscrete):
        return ActionEncoding("categorical", [int(n) for n in space.nvec.flatten()])
    if isinstance(space, spaces.MultiBinary):
        return ActionEncoding("binary", [int(np.prod(space.n))])
    if isinstance(space, spaces.Box):
        return ActionEncoding("number", [int(np.prod(space.shape))])
    raise ValueError(
        f"{name} has the action space {space}; a belief can be held about Discrete, MultiDiscrete, MultiBinary "
        "and Box actions. Flatten its action space in the environment."
    )


class RowEncoder:
    """
    Encodes many values of a space at once, each as ``gymnasium.spaces.flatten`` encodes it.

    :param name: Of the agent, for the error message
    :param space: A Discrete, MultiDiscrete, MultiBinary or Box space
    :raises ValueError: For another space
    """

    def __init__(self, name: str, space: spaces.Space):
        encoding = action_encoding(name, space)
        #: Width of a row
        self.width = encoding.width
        # The first column of the one-hot code of each discrete component
        starts = np.concatenate([[0], np.cumsum(encoding.widths)[:-1]]).astype(int)
        self._offsets = starts if encoding.kind == "categorical" else None

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """
        Encode values.

        :param values: ``[n, ...]``, each in the space
        :return: float32 ``[n, width]``; these values themselves where they need no other form
        """
        rows = values.reshape(len(values), int(np.prod(values.shape[1:])))
        if self._offsets is None:
            return rows.astype(np.float32, copy=False)
        encoded = np.zeros((len(rows), self.width), dtype=np.float32)
        encoded[np.arange(len(rows))[:, None], rows.astype(int) + self._offsets] = 1.0
        return encoded
