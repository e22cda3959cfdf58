"""The features of an agent whose belief adapts while it plays, and its memory of the rollout under way."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from sb3_belief.belief import ActionLayout, BeliefOutput, expected_actions
from sb3_belief.belief.adaptive import AdaptiveBelief, EncodedMemory
from sb3_belief.belief.memory import DEPLOYED, FIRST_EPISODE, Memory, empty_memory, followed_by, newest, valid_rows
from sb3_belief.belief_ppo.buffers import BeliefMinibatch
from sb3_belief.belief_ppo.extractor import BeliefExtractor, BeliefFeatures, BeliefPass
from sb3_belief.belief_ppo.options import BeliefOptions
from sb3_belief.common.kept_tensors import KeptTensors

#: How many steps of each rollout are replayed
REPLAYED_ROWS = 256


class AdaptiveExtractor(BeliefExtractor):
    """
    Features of the observation and, beside them, the belief with the actions that it expects of the others.

    What it attends to depends on where it is asked. In a rollout these are the history from before the last update and the
    rollout's earlier steps (``online``); in the update the same rows (``table``); elsewhere the history.

    :param observation_space: The agent's observation space
    :param features: Extractor of the features of the observation itself
    :param belief: The belief network
    :param options: The user's options of the belief
    :param from_features: Whether belief and memory see these features instead of the observation itself
    :param layout: Layout of the others' actions
    """

    belief: AdaptiveBelief  # type: ignore[assignment]
    history_own: th.Tensor
    history_stamps: th.Tensor
    #: Number of the next step, and in how many copies the agent has acted outside of training, int64 ``[2]``
    history_clock: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Space,
        features: BaseFeaturesExtractor,
        belief: AdaptiveBelief,
        options: BeliefOptions,
        from_features: bool,
        layout: ActionLayout,
    ) -> None:
        super().__init__(observation_space, features, belief, options, from_features)  # type: ignore[arg-type]
        self.layout = layout
        self.belief_width = belief.latent_dim + layout.width
        self._features_dim = features.features_dim + self.belief_width
        #: The memory of the rollout under way; None outside of one
        self.online: OnlineMemory | None = None
        #: What the rows of an update attend to; None outside of one
        self.table: Memory | None = None
        #: Past rollouts on which the belief is trained in an update as well; see :func:`replayed`
        self.replay: list[Replayed] = []
        self.register_buffer("history_clock", th.zeros(2, dtype=th.int64))

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "online": None, "table": None, "replay": []}

    def _empty_history(self) -> Any:
        belief = self.belief
        return empty_memory(self.options.history_length, belief.observation_dim, belief.action_dim, belief.own_dim)

    @property
    def history(self) -> Memory:  # type: ignore[override]
        """What the agent remembers outside of a rollout."""
        return Memory(*(getattr(self, f"history_{name}") for name in Memory._fields))

    def restore_history(self, history: Memory) -> None:  # type: ignore[override]
        self._set_rows(history)
        stamps = history.stamps[history.valid]
        now = int(stamps[:, 0].max()) + 1 if len(stamps) else 0
        self._set_clock(now, max(0, DEPLOYED + 1 - int(stamps[:, 1].min())) if len(stamps) else 0)

    def _set_rows(self, history: Memory) -> None:
        for name, rows in history._asdict().items():
            setattr(self, f"history_{name}", rows)

    @property
    def clock(self) -> int:
        """Number of the next step."""
        return int(self.history_clock[0])

    @property
    def n_copies(self) -> int:
        """In how many copies the agent has acted outside of training."""
        return int(self.history_clock[1])

    def _set_clock(self, now: int, n_copies: int) -> None:
        self.history_clock = th.tensor([now, n_copies], device=self.history_clock.device)

    def append(self, rows: Memory, now: int, n_copies: int | None = None) -> None:
        """
        Append steps to the history.

        :param rows: The steps, oldest first
        :param now: Number of the step that follows, whether or not anything was seen before it
        :param n_copies: In how many copies the agent acts outside of training; None if that has not changed
        """
        self._set_rows(newest(followed_by(self.history, rows), self.options.history_length))
        self._set_clock(now, self.n_copies if n_copies is None else n_copies)

    def pass_time(self, steps: int) -> None:
        """
        Let the next step be a later one.

        :param steps: How many steps have passed of which there is nothing to remember, or not yet
        """
        self._set_clock(self.clock + steps, self.n_copies)

    def remember_steps(
        self, rows: tuple[th.Tensor, th.Tensor, th.Tensor], visible: th.Tensor, copies: np.ndarray | None
    ) -> None:
        """
        Append steps outside of training.

        :param rows: As in ``Memory``, oldest first: observations ``[N, d_o]``, the others' actions ``[N, W]``, and own actions
            and rewards ``[N, U + 1]``
        :param visible: At which of them somebody was visible, bool ``[N]``
        :param copies: Of which copy each step is, from 0, all of one joint step, int ``[N]``; None for successive steps of one
        """
        now, n = self.clock, len(visible)
        times, places = np.arange(now, now + n), np.full(n, DEPLOYED)
        if copies is not None:
            times, places = np.full(n, now), DEPLOYED - copies
        episodes = self._episodes()
        stamps = np.stack([times, places, [episodes.get(int(place), FIRST_EPISODE) for place in places]], axis=1)
        after = now + (n if copies is None else 1)
        n_copies = max(self.n_copies, 1 if copies is None else int(copies.max(initial=0)) + 1)
        self.append(Memory(*rows, th.as_tensor(stamps), visible), after, n_copies)

    def end_episodes(self, copies: np.ndarray | None) -> None:
        """
        Have what follows belong to other episodes than what was remembered outside of training.

        :param copies: In which copies, int ``[n]`` from 0; None for all
        """
        ended = range(max(1, self.n_copies)) if copies is None else copies.tolist()
        stamps = self.history_stamps.clone()
        for copy in ended:
            rows = (self.history_valid & (stamps[:, 1] == DEPLOYED - copy)).nonzero()
            if len(rows):
                last = stamps[rows[-1, 0]]
                last[2] = _ended(last[2])
        self.history_stamps = stamps

    def _episodes(self) -> dict[int, int]:
        """Return the step with which the present episode began of each copy outside of training of which there is a row."""
        deployed = self.history_stamps[self.history_valid & (self.history_stamps[:, 1] <= DEPLOYED)]
        return {place: now + 1 if began < FIRST_EPISODE else began for now, place, began in deployed.tolist()}

    def present_stamps(self, n: int) -> th.Tensor:
        """
        Return the stamps of observations outside of training, of which the i-th is of copy i; all are of the first copy for an
        agent that has acted in one alone, which may be evaluated in many.

        :param n: Their number
        :return: int64 ``[n, 3]``
        """
        now, episodes = self.clock, self._episodes()
        places = [DEPLOYED - copy if self.n_copies > 1 else DEPLOYED for copy in range(n)]
        rows = [(now, place, episodes.get(place, FIRST_EPISODE)) for place in places]
        return th.tensor(rows, dtype=th.int64, device=self.history_stamps.device).reshape(n, 3)

    def believe(self, flat: th.Tensor, belief_pass: BeliefPass) -> BeliefOutput:
        if belief_pass.selected is not None:
            assert self.table is not None and belief_pass.stamps is not None
            return self.belief(flat, belief_pass.stamps, self.belief.encode(self.table), belief_pass.selected)
        if self.online is None or not belief_pass.acts:
            return self.infer(flat)
        stamps = self.online.stamps() if belief_pass.stamps is None else belief_pass.stamps
        dropped = None
        if belief_pass.sample and self.options.history_dropout:
            # Some passes see the null row only, so that neither belief nor policy relies on a memory that may be empty
            dropped = th.rand(len(flat), device=flat.device) < self.options.history_dropout
        return self.belief(flat, stamps, self.online.encoded(), dropped=dropped)

    def infer(  # type: ignore[override]
        self, flat: th.Tensor, noise: None = None, selected: None = None, predict: bool = True
    ) -> BeliefOutput:
        """
        Infer the belief from the history.

        :param flat: Preprocessed flat observations, ``[B, d_o]``
        :param noise: None: the belief is a point
        :param selected: None: the rows of the highest scores
        :param predict: The prediction is part of the features, so it is made in any case
        :return: The belief
        """
        # Kept while nothing is remembered or learned, but for a pass that needs gradients
        memory = self.belief.encode_history(self.history) if th.is_grad_enabled() else self.encoded(self.history)  # type: ignore
        return self.belief(flat, self.present_stamps(len(flat)), memory)

    def context(self) -> tuple[EncodedMemory, th.Tensor]:
        return super().context(), self.present_stamps(1)

    def infer_from(self, context: Any, flat: th.Tensor) -> BeliefOutput:
        # All of them as observations of one copy
        memory, stamps = context
        return self.belief(flat, stamps.expand(flat.shape[0], -1), memory)

    def attended(self) -> Memory:  # type: ignore[override]
        assert self.table is not None
        return self.table

    def judged(self, flat: th.Tensor, minibatch: BeliefMinibatch, history: Any = None) -> BeliefOutput:
        memory = self.belief.encode(history or self.attended())
        return self.belief(flat, minibatch.stamps, memory, minibatch.selected)

    def with_belief(self, own: th.Tensor, output: BeliefOutput) -> BeliefFeatures | th.Tensor:
        assert output.prediction is not None
        expected = expected_actions(output.prediction, self.layout, self.options.loss_of(self.layout))
        return self._beside(own, th.cat([output.mean, expected], dim=-1))


def _ended(began: th.Tensor) -> th.Tensor:
    """Mark the last row of an episode, by a number that no episode has: -2 in place of -1, -3 of 0, -4 of 1, ..."""
    return th.where(began < FIRST_EPISODE, began, 2 * FIRST_EPISODE - 1 - began)


class Replayed(NamedTuple):
    """
    Some steps of a past rollout, with what the agent remembered then.

    :param table: What it attended to
    :param flat: Its preprocessed flat observations, ``[B, d_o]``
    :param minibatch: The rows that it attended to, and what the others did
    """

    table: Memory
    flat: th.Tensor
    minibatch: BeliefMinibatch


def to_be_replayed(table: Memory, flat: th.Tensor, minibatch: BeliefMinibatch) -> dict[str, np.ndarray]:
    """
    Return steps of a rollout as a rollout buffer keeps them, and a checkpoint saves them.

    Of the table only the rows that these steps attended to are kept: the others would cost memory, and time to encode them.

    :param table: What they attended to
    :param flat: Their preprocessed flat observations, ``[B, d_o]``
    :param minibatch: Their part of the belief
    :return: Arrays by name
    """
    selected: Any = minibatch.selected
    kept = selected[selected >= 0].unique().long()
    # A table has at least one row
    kept = kept if len(kept) else th.arange(min(1, len(table.valid)), device=kept.device)
    place = th.full((len(table.valid) + 1,), -1, dtype=selected.dtype, device=kept.device)
    place[kept] = th.arange(len(kept), dtype=selected.dtype, device=kept.device)
    # -1, the null row, finds the last place
    table, minibatch = Memory(*(rows[kept] for rows in table)), minibatch._replace(selected=place[selected.long()])
    parts = {f"table_{name}": rows for name, rows in table._asdict().items()}
    parts |= {f"minibatch_{name}": rows for name, rows in minibatch._asdict().items() if rows is not None}
    return {name: rows.cpu().numpy().copy() for name, rows in {**parts, "flat": flat}.items()}


def replayed(kept: Mapping[str, np.ndarray], device: th.device) -> Replayed:
    """
    Return steps of a past rollout as the belief takes them.

    :param kept: As of :func:`to_be_replayed`
    :param device: Device of the policy
    :return: The steps
    """
    tensors = {name: th.as_tensor(rows, device=device) for name, rows in kept.items()}
    table = Memory(*(tensors[f"table_{name}"] for name in Memory._fields))
    minibatch = BeliefMinibatch(*(tensors.get(f"minibatch_{name}") for name in BeliefMinibatch._fields))  # type: ignore
    return Replayed(table, tensors["flat"], minibatch)


class OnlineMemory:
    """
    What an agent remembers in its rollout: the history from before the last update, and the rollout's earlier steps.

    :param model: The agent's model, whose rollout buffer is empty
    """

    def __init__(self, model: Any):
        self._model, self._buffer = model, model.rollout_buffer
        extractor: AdaptiveExtractor = model.policy.features_extractor
        self._belief, self._clock = extractor.belief, extractor.clock
        self._frozen = valid_rows(extractor.history)
        self._encoded: EncodedMemory | None = None
        self._n_steps, self._weights = 0, KeptTensors()
        self._stamps, self._stamped = th.zeros(0), -1

    def stamps(self) -> th.Tensor:
        """Return the stamps of the present observations of all copies, int64 ``[n_envs, 3]``."""
        if self._stamped != self._buffer.pos:
            starts = np.asarray(self._model._last_episode_starts, dtype=bool)
            stamps = self._buffer.stamp(self._clock + self._buffer.pos, starts)
            self._stamps, self._stamped = th.as_tensor(stamps, device=self._model.device), self._buffer.pos
        return self._stamps

    def note_bootstraps(self, copies: list[int], values: th.Tensor) -> None:
        """
        Note what SB3 is about to add to rewards at time limits, which the agent has not got.

        :param copies: The copies whose episodes were cut off
        :param values: Values of their last observations, ``[n, 1]``
        """
        self._buffer.bootstraps[copies] = self._buffer.gamma * values.cpu().numpy().flatten()

    @th.no_grad()
    def encoded(self) -> EncodedMemory:
        """Return the encoded memory. With each step only its own rows are encoded."""
        if self._encoded is None or self._weights.changed(self._belief.context_parameters()):
            self._encoded, self._n_steps = self._belief.encode(self._frozen), 0
        if self._n_steps < self._buffer.pos:
            new = self._belief.encode(self._model.remembered(self._n_steps, self._buffer.pos))
            self._encoded = EncodedMemory(*(th.cat([a, b]) for a, b in zip(self._encoded, new, strict=True)))
            self._n_steps = self._buffer.pos
        return self._encoded
