"""The memory of an adaptive belief: an agent's own steps, each with what the others did and what became of it."""

from typing import NamedTuple

import torch as th

#: The first copy of an environment in which an agent that does not train acts; the next ones are -2, -3, ...
DEPLOYED = -1
#: In place of the step with which an episode began, of the first one of such a copy
FIRST_EPISODE = -1


class Memory(NamedTuple):
    """
    Steps of an agent, oldest first.

    :param observations: Its own observations, float ``[T, d_o]``
    :param actions: The others' actions at the same steps, flattened and side by side, zero where not visible, float ``[T, W]``
    :param own: Its own flattened action and its own reward, float ``[T, U + 1]``
    :param stamps: When and where: number of the step, of the copy of the environment (negative outside of training), and of
        the step with which its episode began, int64 ``[T, 3]``. Outside of training that is ``FIRST_EPISODE`` for the first
        one, and below it in the last row of an episode that has ended
    :param valid: Whether a row holds a step in which the agent was active, or waited for its turn, and saw another one act,
        bool ``[T]``
    """

    observations: th.Tensor
    actions: th.Tensor
    own: th.Tensor
    stamps: th.Tensor
    valid: th.Tensor


def empty_memory(length: int, observation_dim: int, action_dim: int, own_dim: int) -> Memory:
    """
    Return a memory without any steps.

    :param length: Number of rows ``T``, at least 1
    :param observation_dim: Width ``d_o`` of an observation
    :param action_dim: Width ``W`` of the others' actions
    :param own_dim: Width ``U + 1`` of the agent's own action and reward
    :return: A memory of which no row is valid
    """
    widths = observation_dim, action_dim, own_dim
    stamps, valid = th.zeros(length, 3, dtype=th.int64), th.zeros(length, dtype=th.bool)
    seen, did, own = (th.zeros(length, width) for width in widths)
    return Memory(seen, did, own, stamps, valid)


def followed_by(memory: Memory, rows: Memory) -> Memory:
    """
    Return the rows of one memory and then those of another.

    :param memory: T rows
    :param rows: N rows
    :return: T + N rows
    """
    return Memory(*(th.cat([before, after.to(before)]) for before, after in zip(memory, rows, strict=True)))


def valid_rows(memory: Memory) -> Memory:
    """
    Return the valid rows of a memory, without the rest.

    :param memory: A memory
    :return: Its valid rows
    """
    return Memory(*(part[memory.valid] for part in memory))


def newest(memory: Memory, length: int) -> Memory:
    """
    Return the last valid rows of a memory.

    :param memory: A memory
    :param length: Number of rows of the result, the valid ones first
    :return: The rows
    """
    rows = memory.valid.nonzero().flatten()[-length:]
    return Memory(*(th.cat([part[rows], part.new_zeros(length - len(rows), *part.shape[1:])]) for part in memory))
