"""What an agent remembers: its own last steps, each with the actions of the others it could see."""

from typing import NamedTuple

import torch as th


class History(NamedTuple):
    """
    The agent's last ``T`` active steps (Sec. 4.1 of the paper), oldest first.

    :param observations: The agent's own observations, float ``[T, d_o]``
    :param actions: The others' actions at the same steps, flattened and side by side, float ``[T, W]``;
        zero where an action was not visible
    :param valid: Which rows hold a step, bool ``[T]``: all, once the agent has lived for ``T`` steps
    """

    observations: th.Tensor
    actions: th.Tensor
    valid: th.Tensor


def empty_history(length: int, observation_dim: int, action_dim: int) -> History:
    """
    :param length: ``T``, the number of steps to remember, at least 1
    :param observation_dim: ``d_o``
    :param action_dim: ``W``
    :return: A history in which nothing has happened yet
    """
    return History(th.zeros(length, observation_dim), th.zeros(length, action_dim), th.zeros(length, dtype=th.bool))


def append_rows(history: History, observations: th.Tensor, actions: th.Tensor) -> History:
    """
    The history after further steps: the newest ``T`` of the old and the new rows.

    :param history: What is remembered so far, ``T`` rows
    :param observations: The new steps' observations, oldest first, ``[N, d_o]``
    :param actions: The others' actions at those steps, ``[N, W]``
    :return: A new history of the same length; the one given is left as it is
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
