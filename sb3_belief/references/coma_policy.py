"""Actors and critic of COMA, and its counterfactual baseline."""

from copy import deepcopy
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.type_aliases import Schedule
from torch import nn


class JointDistribution:
    """
    The agents' distributions over their legal actions in ``B`` joint observations, one independent of the other.

    :param logits: ``[B, n, U]``
    :param mask: Legal actions, bool ``[B, n, U]``
    """

    def __init__(self, logits: th.Tensor, mask: th.Tensor):
        self.mask = mask
        self.log_probs = logits.masked_fill(~mask, -th.inf).log_softmax(dim=-1)
        #: Probabilities ``[B, n, U]``
        self.probs = self.log_probs.exp()

    def sample(self, deterministic: bool = False) -> th.Tensor:
        """
        Draw an action of each agent.

        :param deterministic: Whether to take the most likely ones, of the lowest index where several are
        :return: int64 ``[B, n]``
        """
        if deterministic:
            return self.log_probs.argmax(dim=-1)
        return self.probs.flatten(0, -2).multinomial(1).reshape(self.probs.shape[:-1])

    def log_prob(self, actions: th.Tensor) -> th.Tensor:
        """
        Return each agent's log probability of its own action.

        :param actions: int64 ``[B, n]``
        :return: ``[B, n]``
        """
        return taken(self.log_probs, actions)

    def entropy(self) -> th.Tensor:
        """Return each agent's entropy, ``[B, n]``."""
        return -(self.probs * self.log_probs.masked_fill(~self.mask, 0.0)).sum(dim=-1)


def taken(values: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """
    Return what belongs to chosen actions.

    :param values: ``[..., n, U]``
    :param actions: int64 ``[..., n]``
    :return: ``[..., n]``
    """
    return values.gather(-1, actions.unsqueeze(-1)).squeeze(-1)


def counterfactual_advantages(q: th.Tensor, probs: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """
    Return how much better an agent's action was than its policy is on average while the others do what they did.

    ``A_i = Q_i(u_i) - sum_u pi_i(u) Q_i(u)``, without a gradient (Foerster et al. 2018, eq. 4).

    :param q: The critic's ``Q_i(s, o_i, u_-i, .)``, ``[B, n, U]``
    :param probs: Each agent's policy ``[B, n, U]``
    :param actions: Actions taken, int64 ``[B, n]``
    :return: ``[B, n]``
    """
    return (taken(q, actions) - (probs * q).sum(dim=-1)).detach()


def coma_actor_loss(
    distribution: JointDistribution, actions: th.Tensor, advantages: th.Tensor, in_play: th.Tensor, ent_coef: float
) -> th.Tensor:
    """
    Return the actors' loss ``-sum a_i (A_i log pi_i(u_i) + c H_i) / sum a_i``.

    :param distribution: The agents' policies
    :param actions: Actions taken, int64 ``[B, n]``
    :param advantages: ``A_i``, ``[B, n]``
    :param in_play: ``a_i``, 1 for an agent that was in play, otherwise 0, ``[B, n]``
    :param ent_coef: ``c``, weight of the entropy
    :return: A number
    """
    gains = advantages * distribution.log_prob(actions) + ent_coef * distribution.entropy()
    # Nobody in play at all leaves nothing to learn
    return -(in_play * gains).sum() / in_play.sum().clamp(min=1)


class ComaPolicy(BasePolicy):
    """
    Policy of :class:`~sb3_belief.references.coma.COMA`: actors that see an agent's own observation, a critic that sees all.

    All agents share the weights of one actor and of one critic and are told apart by a one-hot id. The critic is
    ``Q(s, o_i, u_-i, i) -> [U]``.

    :param observation_space: That of a ``JointVecEnv``
    :param action_space: That of a ``JointVecEnv``, MultiDiscrete
    :param lr_schedule: Learning rate by the progress remaining
    :param use_sde: As SB3 gives it; False
    :param net_arch: Widths of the actor's hidden layers
    :param critic_arch: Widths of the critic's hidden layers
    :param optimizer_class: Class of both optimizers
    :param optimizer_kwargs: Their arguments, without the learning rate; by default those of PyMARL for RMSprop
    """

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.MultiDiscrete,
        lr_schedule: Schedule,
        use_sde: bool = False,
        net_arch: list[int] | None = None,
        critic_arch: list[int] | None = None,
        optimizer_class: type[th.optim.Optimizer] = th.optim.RMSprop,
        optimizer_kwargs: dict[str, Any] | None = None,
    ):
        if optimizer_kwargs is None:
            optimizer_kwargs = {"alpha": 0.99, "eps": 1e-5} if optimizer_class is th.optim.RMSprop else {}
        super().__init__(observation_space, action_space, optimizer_class=optimizer_class, optimizer_kwargs=optimizer_kwargs)
        self.net_arch = [64, 64] if net_arch is None else net_arch
        self.critic_arch = [128, 128] if critic_arch is None else critic_arch
        sizes: Any = {key: space.shape for key, space in observation_space.spaces.items()}
        (self.n_agents, self.n_actions), (_, obs_dim), (state_dim,) = sizes["mask"], sizes["obs"], sizes["state"]
        seen = obs_dim + self.n_agents
        self.actor = nn.Sequential(*create_mlp(seen, self.n_actions, self.net_arch))
        others = (self.n_agents - 1) * self.n_actions
        self.critic = nn.Sequential(*create_mlp(state_dim + seen + others, self.n_actions, self.critic_arch))
        self.critic_target = deepcopy(self.critic).requires_grad_(False)
        self.optimizer: th.optim.Optimizer = self._make_optimizer(self.actor, lr_schedule)
        self.critic_optimizer: th.optim.Optimizer = self._make_optimizer(self.critic, lr_schedule)

    def _make_optimizer(self, network: nn.Module, lr_schedule: Schedule) -> th.optim.Optimizer:
        return self.optimizer_class(network.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)  # type: ignore[call-arg]

    def distribution(self, obs: dict[str, th.Tensor]) -> JointDistribution:
        """
        Return the agents' policies.

        :param obs: Joint observations, ``[B, ...]`` by key
        """
        return JointDistribution(self.actor(self._seen(obs)), obs["mask"].bool())

    def critic_values(self, critic: nn.Module, obs: dict[str, th.Tensor], actions: th.Tensor) -> th.Tensor:
        """
        Return ``Q_i`` of each of agent i's actions while the others do what they do.

        :param critic: The critic, or its target
        :param obs: Joint observations, ``[B, ...]`` by key
        :param actions: Joint actions, int64 ``[B, n]``, of which agent i's own does not count for ``Q_i``
        :return: ``[B, n, U]``
        """
        chosen = nn.functional.one_hot(actions, self.n_actions).float()
        others = th.stack([th.cat([chosen[:, :i], chosen[:, i + 1 :]], dim=1).flatten(1) for i in range(self.n_agents)], dim=1)
        state = obs["state"].float().unsqueeze(1).expand(-1, self.n_agents, -1)
        return critic(th.cat([state, self._seen(obs), others], dim=-1))

    def _seen(self, obs: dict[str, th.Tensor]) -> th.Tensor:
        ids = th.eye(self.n_agents, device=self.device).expand(len(obs["obs"]), -1, -1)
        return th.cat([obs["obs"].float(), ids], dim=-1)

    def _joint_value(self, obs: dict[str, th.Tensor], actions: th.Tensor) -> th.Tensor:
        """Return the mean over agents of the target critic's value of the joint action, ``[B]``."""
        return taken(self.critic_values(self.critic_target, obs, actions), actions).mean(dim=-1)

    def forward(self, obs: dict[str, th.Tensor], deterministic: bool = False) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """
        Act in training.

        :param obs: Joint observations, ``[B, ...]`` by key
        :param deterministic: Whether to take the most likely actions
        :return: Actions ``[B, n]``, the target critic's value of them, from which SB3's generalised advantages make TD(lambda)
            returns, and their joint log probability, both ``[B]``
        """
        distribution = self.distribution(obs)
        actions = distribution.sample(deterministic)
        return actions, self._joint_value(obs, actions), distribution.log_prob(actions).sum(dim=-1)

    def predict_values(self, obs: dict[str, th.Tensor]) -> th.Tensor:
        """
        Return the target critic's value of actions that are drawn and not taken: where a rollout or a limit cuts off a return.

        :param obs: Joint observations, ``[B, ...]`` by key
        :return: ``[B, 1]``
        """
        return self._joint_value(obs, self.distribution(obs).sample()).unsqueeze(-1)

    def _predict(self, observation: Any, deterministic: bool = False) -> th.Tensor:
        return self.distribution(observation).sample(deterministic)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            "observation_space": self.observation_space,
            "action_space": self.action_space,
            # Not needed to load a policy alone
            "lr_schedule": self._dummy_schedule,
            "net_arch": self.net_arch,
            "critic_arch": self.critic_arch,
            "optimizer_class": self.optimizer_class,
            "optimizer_kwargs": self.optimizer_kwargs,
        }
