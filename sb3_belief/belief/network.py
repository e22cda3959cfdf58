"""
The dynamic belief network of *Dynamic Belief for Decentralized Multi-Agent Cooperative Learning* (IJCAI 2023), Sec. 4.1.

Two modules: the historical context attends over those past steps of the agent that resemble the present one (eq. 3, 4),
the latent variational inference turns the result into a distribution of beliefs, from which the others' actions are
predicted (eq. 5 to 7).
"""

import math
from typing import NamedTuple

import torch as th
import torch.nn.functional as F
from torch import nn

from sb3_belief.belief.history import History

# The deviation of the belief stays between 0.7 % and 7.4 times that of the prior: beyond that its log-likelihood and
# the sampled latent are numerically useless
LOG_STD_RANGE = (-5.0, 2.0)


class BeliefOutput(NamedTuple):
    """
    :param latent: The belief ``delta`` given to policy and value, ``[B, z]`` (eq. 5)
    :param mean: Mean of its distribution, ``[B, z]``
    :param log_std: Log standard deviation of its distribution, ``[B, z]``
    :param prediction: The others' predicted actions, flattened, ``[B, W]``
    :param kept: The history rows attended to, as indices into the rows filled so far, long ``[B, N_h]``;
        ``N_h`` is 0 while the history is empty
    :param weights: Their attention weights, ``[B, N_h]``, each row sums to one
    """

    latent: th.Tensor
    mean: th.Tensor
    log_std: th.Tensor
    prediction: th.Tensor
    kept: th.Tensor
    weights: th.Tensor


class HistoryContext(NamedTuple):
    """
    A history as the network sees it; constant as long as neither the history nor the weights change.

    :param directions: Embedded observations, scaled to length one for the cosine similarity, ``[T, d]``
    :param keys: ``[T, d]``
    :param values: ``[T, d]``
    """

    directions: th.Tensor
    keys: th.Tensor
    values: th.Tensor


def n_kept(keep_ratio: float, n_rows: int) -> int:
    """
    :param keep_ratio: ``p``, in (0, 1]
    :param n_rows: Number of filled history rows, at least 0
    :return: How many of them are attended to, ``N_h`` of eq. 3: a share of ``keep_ratio``, at least one
    """
    return min(n_rows, max(1, round(keep_ratio * n_rows)))


class DynamicBelief(nn.Module):
    """
    What the agent believes the others will do now, inferred from its observation and its history.

    :param observation_dim: ``d_o``, width of the flattened observation
    :param action_dim: ``W``, width of the others' flattened actions
    :param embedding_dim: ``d``, width of embeddings, queries, keys and values
    :param latent_dim: ``z``, width of the belief
    :param keep_ratio: ``p``, the share of the history that is attended to, in (0, 1]
    """

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        embedding_dim: int = 64,
        latent_dim: int = 64,
        keep_ratio: float = 0.05,
    ) -> None:
        super().__init__()
        self.observation_dim = observation_dim
        self.action_dim = action_dim
        self.embedding_dim = embedding_dim
        self.latent_dim = latent_dim
        self.keep_ratio = keep_ratio
        self.observation_embedding = nn.Sequential(
            nn.Linear(observation_dim, embedding_dim), nn.ReLU(), nn.Linear(embedding_dim, embedding_dim)
        )
        self.action_embedding = nn.Linear(action_dim, embedding_dim)
        self.query = nn.Linear(embedding_dim, embedding_dim, bias=False)
        self.key = nn.Linear(embedding_dim, embedding_dim, bias=False)
        self.value = nn.Linear(embedding_dim, embedding_dim, bias=False)
        self.encoder = nn.Linear(embedding_dim, 2 * latent_dim)
        self.decoder = nn.Linear(latent_dim, action_dim)

    def encode_history(self, history: History) -> HistoryContext:
        """
        :param history: The agent's history
        :return: Its filled rows as directions, keys and values
        """
        rows = history.filled()
        embeddings = self.observation_embedding(rows.observations)
        states = embeddings + self.action_embedding(rows.actions)
        return HistoryContext(F.normalize(embeddings.detach(), dim=1), self.key(states), self.value(states))

    def forward(
        self,
        observations: th.Tensor,
        history: History,
        noise: th.Tensor | None = None,
        kept: th.Tensor | None = None,
        context: HistoryContext | None = None,
    ) -> BeliefOutput:
        """
        :param observations: ``[B, d_o]``
        :param history: The agent's history
        :param noise: Standard normal noise ``[B, z]`` for eq. 5; without it the belief is its mean
        :param kept: The rows to attend to, ``[B, N_h]``, if they have been selected before; by default those most
            similar to each observation are selected here (eq. 3)
        :param context: ``encode_history(history)``, if it is at hand
        :return: The belief and all that belongs to it
        """
        if context is None:
            context = self.encode_history(history)
        embedding = self.observation_embedding(observations)
        if kept is None:
            kept = self._most_similar(embedding, context)
        summary, weights = self._attend(embedding, context, kept)
        mean, log_std = self.encoder(embedding + summary).chunk(2, dim=1)
        log_std = log_std.clamp(*LOG_STD_RANGE)
        latent = mean if noise is None else mean + log_std.exp() * noise
        return BeliefOutput(latent, mean, log_std, self.decoder(latent), kept, weights)

    @th.no_grad()
    def _most_similar(self, embedding: th.Tensor, context: HistoryContext) -> th.Tensor:
        """
        Eq. 3, with the sign that its text asks for: printed, the equation keeps the *least* similar rows. The choice
        is discrete, so no gradient flows through it.
        """
        similarity = F.normalize(embedding, dim=1) @ context.directions.T
        return similarity.topk(n_kept(self.keep_ratio, similarity.shape[1]), dim=1, sorted=False).indices

    def _attend(self, embedding: th.Tensor, context: HistoryContext, kept: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        Eq. 4 less its first term: the weighted sum of the kept rows' values, zero while the history is empty. The paper
        names no softmax; "scaled" is read as in the transformer, by the root of the width.
        """
        if kept.shape[1] == 0:
            return th.zeros_like(embedding), embedding.new_zeros(kept.shape)
        scores = self.query(embedding) @ context.keys.T / math.sqrt(self.embedding_dim)
        weights = scores.gather(1, kept).softmax(dim=1)
        # Spreading the weights over all rows and multiplying is faster than gathering a value for each of them
        spread = th.zeros_like(scores).scatter(1, kept, weights)
        return spread @ context.values, weights
