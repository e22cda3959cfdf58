"""What a policy with a belief remembers, in training and when it is deployed."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_belief.belief import DynamicBelief, History
from sb3_belief.belief_ppo.adaptive import AdaptiveExtractor
from sb3_belief.belief_ppo.extractor import BeliefExtractor, flat_observations
from sb3_belief.belief_ppo.networks import BeliefNetworksMixin
from sb3_belief.belief_ppo.others import is_action_of, others_rows
from sb3_belief.common.action_encoding import RowEncoder

# Of how many observations the features are computed at a time
_FEATURE_ROWS = 64


class RememberingMixin(BeliefNetworksMixin):
    """The part of :class:`~sb3_belief.belief_ppo.policies.BeliefPolicyMixin` by which algorithm and users reach its memory."""

    #: Its features extractor
    _extractor: BeliefExtractor
    #: Whether what it remembers is put back afterwards (``team.observing``), so that it must not train meanwhile
    is_kept = False

    @property
    def belief(self) -> DynamicBelief | None:
        """The belief network, if there is one."""
        return self._extractor.belief if self.has_belief else None

    @property
    def remembers_waiting(self) -> bool:
        """Whether it remembers what it sees of the others while it waits for its turn."""
        return self.has_belief and isinstance(self._extractor, AdaptiveExtractor)

    @property
    def history(self) -> History | None:
        """The history from which the belief is inferred at present, if there is a belief that has one."""
        return self._extractor.history if self.has_belief else None

    def restore_history(self, history: History) -> None:
        """
        Put an earlier history back, to forget what was remembered since.

        :param history: A value that :attr:`history` had
        """
        self._extractor.restore_history(history)

    def remember(
        self,
        observations: np.ndarray | dict[str, np.ndarray],
        actions: np.ndarray | Mapping[str, Any],
        visible: Mapping[str, Any] | None = None,
        own_actions: np.ndarray | None = None,
        rewards: np.ndarray | None = None,
        copies: np.ndarray | None = None,
        acted: np.ndarray | None = None,
    ) -> None:
        """
        Append the agent's own active steps to its history, which is all that it needs to adapt to other teammates.

        The algorithm does so after each update; for a deployed agent its user does. A belief without a history remembers
        nothing.

        :param observations: Its observations as :meth:`predict` takes them, oldest first, ``[N, ...]``
        :param actions: What the others did at these steps: ``{name: actions}``, each ``[N, ...]`` in that other's own space
            (or a single one, where N is 1), without the others that were not visible at any, or with None for them; or all
            flattened and side by side, ``[N, W]``, zero where not visible, as in ``info["others_actions"]``
        :param visible: ``{name: bool [N]}``, at which of the steps each other was visible. If it is left out, at all of them,
            or where its part of ``[N, W]`` is not all zeros. What stands in ``actions`` at the other steps is ignored
        :param own_actions: What the agent itself did, ``[N, ...]`` in its own space, or a single one where N is 1; zeros if it
            is left out. This and what follows is for the adaptive belief alone
        :param rewards: Its own rewards, ``[N]``, or a single one where N is 1; zeros if they are left out. In the unit of its
            training: normalised if they were then
        :param copies: Where the agent acts in several copies of an environment at once, as in an evaluation: of which copy
            each row is, int ``[N]`` from 0, all of one step. :meth:`predict` takes the i-th of its observations for one of
            copy i. None if these are successive steps of one copy
        :param acted: In a game in turns, at which of the steps it was the agent's turn, bool ``[N]``: an adaptive belief also
            remembers what it sees while it waits, with its observation at its last turn. At all of them if it is left out
        :raises ValueError: If a name is unknown, something is not of this shape or no action of its space, or an observation
            is not finite; or within a rollout of an adaptive belief's training, which remembers its own steps by itself
        """
        if self.history is None:
            return
        if not self.is_kept and getattr(self._extractor, "online", None) is not None:
            raise ValueError(
                "the agent is in a rollout of its training, whose steps it remembers by itself, and its update would attend to"
                " other rows than acting did: remember after learn(), or evaluate within sb3_belief.team.observing"
            )
        # A tensor that is made in inference mode could never be trained on
        with th.inference_mode(False), th.no_grad():
            # obs_to_tensor() accepts images with the channels last, as the environment returns them
            rows = self.flat_observations(self.obs_to_tensor(observations)[0])
            if not bool(th.isfinite(rows).all()):
                raise ValueError(
                    "observations to remember hold a number that is not finite: attention to such a row would make all later "
                    "actions NaN; leave these steps out"
                )
            encoded, seen = others_rows(self.others_action_spaces, actions, visible, len(rows))
            actions_seen = th.as_tensor(encoded, device=self.device)
            if not isinstance(self._extractor, AdaptiveExtractor):
                self._extractor.remember(rows, actions_seen)
                return
            if copies is not None:
                copies = np.asarray(copies)
                if copies.shape != (len(rows),) or copies.dtype.kind not in "iu" or (copies < 0).any():
                    raise ValueError(f"copies must be integers of at least 0 of the shape {(len(rows),)}, not {copies!r}")
                copies = copies.astype(np.int64)
                if len(np.unique(copies)) < len(copies):
                    raise ValueError(f"copies must each be another one, since all are of one step, not {copies!r}")
            acted = np.ones(len(rows), dtype=bool) if acted is None else np.asarray(acted)
            if acted.shape != (len(rows),) or acted.dtype != bool:
                raise ValueError(f"acted must be one truth value for each of the {len(rows)} steps, not {acted!r}")
            own = th.as_tensor(self.own_rows(own_actions, rewards, len(rows), acted), device=self.device)
            anybody = th.as_tensor(seen.any(axis=1), device=self.device)
            self._extractor.remember_steps((rows, actions_seen, own), anybody, copies)

    def own_rows(
        self, actions: np.ndarray | None, rewards: np.ndarray | None, n_steps: int, acted: np.ndarray | None = None
    ) -> np.ndarray:
        """
        Return the agent's own part of some steps, as an adaptive belief remembers it.

        :param actions: Its actions, ``[N, ...]``, or a single one where N is 1; None for zeros
        :param rewards: Its rewards, ``[N]``, or a single one where N is 1; None for zeros
        :param n_steps: ``N``
        :param acted: At which steps it acted, bool ``[N]``, of which alone the actions count and are checked; None for actions
            that are known to be of its space, at all steps
        :return: float32 ``[N, U + 1]``
        :raises ValueError: If one of them has another shape, or is not finite, or an action is none of its space
        """
        encoder = RowEncoder("the agent", self.action_space)
        own = np.zeros((n_steps, encoder.width + 1), dtype=np.float32)
        for name, given, shape, columns in (
            ("own_actions", actions, (n_steps, *(self.action_space.shape or ())), slice(0, -1)),
            ("rewards", rewards, (n_steps,), slice(-1, None)),
        ):
            if given is None:
                continue
            values = np.asarray(given)
            if n_steps == 1 and values.shape == shape[1:]:
                values = values[None]
            # An agent that did nothing may be said to have done anything
            counted = slice(None) if name == "rewards" or acted is None else acted
            if values.shape != shape or values.dtype.kind not in "biuf" or not np.isfinite(values[counted]).all():
                raise ValueError(f"{name} must be finite numbers of the shape {shape}, not {values!r}")
            if name == "rewards":
                own[:, columns] = values[:, None]
            elif acted is None:
                own[:, columns] = encoder(values)
            else:
                for action in values[acted]:
                    if not is_action_of(self.action_space, action):
                        raise ValueError(f"own_actions has {action!r}, which is no action of {self.action_space}")
                own[acted, columns] = encoder(values[acted])
        return own

    def end_episodes(self, copies: np.ndarray | None = None) -> None:
        """
        Tell a deployed agent that an episode has ended: what follows is another one. Only the adaptive belief knows of them.

        :param copies: In which copies, as of :meth:`remember`, int ``[n]``; None for all in which it acts
        :raises ValueError: If these are no numbers of copies
        """
        if copies is not None:
            copies = np.asarray(copies)
            if copies.ndim != 1 or (copies.size and copies.dtype.kind not in "iu") or (copies < 0).any():
                raise ValueError(f"copies must be a list of integers of at least 0, or None for all, not {copies!r}")
            copies = copies.astype(np.int64)
        if self.has_belief and isinstance(self._extractor, AdaptiveExtractor):
            self._extractor.end_episodes(copies)

    def pass_time(self) -> None:
        """Note a step at which there was nothing to remember. Only the adaptive belief knows how long ago something was."""
        if self.has_belief and isinstance(self._extractor, AdaptiveExtractor):
            self._extractor.pass_time(1)

    def memory_state(self) -> dict[str, th.Tensor]:
        """Return all that is remembered, for :meth:`restore_memory_state`; empty for a belief without a history."""
        buffers = dict(self._extractor.named_buffers(recurse=False)) if self.has_belief else {}
        return {name: rows for name, rows in buffers.items() if name.startswith("history_")}

    def restore_memory_state(self, state: Mapping[str, th.Tensor]) -> None:
        """
        Put back what was remembered, with how much time has passed since.

        :param state: As :meth:`memory_state` returned it
        """
        for name, rows in state.items():
            setattr(self._extractor, name, rows)

    def flat_observations(self, observations: PyTorchObs) -> th.Tensor:
        """
        Convert observations to what belief and history take: preprocessed as SB3 does and flat, or their features.

        :param observations: Observations as the environment returns them, batch first
        :return: ``[B, d_o]``
        """
        if not (self.has_belief and self._extractor.from_features):
            return flat_observations(self, observations)
        self.set_training_mode(False)
        # A few at a time: the images of a whole history would take gigabytes as floats
        parts = observations if isinstance(observations, dict) else {"": observations}
        features = []
        with th.no_grad():
            for rows in zip(*(part.split(_FEATURE_ROWS) for part in parts.values()), strict=True):
                some: Any = dict(zip(parts, rows, strict=True))
                some = some if isinstance(observations, dict) else some[""]
                features.append(self._extractor.features(preprocess_obs(some, self.observation_space, self.normalize_images)))
        return th.cat(features)
