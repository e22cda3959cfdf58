"""Belief PPO with invalid action masking."""

from collections.abc import Sequence
from typing import Any, ClassVar

import torch as th
from sb3_contrib import MaskablePPO
from sb3_contrib.common.maskable.buffers import MaskableDictRolloutBuffer, MaskableRolloutBuffer
from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor, NatureCNN
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule

from sb3_belief.belief import ROW_FEATURES
from sb3_belief.belief_ppo.algorithm import BeliefAlgorithmMixin, refuse_many_agents
from sb3_belief.belief_ppo.buffers import BeliefBufferMixin, DetailsBufferMixin
from sb3_belief.belief_ppo.on_policy_details import DetailsPolicyMixin
from sb3_belief.belief_ppo.options import BeliefOptions
from sb3_belief.belief_ppo.policies import BeliefPolicyMixin
from sb3_belief.belief_ppo.value_loss import ValueOptions


class MaskableBeliefRolloutBuffer(DetailsBufferMixin, BeliefBufferMixin, MaskableRolloutBuffer):
    """sb3-contrib's rollout buffer with the belief's data of each step, see :class:`BeliefBufferMixin`."""


class MaskableBeliefDictRolloutBuffer(DetailsBufferMixin, BeliefBufferMixin, MaskableDictRolloutBuffer):
    """sb3-contrib's rollout buffer for Dict observations with the belief's data of each step."""


# For a type checker the mixins derive from SB3's own classes, from which sb3-contrib's differ in some attributes
class MaskableBeliefActorCriticPolicy(DetailsPolicyMixin, BeliefPolicyMixin, MaskableActorCriticPolicy):  # type: ignore[misc]
    """
    sb3-contrib's ``MaskableActorCriticPolicy`` with a belief; takes all of its arguments and those of
    :class:`BeliefPolicyMixin`. Its features extractor is the one that fits the observation space.
    """


class MaskableBeliefMlpPolicy(MaskableBeliefActorCriticPolicy):
    """A masked policy with a belief for vectors; images are flattened."""

    default_extractor = FlattenExtractor


class MaskableBeliefCnnPolicy(MaskableBeliefActorCriticPolicy):
    """A masked policy with a belief for images."""

    default_extractor = NatureCNN


class MaskableBeliefMultiInputPolicy(MaskableBeliefActorCriticPolicy):
    """A masked policy with a belief for Dict observations."""

    default_extractor = CombinedExtractor


class MaskableBeliefPPO(BeliefAlgorithmMixin, MaskablePPO):  # type: ignore[misc]
    """
    Belief PPO with invalid action masking.

    This is :class:`~sb3_belief.BeliefPPO` on sb3-contrib's ``MaskablePPO``, all of whose arguments it takes. The masks come
    from the environment's ``action_masks()``; in a Team these are the masks that its environment puts into
    ``infos[agent]["action_mask"]``. They hold in rollout and update alike. Box actions cannot be masked.

    :param policy: ``"BeliefPolicy"``, whose features extractor fits the observation space, one of SB3's names ``"MlpPolicy"``,
        ``"CnnPolicy"``, ``"MultiInputPolicy"``, or a class derived from :class:`MaskableBeliefActorCriticPolicy`
    :param env: The environment of this one agent
    :param learning_rate: As in MaskablePPO
    :param n_steps: As in MaskablePPO
    :param batch_size: As in MaskablePPO; inactive steps are left out of a minibatch after it is drawn
    :param n_epochs: As in MaskablePPO
    :param gamma: As in MaskablePPO
    :param gae_lambda: As in MaskablePPO
    :param clip_range: As in MaskablePPO
    :param clip_range_vf: As in MaskablePPO
    :param normalize_advantage: As in MaskablePPO
    :param ent_coef: As in MaskablePPO
    :param vf_coef: As in MaskablePPO
    :param max_grad_norm: As in MaskablePPO; the belief's gradient is clipped together with the rest
    :param rollout_buffer_class: A class derived from :class:`MaskableBeliefRolloutBuffer`
    :param rollout_buffer_kwargs: As in MaskablePPO
    :param target_kl: As in MaskablePPO
    :param stats_window_size: As in MaskablePPO
    :param tensorboard_log: As in MaskablePPO
    :param policy_kwargs: As in MaskablePPO, and ``embedding_dim``, ``latent_dim``, ``fusion_activation_fn`` of
        :class:`~sb3_belief.belief_ppo.policies.BeliefPolicyMixin`
    :param verbose: As in MaskablePPO
    :param seed: As in MaskablePPO
    :param device: As in MaskablePPO
    :param _init_setup_model: As in MaskablePPO
    :param belief: As in BeliefPPO
    :param history_length: As in BeliefPPO
    :param keep_ratio: As in BeliefPPO
    :param action_coef: As in BeliefPPO
    :param kl_coef: As in BeliefPPO
    :param action_loss: As in BeliefPPO
    :param policy_latent: As in BeliefPPO
    :param similarity: As in BeliefPPO
    :param detach_belief: As in BeliefPPO
    :param n_own: As in BeliefPPO
    :param n_pool: As in BeliefPPO
    :param row_features: As in BeliefPPO
    :param history_dropout: As in BeliefPPO
    :param belief_replay: As in BeliefPPO
    :param prediction_steps: As in BeliefPPO
    :param critic_sees_others: As in BeliefPPO
    :param value_norm: As in BeliefPPO
    :param huber_delta: As in BeliefPPO
    :param value_clip: As in BeliefPPO
    :param active_masks: As in BeliefPPO
    :raises TypeError: For an environment of many agents, with the ways to train on it
    :raises ValueError: For an argument that makes no sense, with what is allowed
    """

    stock = "MaskablePPO"
    policy_base = MaskableBeliefActorCriticPolicy
    stock_policy = MaskableActorCriticPolicy
    buffer_classes = (MaskableBeliefRolloutBuffer, MaskableBeliefDictRolloutBuffer)
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "BeliefPolicy": MaskableBeliefActorCriticPolicy,
        "MlpPolicy": MaskableBeliefMlpPolicy,
        "CnnPolicy": MaskableBeliefCnnPolicy,
        "MultiInputPolicy": MaskableBeliefMultiInputPolicy,
    }

    def __init__(
        self,
        policy: str | type[MaskableBeliefActorCriticPolicy],
        env: GymEnv | str | None,
        learning_rate: float | Schedule = 3e-4,
        n_steps: int = 2048,
        batch_size: int | None = 64,
        n_epochs: int = 10,
        gamma: float = 0.99,
        gae_lambda: float = 0.95,
        clip_range: float | Schedule = 0.2,
        clip_range_vf: float | Schedule | None = None,
        normalize_advantage: bool = True,
        ent_coef: float = 0.0,
        vf_coef: float = 0.5,
        max_grad_norm: float = 0.5,
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

    def learn(  # type: ignore[override]
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "MaskableBeliefPPO",
        reset_num_timesteps: bool = True,
        use_masking: bool = True,
        progress_bar: bool = False,
    ) -> "MaskableBeliefPPO":
        """Learn as MaskablePPO does. The arguments are those of MaskablePPO's ``learn``."""
        return super().learn(
            total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, use_masking, progress_bar
        )
