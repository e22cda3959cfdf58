"""
A belief that adapts while it plays: for teammates that change within a rollout, or differ among the copies of the
environment, where the paper's :class:`~sb3_belief.belief.DynamicBelief` looks back on the rollout before only.
"""

import math
from collections.abc import Collection
from typing import NamedTuple

import torch as th
import torch.nn.functional as F
from torch import nn

from sb3_belief.belief.attention import attend_beside_null, sum_beside_null, topk_indices
from sb3_belief.belief.memory import Memory, valid_rows
from sb3_belief.belief.network import BeliefOutput
from sb3_belief.belief.variants import ADAPTIVE

#: What rows of the memory can tell beside the observation and the others' actions
ROW_FEATURES = ("own_action", "reward", "age", "episode", "copy")
# Ages count by their logarithm, in units of that of a thousand steps
_AGE_UNIT = math.log(1000.0)


class EncodedMemory(NamedTuple):
    """
    A memory as the network sees it.

    :param states: States of the rows, of which keys and values are linear functions, ``[T, d]``
    :param stamps: As of the memory, int64 ``[T, 3]``
    :param valid: As of the memory, bool ``[T]``
    """

    states: th.Tensor
    stamps: th.Tensor
    valid: th.Tensor


class AdaptiveBelief(nn.Module):
    """
    The network that infers what the agent believes about the others, from its observation and its memory.

    As in the paper it attends to a few rows, and predicts the others' actions from what it found. The rows are those that the
    attention itself scores highest, of two scopes: of the same copy of the environment, with this partner, and of the others.
    A learned null row always takes part, so that having nothing to say is an answer. The belief is a point.

    :param observation_dim: ``d_o``, width of the flattened observation
    :param action_dim: ``W``, width of the others' flattened actions
    :param own_dim: ``U + 1``, width of the agent's own flattened action and reward
    :param embedding_dim: ``d``, width of embeddings, queries, keys and values
    :param latent_dim: ``z``, width of the belief
    :param n_own: Most rows of the same copy that are attended to, at least 0
    :param n_pool: Most rows of other copies that are attended to, at least 0
    :param row_features: Which of :data:`ROW_FEATURES` the network gets; the rest is zero
    :param prediction_steps: Of how many steps the others' actions are predicted, the present one first, at least 1
    """

    variant = ADAPTIVE
    pair_mask: th.Tensor
    own_mask: th.Tensor

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        own_dim: int,
        embedding_dim: int = 64,
        latent_dim: int = 64,
        n_own: int = 32,
        n_pool: int = 32,
        row_features: Collection[str] = ROW_FEATURES,
        prediction_steps: int = 1,
    ) -> None:
        super().__init__()
        self.observation_dim, self.action_dim, self.own_dim = observation_dim, action_dim, own_dim
        self.embedding_dim, self.latent_dim = embedding_dim, latent_dim
        self.n_own, self.n_pool = n_own, n_pool
        self.prediction_steps = prediction_steps
        self.observation_embedding = nn.Sequential(
            nn.Linear(observation_dim, embedding_dim), nn.ReLU(inplace=True), nn.Linear(embedding_dim, embedding_dim)
        )
        self.event_embedding = nn.Linear(action_dim + own_dim, embedding_dim)
        self.query = nn.Linear(embedding_dim, embedding_dim, bias=False)
        self.key = nn.Linear(embedding_dim, embedding_dim, bias=False)
        self.value = nn.Linear(embedding_dim, embedding_dim, bias=False)
        self.pair_score = nn.Linear(3, 1, bias=False)
        with th.no_grad():
            # To begin with, those rows count that resemble the present, are recent, and are of this partner
            self.key.weight.copy_(nn.init.orthogonal_(self.query.weight))
            self.pair_score.weight.copy_(th.tensor([[-1.0, 1.0, 1.0]]))
        self.pair_value = nn.Linear(3, embedding_dim, bias=False)
        self.null_key = nn.Parameter(th.zeros(embedding_dim))
        self.null_value = nn.Parameter(th.zeros(embedding_dim))
        self.encoder = nn.Sequential(nn.ReLU(), nn.Linear(embedding_dim, latent_dim))
        self.decoder = nn.Linear(latent_dim, prediction_steps * action_dim)
        own = th.tensor([["own_action" in row_features]] * (own_dim - 1) + [["reward" in row_features]])
        self.register_buffer("own_mask", own.flatten().float(), persistent=False)
        pair = th.tensor([float(name in row_features) for name in ("age", "episode", "copy")])
        self.register_buffer("pair_mask", pair, persistent=False)

    def context_parameters(self) -> list[th.Tensor]:
        """Return all weights on which the encoded memory depends."""
        layers = (*self.observation_embedding, self.event_embedding)
        return [weights for layer in layers for weights in layer._parameters.values() if weights is not None]

    def encode(self, memory: Memory) -> EncodedMemory:
        """
        Encode a memory.

        :param memory: A memory, or a part of it
        :return: Its rows as states
        """
        events = th.cat([memory.actions, memory.own * self.own_mask], dim=-1)
        states = self.observation_embedding(memory.observations) + self.event_embedding(events)
        return EncodedMemory(states, memory.stamps, memory.valid)

    def encode_history(self, history: Memory) -> EncodedMemory:
        """
        Encode a history, of which not all rows need be filled.

        :param history: The agent's history
        :return: Its valid rows as states
        """
        return self.encode(valid_rows(history))

    def forward(
        self,
        observations: th.Tensor,
        stamps: th.Tensor,
        memory: EncodedMemory,
        selected: th.Tensor | None = None,
        dropped: th.Tensor | None = None,
    ) -> BeliefOutput:
        """
        Infer the belief.

        :param observations: ``[B, d_o]``
        :param stamps: When and where they were made, as in :class:`~sb3_belief.belief.memory.Memory`, int64 ``[B, 3]``
        :param memory: What the agent remembers
        :param selected: The rows to attend to, as returned before, int32 ``[B, n_own + n_pool + 1]``; None to select those of
            the highest scores
        :param dropped: Which observations see the null row only, bool ``[B]``; None for none of them
        :return: The belief. Rows beyond those that there are have the number -1 and no weight; the last is the null row, also
            -1
        """
        if not len(memory.valid):
            # A row to which nobody attends, so that there is something to index
            memory = EncodedMemory(*(part.new_zeros(1, *part.shape[1:]) for part in memory))
        embedding = self.observation_embedding(observations)
        query = self.query(embedding)
        # With keys and values the states are multiplied here, and not the many rows of the memory
        in_states = query @ (self.key.weight / math.sqrt(self.embedding_dim))
        scores = None
        if selected is None:
            selected, scores = self._select(in_states, stamps, memory)
        if dropped is not None:
            selected = selected.masked_fill(dropped[:, None], -1)
        nothing = selected[:, :-1] < 0
        rows = selected[:, :-1].clamp(min=0)
        pairs = self._pairs(stamps, memory.stamps[rows.long()])
        null = query @ self.null_key / math.sqrt(self.embedding_dim)
        if scores is None or th.is_grad_enabled():
            bias = self.pair_score(pairs).squeeze(-1).masked_fill(nothing, -math.inf)
            state, weights = attend_beside_null(in_states, memory.states, bias, null, rows)
        else:
            # While acting the scores are known from the selection
            state, weights = sum_beside_null(memory.states, scores.masked_fill(nothing, -math.inf), null, rows)
        summary = self.value(state) + self.pair_value((weights[:, :-1, None] * pairs).sum(dim=1))
        mean = self.encoder(embedding + summary + weights[:, -1:] * self.null_value)
        predictions = self.decoder(mean).unflatten(1, (self.prediction_steps, self.action_dim))
        later = predictions[:, 1:] if self.prediction_steps > 1 else None
        return BeliefOutput(mean, mean, th.full_like(mean, -math.inf), predictions[:, 0], selected, weights, later)

    def _select(self, query: th.Tensor, stamps: th.Tensor, memory: EncodedMemory) -> tuple[th.Tensor, th.Tensor]:
        """
        Select the rows of the highest scores, which is discrete: no gradient flows through it.

        :return: The rows of the same copy, then those of others, then the null row, int32 ``[B, n_own + n_pool + 1]``; -1 for
            none; and the scores of all but the null row, ``[B, n_own + n_pool]``
        """
        of_age, of_episode, of_copy = (self.pair_score.weight[0] * self.pair_mask).detach().unbind()
        # The copies of a rollout are all at the same step
        at_once = not th.compiler.is_compiling() and bool((stamps[:, 0] == stamps[0, 0]).all())
        now = stamps[:1] if at_once else stamps
        of_rows = of_age * _ages(now[:, :1], memory.stamps[:, 0]) + th.where(memory.valid, 0.0, -math.inf)
        scores = query.detach() @ memory.states.detach().mT + of_rows
        own_rows, exists = _rows_of_copies(memory.stamps[:, 1], stamps[:, 1].contiguous())
        same_episode = stamps[:, 2:] == memory.stamps[:, 2][own_rows]
        own_scores = (scores.gather(1, own_rows) + of_episode * same_episode).masked_fill_(~exists, -math.inf)
        own = own_scores.topk(min(self.n_own, own_scores.shape[1]), dim=1)
        pool_scores = scores.scatter_add_(1, own_rows, th.where(exists, -math.inf, 0.0))
        pool = topk_indices(pool_scores, min(self.n_pool, scores.shape[1]))
        parts = (
            _filled_up(own_rows.gather(1, own.indices).int(), own.values + of_copy, self.n_own),
            _filled_up(pool, pool_scores.gather(1, pool.long()), self.n_pool),
        )
        rows, of_selected = (th.cat(part, dim=1) for part in zip(*parts, strict=True))
        return F.pad(rows, (0, 1), value=-1), of_selected

    def _pairs(self, stamps: th.Tensor, rows: th.Tensor) -> th.Tensor:
        """Return age, same episode and same copy of stamps of rows, ``[..., N, 3]``, seen from observations, ``[B, N, 3]``."""
        now = stamps[:, None]
        age = _ages(now[..., 0], rows[..., 0])
        same_copy = now[..., 1] == rows[..., 1]
        same_episode = same_copy & (now[..., 2] == rows[..., 2])
        return th.stack([age, same_episode.float(), same_copy.float()], dim=-1) * self.pair_mask


def _ages(now: th.Tensor, then: th.Tensor) -> th.Tensor:
    return (now - then).clamp(min=0).float().log1p() / _AGE_UNIT


def _rows_of_copies(copies: th.Tensor, asked: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """
    Return the rows of each copy that is asked for. Selecting among them instead of among all rows takes 0.9 of the time of a
    selection from 2,080 rows, and 0.55 of that from 8,000.

    :param copies: Of the rows, int64 ``[T]``
    :param asked: int64 ``[B]``
    :return: Rows, as many as the copy has that has most, int64 ``[B, K]``, and whether there is one, bool ``[B, K]``
    """
    if th.compiler.is_compiling():
        # The shapes of a graph that is being exported must not depend on the data
        return th.arange(len(copies), device=copies.device).expand(asked.shape[0], -1), asked[:, None] == copies
    in_order, order = copies.sort(stable=True)
    first, end = th.searchsorted(in_order, asked), th.searchsorted(in_order, asked, right=True)
    places = first[:, None] + th.arange(int((end - first).max()), device=asked.device)
    return order[places.clamp(max=len(copies) - 1)], places < end[:, None]


def _filled_up(rows: th.Tensor, scores: th.Tensor, n: int) -> tuple[th.Tensor, th.Tensor]:
    """Return rows, -1 in place of those whose score is minus infinity, and their scores, both filled up to n columns."""
    missing = (0, n - rows.shape[1])
    return F.pad(rows.masked_fill(scores == -math.inf, -1), missing, value=-1), F.pad(scores, missing, value=-math.inf)
