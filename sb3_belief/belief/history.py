"""The history of an agent: its own last steps, each with the actions of the others that it could see."""

from typing import NamedTuple

import torch as th


class History(NamedTuple):
    """
    The last ``T`` steps in which an agent was active (Sec. 4.1 of the paper), oldest first.

    :param observations: The agent's own observations, float ``[T, d_o]``
    :param actions: The others' actions at the same steps, flattened and side by side, float ``[T, W]``. Zero where an
        action was not visible
    :param valid: Whether each row holds a step, bool ``[T]``. All rows do once the agent has been active for ``T`` steps
    """

    observations: th.Tensor
    actions: th.Tensor
    valid: th.Tensor


def empty_history(length: int, observation_dim: int, action_dim: int) -> History:
    """
    Return a history without any steps.

    :param length: Number of rows ``T``, at least 1
    :param observation_dim: Width ``d_o`` of an observation
    :param action_dim: Width ``W`` of the others' actions
    :return: A history of which no row is valid
    """
    return History(th.zeros(length, observation_dim), th.zeros(length, action_dim), th.zeros(length, dtype=th.bool))


def append_rows(history: History, observations: th.Tensor, actions: th.Tensor) -> History:
    """
    Return the history after further steps, which holds the newest ``T`` of the old and the new rows.

    :param history: History of ``T`` rows. It is not changed
    :param observations: Observations of the new steps, oldest first, ``[N, d_o]``
    :param actions: The others' actions at those steps, ``[N, W]``
    :return: A new history of ``T`` rows, the valid ones first
    """
    length = len(history.valid)
    observations = th.cat([history.observations[history.valid], observations.to(history.observations)])[-length:]
    actions = th.cat([history.actions[history.valid], actions.to(history.actions)])[-length:]
    missing = length - len(observations)
    if missing:
        observations = th.cat([observations, observations.new_zeros(missing, observations.shape[1])])
        actions = th.cat([actions, actions.new_zeros(missing, actions.shape[1])])
    valid = th.arange(length, device=history.valid.device) < length - missing
    return History(observations, actions, valid)
