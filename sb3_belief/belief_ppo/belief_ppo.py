"""Proximal Policy Optimization conditioned on a dynamic belief about the other agents."""

from collections.abc import Sequence
from typing import Any, ClassVar

import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule

from sb3_belief.belief import ROW_FEATURES
from sb3_belief.belief_ppo.algorithm import BeliefAlgorithmMixin, refuse_many_agents
from sb3_belief.belief_ppo.buffers import BeliefDictRolloutBuffer, BeliefRolloutBuffer
from sb3_belief.belief_ppo.options import BeliefOptions
from sb3_belief.belief_ppo.policies import (
    BeliefActorCriticPolicy,
    BeliefCnnPolicy,
    BeliefMlpPolicy,
    BeliefMultiInputPolicy,
)
from sb3_belief.belief_ppo.value_loss import ValueOptions


class BeliefPPO(BeliefAlgorithmMixin, PPO):
    """
    Belief PPO (*Dynamic Belief for Decentralized Multi-Agent Cooperative Learning*, IJCAI 2023).

    PPO for one agent among others. Policy and value are conditioned on a belief about what the others will do, which is
    inferred from the agent's own history and trained by predicting the actions of the others that it sees. It takes all of
    PPO's arguments. Of the environment it needs the attribute ``others_action_spaces`` and, in ``info``, ``others_actions``
    and ``others_visible``, as a :class:`~sb3_belief.team.Team` provides them. Without others it is PPO.

    Steps with ``active=False`` in ``info`` are left out of loss, advantage statistics and history.

    :param policy: ``"BeliefPolicy"``, whose features extractor fits the observation space, one of SB3's names ``"MlpPolicy"``,
        ``"CnnPolicy"``, ``"MultiInputPolicy"``, or a class derived from :class:`~sb3_belief.BeliefActorCriticPolicy`;
        without a belief also one of SB3's own
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
    :param policy_kwargs: As in PPO, and ``embedding_dim``, ``latent_dim``, ``fusion_activation_fn``, ``belief_from_features``
        (by default True for images) of :class:`~sb3_belief.belief_ppo.policies.BeliefPolicyMixin`, and ``obs_layer_norm``,
        ``action_gain`` of :class:`~sb3_belief.belief_ppo.on_policy_details.DetailsPolicyMixin`
    :param verbose: As in PPO
    :param seed: As in PPO
    :param device: As in PPO
    :param _init_setup_model: As in PPO
    :param belief: ``"dynamic"`` (the paper's method), ``"none"`` (independent PPO), or an ablation (Table 2): ``"context"``
        with the history but without the latent's distribution, ``"variational"`` with the distribution but without the
        history, ``"static"`` with neither, ``"wide"`` with as many weights as ``"dynamic"``, but neither, and no prediction;
        or ``"adaptive"``, ours, which also attends to the rollout under way (docs/adaptive_belief.md)
    :param history_length: ``T_h``, how many of its own active steps the agent remembers, at least 1 (Sec. 5: 800)
    :param keep_ratio: ``p``, the share of them it attends to, in (0, 1] (Sec. 5: 0.05); at least one row is kept
    :param action_coef: ``alpha``, weight of the error of the predicted actions (eq. 8: 0.5), at least 0; may be a schedule of
        the progress remaining (from 1 to 0)
    :param kl_coef: ``beta``, weight of the KL divergence (eq. 8: 0.005), at least 0; may be a schedule
    :param action_loss: Error of the predicted actions: ``"mse"`` (eq. 7) or ``"cross_entropy"``, for others whose actions are
        Discrete, MultiDiscrete or MultiBinary; None for eq. 7, and of ``"adaptive"`` for the cross-entropy where that can be
    :param policy_latent: What policy and value are given of the belief: its ``"sample"`` (Sec. 4.2) or its ``"mean"``, while
        the prediction keeps the sample. No difference for a belief that is a single point
    :param similarity: What past steps are compared with the present by: the ``"embedding"`` (eq. 3) or the ``"observation"``
        itself (Fig. 5b)
    :param detach_belief: Whether to keep the gradient of policy and value out of the belief network
    :param n_own: Of ``"adaptive"``: most steps of the same copy of the environment that it attends to, at least 0
    :param n_pool: Of ``"adaptive"``: most steps of the other copies that it attends to, at least 0
    :param row_features: Of ``"adaptive"``: what a step in its memory tells beside the agent's observation and what it saw the
        others do, of ``"own_action"``, ``"reward"``, ``"age"``, ``"episode"`` (whether it is of the same one) and ``"copy"``
    :param history_dropout: Of ``"adaptive"``: share of the steps in training at which it sees nothing of its memory, in [0, 1)
    :param belief_replay: Of ``"adaptive"``: on how many past rollouts its predictions are trained as well, at least 0, so that
        its weights do not learn the present teammates by heart. As many tables of memory and rollout are kept
    :param prediction_steps: Of ``"adaptive"``: of how many steps it predicts the others' actions, at least 1: of the present
        one, which is what policy and value are given, and of those after it, up to the end of its return
    :param critic_sees_others: Of ``"adaptive"``: whether advantages are measured against a baseline that also sees what the
        others did in the same step (:class:`~sb3_belief.belief_ppo.others_baseline.OthersBaseline`), with ``vf_coef`` as the
        weight of its loss. Not where whom the agent sees after a step depends on its own action in it: that would be a bias
    :param value_norm: Whether the value is predicted in units of the returns' running mean and deviation, as in MAPPO
        (:class:`~sb3_belief.belief_ppo.value_loss.NormalizedValue`)
    :param huber_delta: Where the loss of the values turns from quadratic to linear (MAPPO: 10), above 0, in deviations with
        ``value_norm``; None for SB3's squared error. It is half as large as that where it is quadratic
    :param value_clip: How far a value may move from what it was while acting until only moving back lowers its loss (MAPPO:
        0.2), above 0, in deviations with ``value_norm``; None for any distance
    :param active_masks: Whether steps with ``active=False`` are left out; False trains on them as SB3 does
    :raises TypeError: For an environment of many agents, with the ways to train on it
    :raises ValueError: For an argument that makes no sense, with what is allowed
    """

    stock = "PPO"
    policy_base = BeliefActorCriticPolicy
    stock_policy = ActorCriticPolicy
    buffer_classes = (BeliefRolloutBuffer, BeliefDictRolloutBuffer)
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "BeliefPolicy": BeliefActorCriticPolicy,
        "MlpPolicy": BeliefMlpPolicy,
        "CnnPolicy": BeliefCnnPolicy,
        "MultiInputPolicy": BeliefMultiInputPolicy,
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
        action_coef: float | Schedule = 0.5,
        kl_coef: float | Schedule = 0.005,
        action_loss: str | None = None,
        policy_latent: str = "sample",
        similarity: str = "embedding",
        detach_belief: bool = False,
        n_own: int = 32,
        n_pool: int = 32,
        row_features: Sequence[str] = ROW_FEATURES,
        history_dropout: float = 0.0,
        belief_replay: int = 16,
        prediction_steps: int = 1,
        critic_sees_others: bool = False,
        value_norm: bool = False,
        huber_delta: float | None = None,
        value_clip: float | None = None,
        active_masks: bool = True,
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
        options = BeliefOptions(
            belief=belief,
            history_length=history_length,
            keep_ratio=keep_ratio,
            action_loss=action_loss,
            policy_latent=policy_latent,
            similarity=similarity,
            detach_belief=detach_belief,
            n_own=n_own,
            n_pool=n_pool,
            row_features=row_features,
            history_dropout=history_dropout,
            belief_replay=belief_replay,
            prediction_steps=prediction_steps,
            critic_sees_others=critic_sees_others,
        )
        self._setup_details(ValueOptions(value_norm, huber_delta, value_clip), active_masks)
        self._setup_belief(options, action_coef, kl_coef, is_new=_init_setup_model)
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
        """Learn as PPO does. The arguments are those of PPO's ``learn``."""
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
