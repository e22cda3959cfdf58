"""QTRAN: a joint value that is free of structure, and a loss by which the agents' values agree with it on what is best."""

import torch as th
from torch import nn

from sb3_belief.references.agent_net import AgentValues


class QTRAN(nn.Module):
    """
    QTRAN-base (Son et al. 2019).

    ``Qjt(s, sum_i enc(h_i, u_i))`` is trained as the joint value, and the agents' values by
    ``opt_coef (sum Q_i(best_i) - sg Qjt(best) + V)² + nopt_coef min(0, sum Q_i(u_i) - sg Qjt(u) + V)²``.

    :param n_agents: Number of agents ``n``
    :param n_actions: Number of actions ``U`` of an agent
    :param state_dim: Width ``d_s`` of the global state
    :param features_dim: Width ``h`` of the agents' features
    :param embedding_dim: Hidden width of ``Qjt`` and ``V``
    :param opt_coef: Weight of the loss at the agents' best actions, at least 0
    :param nopt_coef: Weight of the loss at the actions taken, at least 0
    """

    def __init__(
        self,
        n_agents: int,
        n_actions: int,
        state_dim: int,
        features_dim: int,
        embedding_dim: int = 64,
        opt_coef: float = 1.0,
        nopt_coef: float = 1.0,
    ):
        super().__init__()
        self.opt_coef, self.nopt_coef = opt_coef, nopt_coef
        width = features_dim + n_actions
        self.encoder = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width))
        self.joint = _three_layers(state_dim + width, embedding_dim)
        self.value = _three_layers(state_dim, embedding_dim)

    def joint_value(self, values: AgentValues, actions: th.Tensor) -> th.Tensor:
        """
        Return ``Qjt`` of joint actions.

        :param values: The agents' values, of which only features and state count
        :param actions: int64 ``[B, n]``
        :return: ``[B, 1]``
        """
        encoded = self.encoder(th.cat([values.features, values.one_hot(actions)], dim=-1)).sum(dim=-2)
        return self.joint(th.cat([values.state, encoded], dim=-1))

    def consistency_loss(self, values: AgentValues, actions: th.Tensor, joint: th.Tensor) -> th.Tensor:
        """
        Return the loss that trains the agents' values.

        :param values: The agents' values
        :param actions: The actions taken, int64 ``[B, n]``
        :param joint: Their ``joint_value``
        :return: ``[B, 1]``
        """
        value = self.value(values.state)
        best = values.greedy()
        opt = values.of(best).sum(-1, keepdim=True) - self.joint_value(values, best).detach() + value
        nopt = values.of(actions).sum(-1, keepdim=True) - joint.detach() + value
        return self.opt_coef * opt**2 + self.nopt_coef * nopt.clamp(max=0) ** 2


def _three_layers(n_in: int, hidden_dim: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(n_in, hidden_dim), nn.ReLU(), nn.Linear(hidden_dim, hidden_dim), nn.ReLU(), nn.Linear(hidden_dim, 1)
    )
