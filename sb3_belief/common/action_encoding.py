"""How an action is encoded as a vector: the one rule for what others' actions look like to an agent."""

from typing import NamedTuple

import numpy as np
from gymnasium import spaces


class ActionEncoding(NamedTuple):
    """
    How ``gymnasium.spaces.flatten`` encodes the actions of a space.

    :param kind: ``"categorical"`` for one-hot vectors (Discrete, MultiDiscrete), ``"binary"`` for zeros and ones (MultiBinary)
        or ``"number"`` for the values themselves (Box)
    :param widths: Widths of its parts: one for each dimension of a MultiDiscrete space, a single one otherwise
    """

    kind: str
    widths: list[int]

    @property
    def width(self) -> int:
        """The width of the whole vector."""
        return sum(self.widths)


def action_encoding(name: str, space: spaces.Space) -> ActionEncoding:
    """
    Return how an agent's actions are encoded.

    :param name: Name of the agent, for the message
    :param space: Its action space
    :return: The encoding
    :raises ValueError: If the space is of another kind than Discrete, MultiDiscrete, MultiBinary and Box
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
