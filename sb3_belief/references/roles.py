"""Roles of RODE: embeddings of actions by what they do, and groups of actions that do alike."""

import numpy as np
import torch as th
from torch import nn


class ActionEffects(nn.Module):
    """
    Predicts from an agent's observation, the others' actions and the embedding of its own action what it observes next and
    what the team is paid. So actions of like effects get like embeddings (Wang et al. 2021, "RODE").

    :param n_agents: Number of agents ``n``
    :param obs_dim: Width ``d`` of an observation
    :param n_actions: Number of actions ``U``
    :param embedding_dim: Width ``z`` of an embedding
    :param hidden_dim: Hidden width of all networks
    """

    def __init__(self, n_agents: int, obs_dim: int, n_actions: int, embedding_dim: int = 20, hidden_dim: int = 128):
        super().__init__()
        self.n_actions = n_actions
        self.encoder = nn.Sequential(nn.Linear(n_actions, hidden_dim), nn.ReLU(), nn.Linear(hidden_dim, embedding_dim))
        self.context = nn.Sequential(nn.Linear(obs_dim + (n_agents - 1) * n_actions, 32), nn.ReLU())
        self.next_obs, self.reward = (
            nn.Sequential(nn.Linear(32 + embedding_dim, hidden_dim), nn.ReLU(), nn.Linear(hidden_dim, width))
            for width in (obs_dim, 1)
        )

    def embeddings(self) -> th.Tensor:
        """Return the embedding of each action, ``[U, z]``."""
        return self.encoder(th.eye(self.n_actions, device=next(self.parameters()).device))

    def loss(self, obs: th.Tensor, actions: th.Tensor, next_obs: th.Tensor, rewards: th.Tensor) -> th.Tensor:
        """
        Return the mean over steps and agents of ``||error of the observation|| + 10 (error of the reward)²``.

        :param obs: ``[B, n, d]``
        :param actions: int64 ``[B, n]``
        :param next_obs: ``[B, n, d]``
        :param rewards: ``[B]``
        :return: A number
        """
        n = actions.shape[1]
        chosen = nn.functional.one_hot(actions, self.n_actions).float()
        others = th.stack([th.cat([chosen[:, :i], chosen[:, i + 1 :]], dim=1).flatten(1) for i in range(n)], dim=1)
        known = th.cat([self.context(th.cat([obs, others], dim=-1)), self.encoder(chosen)], dim=-1)
        next_error = (self.next_obs(known) - next_obs).norm(dim=-1)
        reward_error = self.reward(known).squeeze(-1) - rewards.unsqueeze(-1)
        return (next_error + 10 * reward_error**2).mean()


def group_actions(embeddings: np.ndarray, n_roles: int, rng: np.random.Generator) -> np.ndarray:
    """
    Group actions into roles by k-means, the best of ten from starts that are drawn far apart.

    A role of one action takes in that action's nearest neighbour, which is then in two roles.

    :param embeddings: ``[U, z]``
    :param n_roles: Number of roles ``k``, from 1 to ``U``
    :param rng: Draws the starts
    :return: Whether an action belongs to a role, bool ``[k, U]``; roles in the order of their first actions
    """
    best: tuple[float, np.ndarray] | None = None
    for _ in range(10):
        error, nearest = _k_means(embeddings, n_roles, rng)
        if best is None or error < best[0]:
            best = error, nearest
    assert best is not None
    roles = best[1] == np.arange(n_roles)[:, None]
    roles = roles[np.argsort(roles.argmax(axis=1))]
    distances = np.linalg.norm(embeddings[:, None] - embeddings, axis=-1)
    np.fill_diagonal(distances, np.inf)
    for role in roles:
        if role.sum() == 1 and len(role) > 1:
            role[distances[role.argmax()].argmin()] = True
    return roles


def _k_means(points: np.ndarray, k: int, rng: np.random.Generator) -> tuple[float, np.ndarray]:
    """Return the sum of squared distances, and the centre of each point, no centre being without one."""
    chosen = [int(rng.integers(len(points)))]
    while len(chosen) < k:
        squares = ((points[:, None] - points[chosen]) ** 2).sum(axis=-1).min(axis=1)
        squares[chosen] = 0
        # Where the others lie on chosen points, any of them will do
        free = np.setdiff1d(np.arange(len(points)), chosen)
        chosen.append(int(rng.choice(len(points), p=squares / squares.sum()) if squares.any() else free[0]))
    centres, nearest = points[chosen], np.full(len(points), -1)
    for _ in range(100):
        squares = ((points[:, None] - centres) ** 2).sum(axis=-1)
        now = squares.argmin(axis=1)
        for role in np.setdiff1d(np.arange(k), now):
            # A centre that has lost its points takes the one that lies worst, from a centre that has others
            counts = np.bincount(now, minlength=k)
            worst = np.where(counts[now] > 1, squares[np.arange(len(points)), now], -1.0).argmax()
            now[worst] = role
        if (now == nearest).all():
            break
        nearest = now
        centres = np.stack([points[nearest == role].mean(axis=0) for role in range(k)])
    return float(((points - centres[nearest]) ** 2).sum()), nearest
