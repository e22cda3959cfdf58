"""Proximal Policy Optimization conditioned on a dynamic belief about the other agents."""

import warnings
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from pettingzoo import AECEnv, ParallelEnv
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import explained_variance, obs_as_tensor
from stable_baselines3.common.vec_env import VecEnv

from sb3_belief.belief import n_kept
from sb3_belief.belief_ppo.buffers import BeliefBufferMixin, BeliefDictRolloutBuffer, BeliefMinibatch, BeliefRolloutBuffer
from sb3_belief.belief_ppo.diagnostics import measure_belief
from sb3_belief.belief_ppo.others import ActionSpaces, action_layout, others_of, read_others
from sb3_belief.belief_ppo.policies import LATENT_DIM, BeliefActorCriticPolicy, BeliefPolicyMixin, check_belief

if TYPE_CHECKING:
    _Algorithm = PPO
else:
    _Algorithm = object


class BeliefAlgorithmMixin(_Algorithm):
    """
    What makes an SB3 PPO one with a belief: it stages each step's part of the belief, sees to it that the belief's loss
    joins each minibatch, and renews the history after each update. No method of SB3's is copied.
    """

    policy: BeliefPolicyMixin
    rollout_buffer: BeliefBufferMixin
    others_action_spaces: ActionSpaces

    def _setup_belief(
        self,
        belief: str,
        history_length: int,
        keep_ratio: float,
        action_coef: float,
        kl_coef: float,
        detach_belief: bool,
    ) -> None:
        """Store the belief's arguments; called by the constructor between SB3's and `_setup_model`."""
        check_belief(belief, history_length, keep_ratio)
        for name, value in (("action_coef", action_coef), ("kl_coef", kl_coef)):
            if value < 0:
                raise ValueError(f"{name} is {value!r}; the weight of a loss must be at least 0")
        self.belief = belief
        self.history_length = history_length
        self.keep_ratio = keep_ratio
        self.action_coef = action_coef
        self.kl_coef = kl_coef
        self.detach_belief = detach_belief
        # Whoever holds no belief about the others may meet any
        self.others_action_spaces = {} if self.env is None or belief == "none" else others_of(self.env)

    def _setup_model(self) -> None:
        if self.env is not None:
            self._check_others(self.env)
            if self.belief != "none" and not self.others_action_spaces:
                warnings.warn(
                    f"The environment names no other agents, so there is nothing to hold a belief about: "
                    f"{type(self).__name__} is {PPO.__name__} here. Train a Team, or bring 'others_action_spaces'.",
                    stacklevel=3,
                )
        if not issubclass(self.policy_class, BeliefPolicyMixin):
            raise TypeError(
                f"{type(self).__name__} needs a policy with a belief, not {self.policy_class.__name__}; use 'BeliefPolicy' or "
                "derive yours from sb3_belief.BeliefActorCriticPolicy"
            )
        user_kwargs = self.policy_kwargs, self.rollout_buffer_class, self.rollout_buffer_kwargs
        if self.rollout_buffer_class is None:
            is_dict = isinstance(self.observation_space, spaces.Dict)
            self.rollout_buffer_class = BeliefDictRolloutBuffer if is_dict else BeliefRolloutBuffer
        elif not issubclass(self.rollout_buffer_class, BeliefBufferMixin):
            raise TypeError(
                f"rollout_buffer_class is {self.rollout_buffer_class.__name__}, which has no place for what a belief is "
                "trained on; derive it from sb3_belief.belief_ppo.BeliefRolloutBuffer (or BeliefDictRolloutBuffer)"
            )
        self.policy_kwargs = {
            **self.policy_kwargs,
            "others_action_spaces": self.others_action_spaces,
            "belief": self.belief,
            "history_length": self.history_length,
            "keep_ratio": self.keep_ratio,
            "detach_belief": self.detach_belief,
        }
        self.rollout_buffer_kwargs = {**self.rollout_buffer_kwargs, **self._buffer_widths()}
        try:
            super()._setup_model()
        finally:
            # What is saved, and compared on load, is what the user gave
            self.policy_kwargs, self.rollout_buffer_class, self.rollout_buffer_kwargs = user_kwargs

    def _buffer_widths(self) -> dict[str, int]:
        layout = action_layout(self.others_action_spaces)
        if self.belief == "none" or layout.n_others == 0:
            return {}
        return dict(
            latent_dim=self.policy_kwargs.get("latent_dim", LATENT_DIM),
            history_kept=n_kept(self.keep_ratio, self.history_length),
            others_width=layout.width,
            n_others=layout.n_others,
        )

    def _check_others(self, env: VecEnv) -> None:
        if self.belief == "none":
            return
        found = others_of(env)
        if found != self.others_action_spaces:
            raise ValueError(
                f"the others of this environment are {found}, but the model has been made for {self.others_action_spaces}; "
                "a belief is about these others with these action spaces, in this order"
            )

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        refuse_many_agents(env, type(self).__name__)
        self._check_others(self._wrap_env(env, verbose=0))
        super().set_env(env, force_reset)

    # -- rollout -------------------------------------------------------------------------------------------------------

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: np.ndarray | None = None) -> None:
        # SB3 calls this once a step, right before it adds the step to the buffer: the place to stage the rest of the row
        super()._update_info_buffer(infos, dones)
        active = np.array([info.get("active", True) for info in infos], dtype=bool)
        if not self.policy.has_belief:
            self.rollout_buffer.stage(active)
            return
        actions, visible = read_others(infos, self.policy.layout)
        minibatch = BeliefMinibatch(*self.policy.acted_with(), th.as_tensor(actions), th.as_tensor(visible))
        self.rollout_buffer.stage(active, minibatch)

    # -- update --------------------------------------------------------------------------------------------------------

    def train(self) -> None:
        """
        SB3's update, in which each minibatch also trains the belief. Thereafter the history becomes the agent's own last
        steps: this rollout's, which the next rollout and its update look back on, never the one being trained on.
        """
        buffer, policy = self.rollout_buffer, self.policy
        if not buffer.active.any():
            self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
            return
        if not policy.has_belief:
            self._update()
            return
        observations, actions = buffer.recent(self.history_length)
        for name, value in measure_belief(policy, buffer).items():
            self.logger.record(f"belief/{name}", value)
        policy.action_coef, policy.kl_coef = self.action_coef, self.kl_coef
        buffer.on_minibatch = policy.stage
        try:
            self._update()
        finally:
            buffer.on_minibatch = None
            policy.stage(None)
        policy.remember(obs_as_tensor(observations, self.device), th.as_tensor(actions, device=self.device))

    def _update(self) -> None:
        super().train()
        # SB3 computes this over all steps, also those in which the agent was not in play and no value is trained
        active, values, returns = (getattr(self.rollout_buffer, name).flatten() for name in ("active", "values", "returns"))
        self.logger.record("train/explained_variance", explained_variance(values[active], returns[active]))


class BeliefPPO(BeliefAlgorithmMixin, PPO):
    """
    Belief PPO (*Dynamic Belief for Decentralized Multi-Agent Cooperative Learning*, IJCAI 2023).

    PPO for one agent among others: policy and value are conditioned on a belief about what the others will do, inferred from
    the agent's own history and trained by predicting the actions of those it sees. It takes all of PPO's arguments, and of
    the environment only `others_action_spaces` and, in `info`, `others_actions` and `others_visible`, as a
    :class:`~sb3_belief.team.Team` provides them. Without others it is PPO.

    Two more keys of `info` matter: steps with ``active=False`` are left out of loss, advantage statistics and history.

    :param policy: ``"BeliefPolicy"``, or a class derived from :class:`~sb3_belief.BeliefActorCriticPolicy`
    :param env: The environment of this one agent
    :param learning_rate: As in PPO
    :param n_steps: As in PPO
    :param batch_size: As in PPO; inactive steps are left out of a minibatch after it is drawn
    :param n_epochs: As in PPO
    :param gamma: As in PPO
    :param gae_lambda: As in PPO
    :param clip_range: As in PPO
    :param clip_range_vf: As in PPO
    :param normalize_advantage: As in PPO
    :param ent_coef: As in PPO
    :param vf_coef: As in PPO
    :param max_grad_norm: As in PPO; the belief's gradient is clipped together with the rest
    :param use_sde: As in PPO
    :param sde_sample_freq: As in PPO
    :param rollout_buffer_class: A class derived from :class:`~sb3_belief.belief_ppo.BeliefRolloutBuffer`
    :param rollout_buffer_kwargs: As in PPO
    :param target_kl: As in PPO
    :param stats_window_size: As in PPO
    :param tensorboard_log: As in PPO
    :param policy_kwargs: As in PPO, and ``embedding_dim``, ``latent_dim``, ``fusion_activation_fn`` of
        :class:`~sb3_belief.belief_ppo.policies.BeliefPolicyMixin`
    :param verbose: As in PPO
    :param seed: As in PPO
    :param device: As in PPO
    :param _init_setup_model: As in PPO
    :param belief: ``"dynamic"`` (the paper's method) or ``"none"`` (independent PPO)
    :param history_length: ``T_h``, how many of its own active steps the agent remembers, at least 1 (Sec. 5: 800)
    :param keep_ratio: ``p``, the share of them it attends to, in (0, 1] (Sec. 5: 0.05)
    :param action_coef: ``alpha``, weight of the error of the predicted actions (eq. 8: 0.5)
    :param kl_coef: ``beta``, weight of the KL divergence (eq. 8: 0.005)
    :param detach_belief: Whether to keep the gradient of policy and value out of the belief network
    :raises TypeError: for an environment of many agents, with the ways to train on it
    :raises ValueError: for an argument without meaning, with what is allowed
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "BeliefPolicy": BeliefActorCriticPolicy,
    }

    def __init__(
        self,
        policy: str | type[BeliefActorCriticPolicy],
        env: GymEnv | str | None,
        learning_rate: float | Schedule = 3e-4,
        n_steps: int = 2048,
        batch_size: int = 64,
        n_epochs: int = 10,
        gamma: float = 0.99,
        gae_lambda: float = 0.95,
        clip_range: float | Schedule = 0.2,
        clip_range_vf: float | Schedule | None = None,
        normalize_advantage: bool = True,
        ent_coef: float = 0.0,
        vf_coef: float = 0.5,
        max_grad_norm: float = 0.5,
        use_sde: bool = False,
        sde_sample_freq: int = -1,
        rollout_buffer_class: type[RolloutBuffer] | None = None,
        rollout_buffer_kwargs: dict[str, Any] | None = None,
        target_kl: float | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
        belief: str = "dynamic",
        history_length: int = 800,
        keep_ratio: float = 0.05,
        action_coef: float = 0.5,
        kl_coef: float = 0.005,
        detach_belief: bool = False,
    ) -> None:
        refuse_many_agents(env, type(self).__name__)
        super().__init__(
            policy,
            env,  # type: ignore[arg-type]
            learning_rate=learning_rate,
            n_steps=n_steps,
            batch_size=batch_size,
            n_epochs=n_epochs,
            gamma=gamma,
            gae_lambda=gae_lambda,
            clip_range=clip_range,
            clip_range_vf=clip_range_vf,
            normalize_advantage=normalize_advantage,
            ent_coef=ent_coef,
            vf_coef=vf_coef,
            max_grad_norm=max_grad_norm,
            use_sde=use_sde,
            sde_sample_freq=sde_sample_freq,
            rollout_buffer_class=rollout_buffer_class,
            rollout_buffer_kwargs=rollout_buffer_kwargs,
            target_kl=target_kl,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=False,
        )
        self._setup_belief(belief, history_length, keep_ratio, action_coef, kl_coef, detach_belief)
        if _init_setup_model:
            self._setup_model()

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "BeliefPPO",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> "BeliefPPO":
        """As PPO's ``learn``."""
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)


def refuse_many_agents(env: Any, algorithm: str) -> None:
    """
    :param env: What a user gave as the environment of one agent
    :param algorithm: Name of the algorithm it was given to
    :raises TypeError: if it is an environment of many agents
    """
    is_pettingzoo = isinstance(env, (ParallelEnv, AECEnv))
    if is_pettingzoo or (isinstance(env, VecEnv) and hasattr(env, "possible_agents")):
        raise TypeError(
            f"{algorithm} trains one agent, but {type(env).__name__} is an environment of many. To train one model per agent "
            f'use Team({algorithm}, "BeliefPolicy", make_team_env(...)). To train one learner among fixed partners, wrap it '
            "in a gymnasium.Env that plays the partners' part and shows the learner its own observation, with "
            "'others_action_spaces', and 'others_actions' and 'others_visible' in info."
        )
