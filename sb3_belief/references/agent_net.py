"""The agents' own value networks of a factorised learner, and what one joint observation tells a mixer about their values."""

from typing import NamedTuple

import torch as th
from torch import nn


class AgentValues(NamedTuple):
    """
    Values of all agents' actions in ``B`` joint observations, or in the steps ``[B, T]`` of episodes, which :meth:`rows` makes
    rows of.

    :param q: ``Q_i(u)`` for each action, ``[B, n, U]``; minus infinity where the action is not legal
    :param features: What the agents' last layers were given, ``[B, n, h]``
    :param state: The global state, ``[B, d_s]``
    """

    q: th.Tensor
    features: th.Tensor
    state: th.Tensor

    def rows(self, steps: slice) -> "AgentValues":
        """
        Return some steps of episodes as joint observations.

        :param steps: Which of the ``T`` steps
        :return: Values of ``B`` times as many joint observations
        """
        return AgentValues(*(part[:, steps].flatten(0, 1) for part in self))

    def where(self, which: th.Tensor) -> "AgentValues":
        """
        Return some of the joint observations.

        :param which: bool ``[B]``
        :return: Values of as many as are true
        """
        return AgentValues(*(part[which] for part in self))

    def greedy(self) -> th.Tensor:
        """Return each agent's best legal action, that of the lowest index where several are: int64 ``[B, n]``."""
        return self.q.argmax(dim=-1)

    def of(self, actions: th.Tensor) -> th.Tensor:
        """
        Return the values of chosen actions.

        :param actions: int64 ``[B, n]``
        :return: ``[B, n]``
        """
        return self.q.gather(-1, actions.unsqueeze(-1)).squeeze(-1)

    def one_hot(self, actions: th.Tensor) -> th.Tensor:
        """
        Return chosen actions as one-hot rows.

        :param actions: int64 ``[B, n]``
        :return: ``[B, n, U]``
        """
        return nn.functional.one_hot(actions, self.q.shape[-1]).to(self.features.dtype)


class AgentNet(nn.Module):
    """
    Each agent's value network: observation and last action (and, with shared weights, who it is) to the values of its actions.

    A ReLU layer, a GRU or a second ReLU layer, and a linear one, all ``hidden_dim`` wide.

    :param n_agents: Number of agents ``n``
    :param obs_dim: Width ``d`` of an observation
    :param n_actions: Number of actions ``U``
    :param hidden_dim: Width ``h``, at least 1
    :param recurrent: Whether the second layer is a GRU, which remembers the episode
    :param share: Whether the agents share all weights and are told apart by a one-hot id; otherwise each has its own
    :param n_outputs: Width of the last layer; None for a value of each action
    """

    def __init__(
        self,
        n_agents: int,
        obs_dim: int,
        n_actions: int,
        hidden_dim: int = 64,
        recurrent: bool = True,
        share: bool = True,
        n_outputs: int | None = None,
    ):
        super().__init__()
        self.n_agents, self.n_actions, self.hidden_dim, self.share = n_agents, n_actions, hidden_dim, share
        width = obs_dim + n_actions + (n_agents if share else 0)
        # With shared weights all agents are rows of one network
        self.nets = nn.ModuleList(
            _Net(width, hidden_dim, n_outputs or n_actions, recurrent) for _ in range(1 if share else n_agents)
        )

    def initial_hidden(self, n_rows: int) -> th.Tensor:
        """
        Return the hidden state at the beginning of an episode.

        :param n_rows: Number of episodes
        :return: Zeros ``[n_rows, n, h]``
        """
        return th.zeros(n_rows, self.n_agents, self.hidden_dim, device=next(self.parameters()).device)

    def forward(self, obs: th.Tensor, last_actions: th.Tensor, hidden: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """
        Pass ``T`` steps of ``B`` episodes.

        :param obs: Observations ``[B, T, n, d]``
        :param last_actions: One-hot actions of the steps before, zero at an episode's first step, ``[B, T, n, U]``
        :param hidden: Hidden states before the first of these steps, ``[B, n, h]``
        :return: Values ``[B, T, n, U]``, of legal and other actions alike, or what else the last layer says; features of that
            layer ``[B, T, n, h]``; hidden states after the last step ``[B, n, h]``
        """
        rows = th.cat([obs, last_actions], dim=-1)
        if self.share:
            ids = th.eye(self.n_agents, device=obs.device).expand(*obs.shape[:2], -1, -1)
            rows = th.cat([rows, ids], dim=-1)
        # Time last but one, as a GRU takes it: [B, n, T, ...]
        rows = rows.transpose(1, 2)
        parts = [(rows, hidden)] if self.share else zip(rows.split(1, dim=1), hidden.split(1, dim=1), strict=True)
        passed = [net(part, state) for net, (part, state) in zip(self.nets, parts, strict=True)]
        q, features, after = (th.cat(each, dim=1) for each in zip(*passed, strict=True))
        return q.transpose(1, 2), features.transpose(1, 2), after


class _Net(nn.Module):
    """One network, which all agents may be rows of."""

    def __init__(self, width: int, hidden_dim: int, n_outputs: int, recurrent: bool):
        super().__init__()
        self.first = nn.Linear(width, hidden_dim)
        self.second: nn.Module = (
            nn.GRU(hidden_dim, hidden_dim, batch_first=True) if recurrent else nn.Linear(hidden_dim, hidden_dim)
        )
        self.last = nn.Linear(hidden_dim, n_outputs)

    def forward(self, rows: th.Tensor, hidden: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Pass rows ``[B, n, T, width]`` with hidden states ``[B, n, h]``."""
        features = self.first(rows).relu()
        if isinstance(self.second, nn.GRU):
            outputs, after = self.second(features.flatten(0, 1), hidden.flatten(0, 1).unsqueeze(0).contiguous())
            features, hidden = outputs.reshape(features.shape), after.reshape(hidden.shape)
        else:
            features = self.second(features).relu()
        return self.last(features), features, hidden
