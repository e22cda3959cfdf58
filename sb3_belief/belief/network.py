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

from sb3_belief.belief.attention import attend, topk_indices
from sb3_belief.belief.history import History
from sb3_belief.belief.variants import VARIANTS

#: What history rows are compared by to find those that resemble the present (Fig. 5b)
SIMILARITIES = ("embedding", "observation")
# The deviation of the belief stays between 0.7 % and 7.4 times that of the prior: beyond that its log-likelihood and
# the sampled latent are numerically useless
LOG_STD_RANGE = (-5.0, 2.0)


class BeliefOutput(NamedTuple):
    """
    A belief about the others, and where it comes from.

    :param latent: The belief ``delta``, ``[B, z]`` (eq. 5)
    :param mean: Mean of its distribution, ``[B, z]``
    :param log_std: Log standard deviation of its distribution, ``[B, z]``; minus infinity where it is a single point
    :param prediction: The others' predicted actions, flattened, ``[B, W]``: numbers or logits, depending on the loss that they
        are trained with; None for a belief that predicts nothing
    :param selected: The history rows attended to, as indices into the rows filled so far, int32 ``[B, N_h]``;
        ``N_h`` is 0 while the history is empty, and for a belief without one
    :param weights: Their attention weights, ``[B, N_h]``, each row sums to one
    :param later: As ``prediction``, what they do one, two, ... steps later, ``[B, k, W]``; None for a belief that predicts the
        present step alone
    """

    latent: th.Tensor
    mean: th.Tensor
    log_std: th.Tensor
    prediction: th.Tensor | None
    selected: th.Tensor
    weights: th.Tensor
    later: th.Tensor | None = None


class HistoryContext(NamedTuple):
    """
    A history encoded by the network. It stays the same as long as neither the history nor the weights change.

    :param directions: Embeddings or observations of the rows, of unit length for the cosine similarity, ``[T, d]`` or ``[T,
        d_o]``
    :param keys: Keys of the rows, ``[T, d]``, divided by the root of the width
    :param values: Values of the rows, ``[T, d]``
    """

    directions: th.Tensor
    keys: th.Tensor
    values: th.Tensor


def n_selected(keep_ratio: float, n_rows: int) -> int:
    """
    Return how many history rows are attended to.

    :param keep_ratio: ``p``, in (0, 1]
    :param n_rows: Number of filled history rows, at least 0
    :return: ``N_h`` of eq. 3: a share of ``keep_ratio``, at least one row if there is any
    """
    return min(n_rows, max(1, round(keep_ratio * n_rows)))


def filled_rows(history: History) -> History:
    """
    Return the rows of a history that hold a step, without the rest.

    :param history: A history
    :return: Its valid rows; the history itself where all are valid
    """
    if bool(history.valid.all()):
        return history
    return History(*(rows[history.valid] for rows in history))


class DynamicBelief(nn.Module):
    """
    The network that infers what the agent believes about the others, from its observation and its history.

    The variants of the belief lack some of its parts. These are not built, so that all weights of a network are in use.

    :param observation_dim: ``d_o``, width of the flattened observation
    :param action_dim: ``W``, width of the others' flattened actions
    :param embedding_dim: ``d``, width of embeddings, queries, keys and values
    :param latent_dim: ``z``, width of the belief
    :param keep_ratio: ``p``, the share of the history that is attended to, in (0, 1]
    :param variant: A key of :data:`~sb3_belief.belief.VARIANTS`
    :param similarity: What rows are compared with the present by: their ``"embedding"`` (eq. 3) or the ``"observation"``
        itself (Fig. 5b)
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
            nn.Linear(observation_dim, embedding_dim), nn.ReLU(inplace=True), nn.Linear(embedding_dim, embedding_dim)
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
        """Return the hidden width with which ``wide`` has as many weights as ``dynamic``, to within half a hidden unit."""
        w, d, z = self.action_dim, self.embedding_dim, self.latent_dim
        beyond_embedding = (w + 1) * d + 3 * d**2 + (d + 1) * 2 * z + (z + 1) * w
        return max(1, round((beyond_embedding - z) / (d + 1 + z)))

    def context_parameters(self) -> list[th.Tensor]:
        """
        Return all weights on which the encoded history depends.
        """
        # Not by parameters(), which searches all submodules: this is called once a step
        layers = (*self.observation_embedding, self.action_embedding, self.key, self.value)
        return [weights for layer in layers for weights in layer._parameters.values() if weights is not None]

    def encode_history(self, history: History) -> HistoryContext:
        """
        Encode a history.

        :param history: The agent's history
        :return: Its filled rows as directions, keys and values
        """
        rows = filled_rows(history)
        embeddings = self.observation_embedding(rows.observations)
        states = embeddings + self.action_embedding(rows.actions)
        directions = F.normalize(self._compared(rows.observations, embeddings), dim=-1)
        return HistoryContext(directions, self.key(states) / math.sqrt(self.embedding_dim), self.value(states))

    def forward(
        self,
        observations: th.Tensor,
        history: History | None = None,
        noise: th.Tensor | None = None,
        selected: th.Tensor | None = None,
        context: HistoryContext | None = None,
        predict: bool = True,
    ) -> BeliefOutput:
        """
        Infer the belief.

        :param observations: ``[B, d_o]``
        :param history: The agent's history; a variant that does not attend ignores it
        :param noise: Standard normal noise ``[B, z]`` for eq. 5; without it the belief is its mean. A variant that does not
            sample ignores it
        :param selected: The rows to attend to, ``[B, N_h]``, if they were selected before; None to select those most similar
            to each observation (eq. 3)
        :param context: ``encode_history(history)``, if it is known already; no gradients flow to the weights through it then
        :param predict: Whether to predict the others' actions
        :return: The belief
        :raises ValueError: If a variant that attends is given no history, or more rows are selected than it has
        """
        embedding = self.observation_embedding(observations)
        if self.variant.attends:
            if context is None and history is not None and selected is not None:
                summary, weights = self._attend_to_states(embedding, filled_rows(history), selected)
            else:
                if context is None:
                    if history is None:
                        raise ValueError(
                            "this belief attends to the agent's history: pass it (sb3_belief.belief.empty_history)"
                        )
                    context = self.encode_history(history)
                selected = self._most_similar(observations, embedding, context) if selected is None else selected
                summary, weights = attend(self.query(embedding), context.keys, context.values, selected)
            embedding = embedding + summary
        else:
            selected = th.zeros(*observations.shape[:-1], 0, dtype=th.int, device=observations.device)
            weights = embedding.new_zeros(selected.shape)
        encoded = self.encoder(embedding)
        if self.variant.samples:
            mean, log_std = encoded.chunk(2, dim=-1)
            # The same as clamp(), whose backward pass takes four times as long
            log_std = F.hardtanh(log_std, *LOG_STD_RANGE)
            latent = mean if noise is None else mean + log_std.exp() * noise
        else:
            latent = mean = encoded
            log_std = th.full_like(mean, -math.inf)
        prediction = self.decoder(latent) if predict and self.variant.predicts else None
        return BeliefOutput(latent, mean, log_std, prediction, selected, weights)

    def _compared(self, observations: th.Tensor, embeddings: th.Tensor) -> th.Tensor:
        return (embeddings if self.similarity == "embedding" else observations).detach()

    @th.no_grad()
    def _most_similar(self, observations: th.Tensor, embeddings: th.Tensor, context: HistoryContext) -> th.Tensor:
        """
        Select the rows of eq. 3, with the sign that its text asks for: as printed, the equation keeps the *least* similar
        rows. The choice is discrete, so no gradient flows through it.
        """
        # The length of the present vector does not change the order, so only those of the rows are normalised
        similarity = self._compared(observations, embeddings) @ context.directions.mT
        return topk_indices(similarity, n_selected(self.keep_ratio, similarity.shape[-1]))

    def _attend_to_states(self, embedding: th.Tensor, rows: History, selected: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        Compute eq. 4 without its first term: the weighted sum of the selected rows' values, zero while the history is empty.
        The paper names no softmax; "scaled" is read as in the transformer, by the root of the width.

        Keys and values of all rows are not needed, since both are linear in the states: the query is multiplied with the keys'
        weights and then with the states, and the mean of the values is the value of the mean state. These are fewer products
        than encoding the history where B < T.
        """
        if selected.shape[-1] == 0:
            # Not connected to the graph: a gradient of zeros would count as a step of Adam
            return th.zeros_like(embedding), embedding.new_zeros(selected.shape)
        states = self.observation_embedding(rows.observations) + self.action_embedding(rows.actions)
        queries = self.query(embedding) @ (self.key.weight / math.sqrt(self.embedding_dim))
        mean, weights = attend(queries, states, states, selected)
        return self.value(mean), weights
