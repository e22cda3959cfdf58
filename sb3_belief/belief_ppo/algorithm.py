"""The part of BeliefPPO and MaskableBeliefPPO that they have in common."""

import sys
import warnings
from dataclasses import asdict, fields
from numbers import Real
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import FloatSchedule
from stable_baselines3.common.vec_env import VecEnv

from sb3_belief.belief import n_selected
from sb3_belief.belief.memory import Memory, followed_by, valid_rows
from sb3_belief.belief_ppo.adaptive import REPLAYED_ROWS, AdaptiveExtractor, OnlineMemory, replayed, to_be_replayed
from sb3_belief.belief_ppo.buffers import BeliefBufferMixin, read_others
from sb3_belief.belief_ppo.diagnostics import measure_belief
from sb3_belief.belief_ppo.extractor import fitting_extractor, rollout_rows
from sb3_belief.belief_ppo.memory import holds_images, warn_of_memory
from sb3_belief.belief_ppo.on_policy_details import DetailsAlgorithmMixin
from sb3_belief.belief_ppo.options import EMBEDDING_DIM, LATENT_DIM, BeliefOptions
from sb3_belief.belief_ppo.others import ActionSpaces, action_layout, check_same_others, others_of
from sb3_belief.belief_ppo.others_baseline import take_off
from sb3_belief.belief_ppo.policies import BeliefPolicyMixin
from sb3_belief.common.kept_attributes import kept_attributes
from sb3_belief.common.safe_files.algorithm import SafeFilesMixin


class BeliefAlgorithmMixin(SafeFilesMixin, DetailsAlgorithmMixin):
    """
    Makes an SB3 algorithm of PPO's kind one with a belief.

    It writes each step's data of the belief into the rollout buffer, hands the loss coefficients to the policy, and renews the
    history after each update. The belief's loss joins in the policy (``evaluate_actions``). No method of SB3 is copied.
    """

    #: Name of SB3's algorithm without the belief, for messages
    stock: ClassVar[str]
    #: Base class of the policies, with a belief and without, and the rollout buffers for plain and for Dict observations
    policy_base: ClassVar[type[BeliefPolicyMixin]]
    stock_policy: ClassVar[type[BasePolicy]]
    buffer_classes: ClassVar[tuple[type[BeliefBufferMixin], type[BeliefBufferMixin]]]

    policy: BeliefPolicyMixin
    rollout_buffer: Any  # A BeliefBufferMixin with a DetailsBufferMixin
    others_action_spaces: ActionSpaces
    belief: str
    history_length: int
    keep_ratio: float
    action_loss: str | None
    policy_latent: str
    similarity: str
    detach_belief: bool
    n_own: int
    n_pool: int
    row_features: tuple[str, ...]
    history_dropout: float
    belief_replay: int
    prediction_steps: int
    critic_sees_others: bool
    #: Whether the belief sees features unless policy_kwargs say otherwise. Models saved before it could do not
    belief_from_features: bool
    action_coef: float | Schedule
    kl_coef: float | Schedule

    def _setup_belief(
        self, options: BeliefOptions, action_coef: float | Schedule, kl_coef: float | Schedule, is_new: bool
    ) -> None:
        """Check and store the belief's arguments, between SB3's constructor and `_setup_model`."""
        for name, value in asdict(options).items():
            setattr(self, name, value)
        for name, coefficient in (("action_coef", action_coef), ("kl_coef", kl_coef)):
            if not callable(coefficient) and not isinstance(coefficient, Real):
                raise TypeError(f"{name} is {coefficient!r}; it must be a number of at least 0, or a schedule of such numbers")
            if not callable(coefficient) and coefficient < 0:
                raise ValueError(f"{name} is {coefficient!r}; the weight of a loss must be at least 0")
        self.action_coef = action_coef if callable(action_coef) else float(action_coef)
        self.kl_coef = kl_coef if callable(kl_coef) else float(kl_coef)
        # A saved model that is loaded brings its own value, unless it is from before there was one
        self.belief_from_features = is_new and self.env is not None and holds_images(self.observation_space)
        # An agent without a belief may meet any others
        self.others_action_spaces = {} if self.env is None or options.variant is None else others_of(self.env)

    @property
    def _has_belief(self) -> bool:
        return isinstance(self.policy, self.policy_base) and self.policy.has_belief

    @property
    def _options(self) -> BeliefOptions:
        return BeliefOptions(**{field.name: getattr(self, field.name) for field in fields(BeliefOptions)})

    def _setup_model(self) -> None:
        if self.env is not None:
            self._check_others(self.env)
            if self.belief != "none" and not self.others_action_spaces:
                warnings.warn(
                    f"The environment names no other agents, so there is nothing to hold a belief about: "
                    f"{type(self).__name__} is {self.stock} here. Train a Team, or bring 'others_action_spaces'.",
                    stacklevel=3,
                )
        # Without a belief there is nothing that SB3's own policies lack
        without_belief = self.belief == "none" or not self.others_action_spaces
        if not issubclass(self.policy_class, self.stock_policy if without_belief else self.policy_base):
            raise ValueError(
                f"{type(self).__name__} needs a policy with a belief, not {self.policy_class.__name__}; use 'BeliefPolicy' or "
                f"derive yours from sb3_belief.belief_ppo.{self.policy_base.__name__}"
            )
        with kept_attributes(self, "policy_kwargs", "rollout_buffer_class", "rollout_buffer_kwargs"):
            plain, for_dicts = self.buffer_classes
            if self.rollout_buffer_class is None:
                self.rollout_buffer_class = for_dicts if isinstance(self.observation_space, spaces.Dict) else plain
            elif not issubclass(self.rollout_buffer_class, BeliefBufferMixin):
                raise TypeError(
                    f"rollout_buffer_class is {self.rollout_buffer_class.__name__}, which has no place for what a belief is "
                    f"trained on; derive it from sb3_belief.belief_ppo.{plain.__name__} (or {for_dicts.__name__})"
                )
            self._warn_of_memory()
            if issubclass(self.policy_class, self.policy_base):
                self.policy_kwargs = {
                    "belief_from_features": self.belief_from_features,
                    **self.policy_kwargs,
                    "others_action_spaces": self.others_action_spaces,
                    **asdict(self._options),
                    "value_norm": self.value_norm,
                }
            elif not self._value_options.is_of_sb3:
                raise ValueError(
                    f"value_norm, huber_delta and value_clip need a policy derived from {self.policy_base.__name__}, not"
                    f" {self.policy_class.__name__}"
                )
            self.rollout_buffer_kwargs = {**self.rollout_buffer_kwargs, **self._buffer_widths()}
            super()._setup_model()
        # As SB3 does with its own coefficients that may be schedules
        self.action_coef, self.kl_coef = FloatSchedule(self.action_coef), FloatSchedule(self.kl_coef)

    def _warn_of_memory(self) -> None:
        sees_all = not self.policy_kwargs.get("belief_from_features", self.belief_from_features)
        variant = self._options.variant if self.others_action_spaces else None
        attends = variant is not None and variant.attends
        rows = self.history_length if attends and sees_all else 0
        if rows and variant is not None and variant.online:
            # What is attended to in a rollout that is replayed, at most
            rows += self.belief_replay * min(
                REPLAYED_ROWS * (self.n_own + self.n_pool), self.history_length + self.n_steps * self.n_envs
            )
        width = self.policy_kwargs.get("embedding_dim", EMBEDDING_DIM)
        warn_of_memory(self.observation_space, self.n_steps, self.n_envs, rows, width)

    def _maybe_recommend_cpu(self, mlp_class_name: str = "") -> None:
        # SB3 recognises policies without convolutions by the names of their classes
        extractor = getattr(self.policy_class, "default_extractor", None) or fitting_extractor(self.observation_space)
        super()._maybe_recommend_cpu(self.policy_class.__name__ if extractor is FlattenExtractor else "")

    def _buffer_widths(self) -> dict[str, int]:
        layout, variant = action_layout(self.others_action_spaces), self._options.variant
        if variant is None or layout.n_others == 0:
            return {}
        if variant.online:
            # And the null row
            most_selected = self.n_own + self.n_pool + 1
        else:
            most_selected = n_selected(self.keep_ratio, self.history_length) if variant.attends else 0
        return dict(
            is_online=variant.online,
            n_later=self.prediction_steps - 1 if variant.online else 0,
            shows_at_once=self.critic_sees_others,
            noise_dim=self.policy_kwargs.get("latent_dim", LATENT_DIM) if variant.samples else 0,
            max_selected=most_selected,
            others_width=layout.width,
            n_others=layout.n_others,
        )

    def _check_others(self, env: VecEnv) -> None:
        if self.belief != "none":
            check_same_others(env, self.others_action_spaces)

    def _setup_learn(self, *args: Any, **kwargs: Any) -> Any:
        if getattr(self.policy, "is_kept", False):
            raise ValueError(
                "learn() within observing(): what the agent remembers is put back when the block ends, and would be mixed with"
                " its training until then. Open observing() around the evaluation alone, in a callback's own method."
            )
        return super()._setup_learn(*args, **kwargs)

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        refuse_many_agents(env, type(self).__name__)
        self._check_others(self._wrap_env(env, verbose=0))
        super().set_env(env, force_reset)

    # -- rollout -------------------------------------------------------------------------------------------------------

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: np.ndarray | None = None) -> None:
        super()._update_info_buffer(infos, dones)
        if dones is not None and dones.any() and isinstance(self.policy, self.policy_base):
            self.policy.attach_terminal_values(infos, dones)
        if self._has_belief:
            buffer, layout = self.rollout_buffer, self.policy.layout
            buffer.stage_others(*read_others(infos, layout))
            if not buffer.active[buffer.pos].all():
                buffer.watch(np.asarray(self._last_episode_starts), np.asarray(layout.owners))

    # -- update --------------------------------------------------------------------------------------------------------

    def train(self) -> None:
        """
        Update as SB3 does; each minibatch also trains the belief.

        Afterwards the history becomes the agent's own last steps, those of this rollout included. The next rollout and its
        update look back on it. It never holds the rows being trained on, where attention would find their own labels.
        """
        buffer, policy = self.rollout_buffer, self.policy
        if not self._has_belief or not buffer.active.any():
            super().train()
            return
        extractor = policy.features_extractor
        if isinstance(extractor, AdaptiveExtractor):
            extractor.table = followed_by(valid_rows(extractor.history), self.remembered(0, buffer.buffer_size))
            extractor.replay = [replayed(kept, policy.device) for kept in buffer.replay]
        else:
            observations, actions = buffer.recent(self.history_length)
        for name, value in measure_belief(policy, buffer).items():
            self.logger.record(f"belief/{name}", value)
        policy.action_coef, policy.kl_coef = self._coefficient("action_coef"), self._coefficient("kl_coef")
        if policy.others_baseline is not None:
            self.logger.record("belief/advantage_variance", take_off(policy.others_baseline, policy, buffer))
            policy.baseline_coef, self.rollout_buffer.shows_targets = self.vf_coef, True
        super().train()
        self.rollout_buffer.shows_targets = False
        if isinstance(extractor, AdaptiveExtractor):
            if self.belief_replay:
                # Drawn as SB3 draws minibatches
                rows = buffer.rows_of(np.random.permutation(buffer.active_steps())[:REPLAYED_ROWS])
                part = (
                    policy.flat_observations(rollout_rows(buffer.observations, rows, policy.device)),
                    buffer.belief_minibatch(rows),
                )
                buffer.replay = [*buffer.replay, to_be_replayed(extractor.attended(), *part)][-self.belief_replay :]
            extractor.table, extractor.replay = None, []
            extractor.append(self.remembered(0, buffer.buffer_size), extractor.clock)
        else:
            policy.remember(observations, actions)

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> bool:
        """
        Collect a rollout as SB3 does; a belief that is online also attends to its earlier steps.

        :param args: As in SB3 or sb3-contrib
        :param kwargs: As in SB3 or sb3-contrib
        :return: As in SB3
        """
        extractor = self.policy.features_extractor if self._has_belief else None
        if not isinstance(extractor, AdaptiveExtractor):
            return super().collect_rollouts(*args, **kwargs)
        self.rollout_buffer.reset()
        extractor.online = OnlineMemory(self)
        try:
            return super().collect_rollouts(*args, **kwargs)
        finally:
            extractor.online = None
            # Also if there will be no update, since the agent was out of play all the time, or is stopped here
            extractor.pass_time(self.rollout_buffer.pos)

    @th.no_grad()
    def remembered(self, first: int, last: int) -> Memory:
        """
        Return steps of the present rollout as an adaptive belief remembers them: those in which the agent acted or waited for
        its turn, and saw another one act. What it observes while it waits is that of its last turn, since what an environment
        shows of a step out of play may be anything.

        :param first: Number of the first step in the rollout
        :param last: Number of the step after the last one
        :return: ``(last - first) * n_envs`` rows, those of all copies at each step
        """
        # Not the policy's device, which SB3 looks for among all its weights each time
        buffer, policy, device = self.rollout_buffer, self.policy, self.device
        steps = np.arange(first * self.n_envs, last * self.n_envs)
        rows = buffer.rows_of(steps)
        waited = buffer.waited[rows].reshape(-1)
        turns = np.where(waited > 0, (waited - 1) * self.n_envs + steps % self.n_envs, steps)
        flat = policy.flat_observations(rollout_rows(buffer.observations, buffer.rows_of(turns), device))
        actions, active = buffer.actions[rows].reshape(len(flat), *(self.action_space.shape or ())), buffer.active[rows]
        if isinstance(self.action_space, spaces.Box):
            # As the environment got them
            actions = policy.unscale_action(actions) if policy.squash_output else actions
            actions = np.clip(actions, self.action_space.low, self.action_space.high)
        own = policy.own_rows(actions, buffer.own_rewards[rows].reshape(-1), len(flat))
        # Whoever waits does nothing
        own[~active, :-1] = 0.0
        valid = (active | (buffer.waited[rows] > 0)) & buffer.attended_visible[rows].any(axis=1)
        parts = buffer.attended_actions[rows], own, buffer.stamps[rows], valid
        return Memory(flat, *(th.as_tensor(part, device=device) for part in parts))

    def _coefficient(self, name: str) -> float:
        """Return and log the present value of a loss coefficient, which may be a schedule."""
        value = getattr(self, name)(self._current_progress_remaining)
        if value < 0:
            raise ValueError(
                f"the schedule {name} gives {value!r} with {self._current_progress_remaining:.3f} of the training left; the "
                "weight of a loss must be at least 0"
            )
        self.logger.record(f"train/{name}", value)
        return value


def refuse_many_agents(env: Any, algorithm: str) -> None:
    """
    Refuse an environment of many agents for an algorithm that trains one.

    :param env: What the user gave
    :param algorithm: Name of the algorithm
    :raises TypeError: If it is an environment of many agents
    """
    # Not imported here, because a deployed agent does without it: as long as nobody has imported it, nothing is of its classes
    pettingzoo: Any = sys.modules.get("pettingzoo")
    is_pettingzoo = pettingzoo is not None and isinstance(env, (pettingzoo.ParallelEnv, pettingzoo.AECEnv))
    if is_pettingzoo or (isinstance(env, VecEnv) and hasattr(env, "possible_agents")):
        raise TypeError(
            f"{algorithm} trains one agent, but {type(env).__name__} is an environment of many. To train one model per agent "
            f'use Team({algorithm}, "BeliefPolicy", make_team_env(...)). To train one learner among fixed partners use '
            "sb3_belief.AgentEnv."
        )
