"""
The dynamic belief network of *Dynamic Belief for Decentralized Multi-Agent Cooperative Learning* (IJCAI 2023), Sec. 4.1.

Two modules: the historical context attends over those past steps of the agent that resemble the present one (eq. 3, 4),
the latent variational inference turns the result into a distribution of beliefs, from which the others' actions are
predicted (eq. 5 to 7).
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch as th
import torch.nn.functional as F
from torch import nn

from sb3_belief.belief.attention import attend, largest
from sb3_belief.belief.history import History
from sb3_belief.belief.variants import VARIANTS

#: What history rows are compared by to find those that resemble the present (Fig. 5b)
SIMILARITIES = ("embedding", "observation")
# The deviation of the belief stays between 0.7 % and 7.4 times that of the prior: beyond that its log-likelihood and
# the sampled latent are numerically useless
LOG_STD_RANGE = (-5.0, 2.0)


class BeliefOutput(NamedTuple):
    """
    :param latent: The belief ``delta``, ``[B, z]`` (eq. 5)
    :param mean: Mean of its distribution, ``[B, z]``
    :param log_std: Log standard deviation of its distribution, ``[B, z]``; minus infinity where it is a single point
    :param prediction: The others' predicted actions, flattened, ``[B, W]``: numbers or logits, whatever the loss makes of
        them; None for a belief that predicts nothing
    :param kept: The history rows attended to, as indices into the rows filled so far, long ``[B, N_h]``;
        ``N_h`` is 0 while the history is empty, and for a belief without one
    :param weights: Their attention weights, ``[B, N_h]``, each row sums to one
    """

    latent: th.Tensor
    mean: th.Tensor
    log_std: th.Tensor
    prediction: th.Tensor | None
    kept: th.Tensor
    weights: th.Tensor


class HistoryContext(NamedTuple):
    """
    A history as the network sees it; constant as long as neither the history nor the weights change.

    :param directions: What rows are compared by, scaled to length one for the cosine similarity, ``[T, d]`` or ``[T, d_o]``;
        None where the rows to attend to have been selected before
    :param states: Embedded observations and actions, ``[T, d]``
    """

    directions: th.Tensor | None
    states: th.Tensor


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

    Every variant is this network less the parts that it does not use: those are not built, so that all weights there are
    take part.

    :param observation_dim: ``d_o``, width of the flattened observation
    :param action_dim: ``W``, width of the others' flattened actions
    :param embedding_dim: ``d``, width of embeddings, queries, keys and values
    :param latent_dim: ``z``, width of the belief
    :param keep_ratio: ``p``, the share of the history that is attended to, in (0, 1]
    :param variant: A key of :data:`~sb3_belief.belief.VARIANTS`
    :param similarity: What history rows are compared by: ``"embedding"`` (eq. 3) or the ``"observation"`` itself (Fig. 5b)
    """

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        embedding_dim: int = 64,
        latent_dim: int = 64,
        keep_ratio: float = 0.05,
        variant: str = "dynamic",
        similarity: str = "embedding",
    ) -> None:
        super().__init__()
        self.observation_dim = observation_dim
        self.action_dim = action_dim
        self.embedding_dim = embedding_dim
        self.latent_dim = latent_dim
        self.keep_ratio = keep_ratio
        self.variant = VARIANTS[variant]
        self.similarity = similarity
        self.observation_embedding = nn.Sequential(
            nn.Linear(observation_dim, embedding_dim), nn.ReLU(), nn.Linear(embedding_dim, embedding_dim)
        )
        if self.variant.attends:
            self.action_embedding = nn.Linear(action_dim, embedding_dim)
            self.query = nn.Linear(embedding_dim, embedding_dim, bias=False)
            self.key = nn.Linear(embedding_dim, embedding_dim, bias=False)
            self.value = nn.Linear(embedding_dim, embedding_dim, bias=False)
        self.encoder: nn.Module
        if self.variant.predicts:
            self.encoder = nn.Linear(embedding_dim, (2 if self.variant.samples else 1) * latent_dim)
            self.decoder = nn.Linear(latent_dim, action_dim)
        else:
            hidden = self._hidden_of_wide()
            self.encoder = nn.Sequential(nn.Linear(embedding_dim, hidden), nn.ReLU(), nn.Linear(hidden, latent_dim))

    def _hidden_of_wide(self) -> int:
        """The hidden width with which ``wide`` has as many weights as ``dynamic``, to half a hidden unit's."""
        w, d, z = self.action_dim, self.embedding_dim, self.latent_dim
        beyond_embedding = (w + 1) * d + 3 * d**2 + (d + 1) * 2 * z + (z + 1) * w
        return max(1, round((beyond_embedding - z) / (d + 1 + z)))

    def context_parameters(self) -> Iterator[th.Tensor]:
        """
        :return: All weights that the context of a history depends on
        """
        for layer in (*self.observation_embedding, self.action_embedding):
            # Not parameters(), which looks for submodules: this is asked once a step
            yield from layer._parameters.values()

    def encode_history(self, history: History) -> HistoryContext:
        """
        :param history: The agent's history
        :return: Its filled rows as directions and states
        """
        rows = history.filled()
        return self._encode_rows(rows, self.observation_embedding(rows.observations), to_compare=True)

    def _encode_rows(self, rows: History, embeddings: th.Tensor, to_compare: bool) -> HistoryContext:
        directions = F.normalize(self._compared(rows.observations, embeddings), dim=1) if to_compare else None
        return HistoryContext(directions, embeddings + self.action_embedding(rows.actions))

    def forward(
        self,
        observations: th.Tensor,
        history: History | None = None,
        noise: th.Tensor | None = None,
        kept: th.Tensor | None = None,
        context: HistoryContext | None = None,
    ) -> BeliefOutput:
        """
        :param observations: ``[B, d_o]``
        :param history: The agent's history; a variant that does not attend ignores it
        :param noise: Standard normal noise ``[B, z]`` for eq. 5; without it the belief is its mean. A variant that does not
            sample ignores it
        :param kept: The rows to attend to, ``[B, N_h]``, if they have been selected before; by default those most
            similar to each observation are selected here (eq. 3)
        :param context: ``encode_history(history)``, if it is at hand
        :return: The belief and all that belongs to it
        :raises ValueError: if a variant that attends is given no history, or more rows are to be kept than it has
        """
        if self.variant.attends:
            if context is not None:
                embedding = self.observation_embedding(observations)
            elif history is not None:
                # In one pass with the observations: few large matrix products are faster than many small ones
                rows = history.filled()
                both = self.observation_embedding(th.cat([observations, rows.observations]))
                embedding, embeddings = both.split([len(observations), len(rows.observations)])
                context = self._encode_rows(rows, embeddings, to_compare=kept is None)
            else:
                raise ValueError("this belief attends to the agent's history: pass it (sb3_belief.belief.empty_history)")
            if kept is None:
                kept = self._most_similar(observations, embedding, context)
            summary, weights = self._attend(embedding, context, kept)
            embedding = embedding + summary
        else:
            embedding = self.observation_embedding(observations)
            kept = th.zeros(len(observations), 0, dtype=th.long, device=observations.device)
            weights = embedding.new_zeros(kept.shape)
        encoded = self.encoder(embedding)
        if self.variant.samples:
            mean, log_std = encoded.chunk(2, dim=1)
            # clamp(), whose backward pass takes four times as long
            log_std = F.hardtanh(log_std, *LOG_STD_RANGE)
            latent = mean if noise is None else mean + log_std.exp() * noise
        else:
            latent = mean = encoded
            log_std = th.full_like(mean, -math.inf)
        prediction = self.decoder(latent) if self.variant.predicts else None
        return BeliefOutput(latent, mean, log_std, prediction, kept, weights)

    def _compared(self, observations: th.Tensor, embeddings: th.Tensor) -> th.Tensor:
        return (embeddings if self.similarity == "embedding" else observations).detach()

    @th.no_grad()
    def _most_similar(self, observations: th.Tensor, embeddings: th.Tensor, context: HistoryContext) -> th.Tensor:
        """
        Eq. 3, with the sign that its text asks for: printed, the equation keeps the *least* similar rows. The choice
        is discrete, so no gradient flows through it.
        """
        assert context.directions is not None
        # The length of the present one changes nothing in the order, so only the rows' directions are needed
        similarity = self._compared(observations, embeddings) @ context.directions.T
        return largest(similarity, n_kept(self.keep_ratio, similarity.shape[1]))

    def _attend(self, embedding: th.Tensor, context: HistoryContext, kept: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        Eq. 4 less its first term: the weighted sum of the kept rows' values, zero while the history is empty. The paper
        names no softmax; "scaled" is read as in the transformer, by the root of the width.

        Keys and values are linear in the states, so no row's are needed by themselves: the query goes to the states by way of
        the keys' weights, and the mean of values is the value of the mean. That is fewer products wherever B < T.
        """
        states = context.states
        if kept.shape[1] > len(states):
            raise ValueError(f"{kept.shape[1]} rows are to be kept of a history of {len(states)}; keep at most as many")
        if kept.shape[1] == 0:
            return th.zeros_like(embedding), embedding.new_zeros(kept.shape)
        queries = self.query(embedding) @ self.key.weight
        mean, weights = attend(queries, states, kept, 1 / math.sqrt(self.embedding_dim))
        return self.value(mean), weights
