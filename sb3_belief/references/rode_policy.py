"""Networks of RODE: who takes which role for some steps, and which of the role's actions at each."""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import Schedule
from torch import nn

from sb3_belief.common.checks import check_integer
from sb3_belief.references.agent_net import AgentNet, AgentValues
from sb3_belief.references.episodes import EpisodeBatch
from sb3_belief.references.factorised_policy import FactorisedPolicy, explore
from sb3_belief.references.mixers import QMIX, ParallelLinear
from sb3_belief.references.roles import ActionEffects, group_actions


class RodeValue(nn.Module):
    """
    Values of roles, ``<g(h_i), z_rho>``, and of actions in a role, ``<W_rho h_i, z_a>``, and the mixers of both.

    :param agents: The agents' networks, whose last layer is ``g``
    :param n_roles: Number of roles ``k``
    :param embedding_dim: Width ``z`` of an embedding
    :param state_dim: Width of the global state
    """

    def __init__(self, agents: AgentNet, n_roles: int, embedding_dim: int, state_dim: int):
        super().__init__()
        self.agents = agents
        self.roles = ParallelLinear(n_roles, agents.hidden_dim, embedding_dim)
        self.role_mixer = QMIX(agents.n_agents, n_roles, state_dim)
        self.action_mixer = QMIX(agents.n_agents, agents.n_actions, state_dim)

    def action_values(self, features: th.Tensor, roles: th.Tensor, embeddings: th.Tensor) -> th.Tensor:
        """
        Return the values of all actions in given roles.

        :param features: ``h``, ``[..., h]``
        :param roles: int64 ``[...]``
        :param embeddings: ``z_a``, ``[U, z]``
        :return: ``[..., U]``
        """
        # Of all roles, since most products of these sizes take the same time
        queries = self.roles(features.reshape(-1, features.shape[-1]))
        chosen = queries[roles.flatten(), th.arange(queries.shape[1], device=queries.device)]
        return (chosen @ embeddings.T).reshape(*roles.shape, -1)


class RodePolicy(FactorisedPolicy):
    """
    Policy of :class:`~sb3_belief.references.rode.RODE`.

    Until :meth:`make_roles` all actions belong to all roles.

    :param observation_space: That of a ``JointVecEnv``
    :param action_space: That of a ``JointVecEnv``, MultiDiscrete
    :param lr_schedule: Learning rate by the progress remaining
    :param n_roles: Number of roles ``k``, from 1 to the number of actions
    :param role_interval: Steps for which a role is kept, at least 1
    :param embedding_dim: Width of an embedding
    :param hidden_dim: Width of the agents' networks
    :param recurrent: Whether the agents' networks remember the episode (GRU)
    :param optimizer_class: Class of both optimizers
    :param optimizer_kwargs: Their arguments, without the learning rate
    :raises ValueError: For more roles than actions
    """

    #: Embeddings of actions ``[U, z]`` and of roles ``[k, z]``, which actions a role has, bool ``[k, U]``, if there are any
    action_embeddings: th.Tensor
    role_embeddings: th.Tensor
    role_actions: th.Tensor
    has_roles: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.MultiDiscrete,
        lr_schedule: Schedule,
        n_roles: int = 5,
        role_interval: int = 5,
        embedding_dim: int = 20,
        hidden_dim: int = 64,
        recurrent: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
    ):
        n_actions = observation_space["mask"].shape[1]  # type: ignore[index]
        if not 1 <= n_roles <= n_actions:
            raise ValueError(f"n_roles={n_roles!r} must be from 1 to {n_actions}, the number of actions, which are grouped.")
        check_integer("role_interval", role_interval, 1, "the steps for which a role is kept")
        check_integer("embedding_dim", embedding_dim, 1, "the width of an embedding")
        self.n_roles, self.role_interval, self.embedding_dim = n_roles, role_interval, embedding_dim
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            hidden_dim=hidden_dim,
            recurrent=recurrent,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
        )
        self.effects = ActionEffects(self.n_agents, self.obs_dim, self.n_actions, embedding_dim)
        arguments: Any = {"lr": lr_schedule(1), **self.optimizer_kwargs}
        self.effects_optimizer = self.optimizer_class(self.effects.parameters(), **arguments)
        self.register_buffer("action_embeddings", th.zeros(self.n_actions, embedding_dim))
        self.register_buffer("role_embeddings", th.zeros(n_roles, embedding_dim))
        self.register_buffer("role_actions", th.ones(n_roles, self.n_actions, dtype=th.bool))
        self.register_buffer("has_roles", th.zeros((), dtype=th.bool))

    def _make_net(self) -> nn.Module:
        hidden_dim, recurrent = self.arguments["hidden_dim"], self.arguments["recurrent"]
        agents = AgentNet(self.n_agents, self.obs_dim, self.n_actions, hidden_dim, recurrent, n_outputs=self.embedding_dim)
        return RodeValue(agents, self.n_roles, self.embedding_dim, self.state_dim)

    @th.no_grad()
    def make_roles(self, rng: np.random.Generator) -> None:
        """
        Group the actions by their embeddings as they are now, and keep both from now on.

        :param rng: Draws the starts of the k-means
        """
        embeddings = self.effects.embeddings()
        self.action_embeddings.copy_(embeddings)
        roles = group_actions(embeddings.cpu().numpy().astype(np.float64), self.n_roles, rng)
        self.role_actions.copy_(th.as_tensor(roles))
        weights = self.role_actions.float()
        self.role_embeddings.copy_(weights @ embeddings / weights.sum(dim=1, keepdim=True))
        self.has_roles.fill_(True)

    def legal_in(self, mask: th.Tensor, roles: th.Tensor) -> th.Tensor:
        """
        Return the legal actions of roles; all legal ones where a role has none.

        :param mask: bool ``[..., U]``
        :param roles: int64 ``[...]``
        :return: bool ``[..., U]``
        """
        both = mask & self.role_actions[roles]
        return th.where(both.any(dim=-1, keepdim=True), both, mask)

    def pass_episodes(self, net: Any, batch: EpisodeBatch) -> tuple[th.Tensor, th.Tensor]:
        """
        Return what the agents' networks say in episodes.

        :param net: The networks, or their target
        :param batch: Episodes of ``T`` steps, with actions and roles as their actions ``[B, T, n, 2]``
        :return: Values of roles ``[B, T + 1, n, k]`` and features ``[B, T + 1, n, h]``
        """
        taken = nn.functional.one_hot(batch.actions[..., 0], self.n_actions).float()
        last_actions = th.cat([th.zeros_like(taken[:, :1]), taken], dim=1)
        queries, features, _ = net.agents(batch.obs, last_actions, net.agents.initial_hidden(len(batch.obs)))
        return queries @ self.role_embeddings.T, features

    def values_in(self, net: Any, features: th.Tensor, roles: th.Tensor, mask: th.Tensor, state: th.Tensor) -> AgentValues:
        """
        Return the values of actions in roles, for the action mixer.

        :param net: The networks, or their target
        :param features: ``[B, n, h]``
        :param roles: int64 ``[B, n]``
        :param mask: Legal actions, bool ``[B, n, U]``
        :param state: ``[B, d_s]``
        """
        q = net.action_values(features, roles, self.action_embeddings)
        return AgentValues(q.masked_fill(~self.legal_in(mask, roles), -th.inf), features, state)

    def act(
        self,
        observation: dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        epsilon: float = 0.0,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        """
        Choose a role for each agent where its time is up, and one of the role's legal actions, both by coins of their own.

        :param observation: Joint observations, ``[n_envs, ...]`` by key, or a single one
        :param state: As returned by the last call: hidden states, last actions, roles ``[n_envs, n]`` and steps ``[n_envs]``
        :param episode_start: Where the state starts anew, bool ``[n_envs]``
        :param epsilon: Probability of a random role, and of a random action, in [0, 1]
        :return: Actions int64 ``[n_envs, n]``, or ``[n]``, and the state for the next call
        """
        obs, is_batch = self.obs_to_tensor(observation)
        rows: Any = obs
        n_rows = len(rows["obs"])
        if state is None:
            state = (
                np.zeros((n_rows, self.n_agents, self.net.agents.hidden_dim), dtype=np.float32),
                np.zeros((n_rows, self.n_agents, self.n_actions), dtype=np.float32),
                np.zeros((n_rows, self.n_agents), dtype=np.int64),
                np.zeros(n_rows, dtype=np.int64),
            )
        elif episode_start is not None:
            goes_on = ~np.asarray(episode_start, dtype=bool)
            state = tuple(part * goes_on.reshape(-1, *[1] * (part.ndim - 1)) for part in state)
        hidden, last_actions, roles, steps = state
        with th.no_grad():
            queries, features, after = self.net.agents(
                rows["obs"][:, None],
                th.as_tensor(last_actions, device=self.device)[:, None],
                th.as_tensor(hidden, device=self.device),
            )
            role_values = queries[:, 0] @ self.role_embeddings.T
            best = explore(role_values.argmax(dim=-1).cpu().numpy(), np.ones(role_values.shape, dtype=bool), epsilon)
            roles = np.where((steps % self.role_interval == 0)[:, None], best, roles)
            own = th.as_tensor(roles, device=self.device)
            values = self.values_in(self.net, features[:, 0], own, rows["mask"].bool(), rows["state"].float())
        actions = explore(values.greedy().cpu().numpy(), values.q.isfinite().cpu().numpy(), epsilon)
        one_hot = np.eye(self.n_actions, dtype=np.float32)[actions]
        return actions if is_batch else actions[0], (after.cpu().numpy(), one_hot, roles, steps + 1)

    def _predict(self, observation: Any, deterministic: bool = False) -> th.Tensor:
        actions, _ = self.act({key: part.cpu().numpy() for key, part in observation.items()})
        return th.as_tensor(actions, device=self.device)

    def joint_values(self, *args: Any, **kwargs: Any) -> np.ndarray:
        """Refuse: there is no value of an action without a role."""
        raise NotImplementedError("RODE has no value of a joint action alone: it depends on the agents' roles.")

    def _get_constructor_parameters(self) -> dict[str, Any]:
        parameters = super()._get_constructor_parameters()
        for name in ("mixer", "mixer_kwargs", "share"):
            del parameters[name]
        own = dict(n_roles=self.n_roles, role_interval=self.role_interval, embedding_dim=self.embedding_dim)
        return {**parameters, **own}
