"""
Mixers: how the values of the agents' own actions make the value of the joint one.

Each is ``forward(q_taken, q_max, u_onehot, state) -> [B, 1]``.
"""

from collections.abc import Callable
from functools import partial
from itertools import pairwise

import torch as th
from torch import nn

from sb3_belief.common.checks import check_integer
from sb3_belief.references.agent_net import AgentValues

# Keeps what must be positive away from zero, as in the code of QPLEX's authors
_TINY = 1e-10


class Mixer(nn.Module):
    """
    Base class of mixers; a new one implements ``forward``.

    :param n_agents: Number of agents ``n``
    :param n_actions: Number of actions ``U`` of an agent
    :param state_dim: Width ``d_s`` of the global state
    """

    def __init__(self, n_agents: int, n_actions: int, state_dim: int):
        super().__init__()
        self.n_agents, self.n_actions, self.state_dim = n_agents, n_actions, state_dim

    def forward(self, q_taken: th.Tensor, q_max: th.Tensor, u_onehot: th.Tensor, state: th.Tensor) -> th.Tensor:
        """
        Return the value of the joint action.

        :param q_taken: ``Q_i(u_i)``, ``[B, n]``
        :param q_max: ``max Q_i`` over the legal actions, ``[B, n]``
        :param u_onehot: The actions, one-hot ``[B, n, U]``
        :param state: The global state ``[B, d_s]``
        :return: ``Q_tot``, ``[B, 1]``
        """
        raise NotImplementedError

    def joint_value(self, values: AgentValues, actions: th.Tensor) -> th.Tensor:
        """
        Return the value of joint actions.

        :param values: The agents' values
        :param actions: int64 ``[B, n]``
        :return: ``[B, 1]``
        """
        return self(values.of(actions), values.q.max(dim=-1).values, values.one_hot(actions), values.state)

    def consistency_loss(self, values: AgentValues, actions: th.Tensor, joint: th.Tensor) -> th.Tensor | None:
        """
        Return what ties the agents' values to the joint ones, beside the loss of these, for a factorisation by its loss.

        :param values: The agents' values
        :param actions: The actions taken, int64 ``[B, n]``
        :param joint: Their ``joint_value``
        :return: ``[B, 1]``; None for a mixer, whose agents are trained through it
        """
        return None


class VDN(Mixer):
    """Value decomposition network (Sunehag et al. 2018): the sum of the agents' values."""

    def forward(self, q_taken: th.Tensor, q_max: th.Tensor, u_onehot: th.Tensor, state: th.Tensor) -> th.Tensor:
        return q_taken.sum(dim=-1, keepdim=True)


class QMIX(Mixer):
    """
    QMIX (Rashid et al. 2018): ``elu(Q |W1(s)| + b1(s)) |w2(s)| + b2(s)``, monotone in each agent's value.

    :param n_agents: Number of agents
    :param n_actions: Number of actions of an agent
    :param state_dim: Width of the global state
    :param embedding_dim: Width of the mixing layer, at least 1
    :param hypernet_dim: Hidden width of the networks that make ``W1`` and ``w2`` of the state; None for a single layer each
    """

    def __init__(self, n_agents: int, n_actions: int, state_dim: int, embedding_dim: int = 32, hypernet_dim: int | None = 64):
        super().__init__(n_agents, n_actions, state_dim)
        check_integer("embedding_dim", embedding_dim, 1, "the width of the mixing layer")
        self.embedding_dim = embedding_dim
        self.w1 = _hypernet(state_dim, n_agents * embedding_dim, hypernet_dim)
        self.b1 = nn.Linear(state_dim, embedding_dim)
        self.w2 = _hypernet(state_dim, embedding_dim, hypernet_dim)
        self.b2 = _hypernet(state_dim, 1, embedding_dim)

    def forward(self, q_taken: th.Tensor, q_max: th.Tensor, u_onehot: th.Tensor, state: th.Tensor) -> th.Tensor:
        w1 = self.w1(state).abs().view(-1, self.n_agents, self.embedding_dim)
        w2 = self.w2(state).abs()
        hidden = nn.functional.elu(th.einsum("bn,bne->be", q_taken, w1) + self.b1(state))
        return (hidden * w2).sum(dim=-1, keepdim=True) + self.b2(state)


class QPLEX(Mixer):
    """
    QPLEX (Wang et al. 2021): dueling mixing, which can represent any joint value whose greedy action is the agents' own.

    ``w_i = |H_w(s)_i| + 1e-10``, ``b_i = H_b(s)_i``, ``Q'_i = w_i Q_i + b_i``, ``A'_i = sg(w_i (Q_i(u_i) - max Q_i))``,
    ``Q_tot = sum_i Q'_i(u_i) + sum_i (lambda_i - 1) A'_i`` with
    ``lambda_i = sum_k (|key_k(s)| + 1e-10) sigmoid(agent_ki(s)) sigmoid(action_ki(s, u))``.

    :param n_agents: Number of agents
    :param n_actions: Number of actions of an agent
    :param state_dim: Width of the global state
    :param n_kernels: Number of kernels ``k``, at least 1
    :param n_layers: Layers of each of a kernel's three networks, at least 1
    :param hypernet_dim: Hidden width of all networks of the state
    """

    def __init__(
        self,
        n_agents: int,
        n_actions: int,
        state_dim: int,
        n_kernels: int = 4,
        n_layers: int = 1,
        hypernet_dim: int = 64,
    ):
        super().__init__(n_agents, n_actions, state_dim)
        self.w = _hypernet(state_dim, n_agents, hypernet_dim)
        self.b = _hypernet(state_dim, n_agents, hypernet_dim)
        joint_dim = state_dim + n_agents * n_actions
        self.keys = _layers(state_dim, 1, hypernet_dim, n_layers, partial(ParallelLinear, n_kernels))
        self.agents = _layers(state_dim, n_agents, hypernet_dim, n_layers, partial(ParallelLinear, n_kernels))
        self.actions = _layers(joint_dim, n_agents, hypernet_dim, n_layers, partial(ParallelLinear, n_kernels))

    def forward(self, q_taken: th.Tensor, q_max: th.Tensor, u_onehot: th.Tensor, state: th.Tensor) -> th.Tensor:
        w = self.w(state).abs() + _TINY
        advantage = (w * (q_taken - q_max)).detach()
        values = w * q_taken + self.b(state)
        return (values + (self.importance(u_onehot, state) - 1) * advantage).sum(dim=-1, keepdim=True)

    def importance(self, u_onehot: th.Tensor, state: th.Tensor) -> th.Tensor:
        """
        Return ``lambda``, the positive weights of the advantages.

        :param u_onehot: The actions, one-hot ``[B, n, U]``
        :param state: The global state ``[B, d_s]``
        :return: ``[B, n]``
        """
        joint = th.cat([state, u_onehot.flatten(1)], dim=-1)
        keys, agents, actions = self.keys(state).abs() + _TINY, self.agents(state).sigmoid(), self.actions(joint).sigmoid()
        return (keys * agents * actions).sum(dim=0)


class ParallelLinear(nn.Module):
    """
    Several linear layers of one shape, side by side: a single product instead of one for each.

    :param n_layers: Number of layers ``k``
    :param n_in: Width of their inputs
    :param n_out: Width of their outputs
    """

    def __init__(self, n_layers: int, n_in: int, n_out: int):
        super().__init__()
        layers = [nn.Linear(n_in, n_out) for _ in range(n_layers)]
        self.weight = nn.Parameter(th.stack([layer.weight.detach().T for layer in layers]))
        self.bias = nn.Parameter(th.stack([layer.bias.detach() for layer in layers])[:, None])

    def forward(self, rows: th.Tensor) -> th.Tensor:
        """
        Pass rows.

        :param rows: ``[B, n_in]`` for all layers, or ``[k, B, n_in]``
        :return: ``[k, B, n_out]``
        """
        return rows @ self.weight + self.bias


def _layers(
    n_in: int, n_out: int, hidden_dim: int, n_layers: int, make: Callable[[int, int], nn.Module] = nn.Linear
) -> nn.Sequential:
    """Return ``n_layers`` linear layers with ReLU between them."""
    widths = [n_in, *[hidden_dim] * (n_layers - 1)]
    modules: list[nn.Module] = []
    for before, after in pairwise(widths):
        modules += [make(before, after), nn.ReLU()]
    return nn.Sequential(*modules, make(widths[-1], n_out))


def _hypernet(state_dim: int, n_out: int, hidden_dim: int | None) -> nn.Sequential:
    return _layers(state_dim, n_out, hidden_dim or 0, 1 if hidden_dim is None else 2)
