"""
Details of PPO that its results in SMAC depend on (Yu et al. 2022, arXiv:2103.01955), each off unless it is asked for.

The loss of the values joins SB3's as the belief's does (:func:`~sb3_belief.belief_ppo.added_loss.add_loss`), while SB3's own
has the weight 0 for the time of the update; what it needs travels with the observations of a minibatch.
"""

from dataclasses import asdict
from numbers import Real
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import MlpExtractor
from stable_baselines3.common.type_aliases import Schedule
from torch import nn

from sb3_belief.belief_ppo.active_steps import ActiveStepsAlgorithmMixin
from sb3_belief.belief_ppo.added_loss import add_loss
from sb3_belief.belief_ppo.value_loss import NormalizedValue, ValueOptions, value_loss

if TYPE_CHECKING:
    _Policy = ActorCriticPolicy
else:
    _Policy = object

#: SB3's own gain of the layer that gives the actions
ACTION_GAIN = 0.01


class DetailsPolicyMixin(_Policy):
    """
    Adds details to an actor-critic policy.

    :param args: As in the policy
    :param value_norm: Whether values are predicted in units of the returns' mean and deviation (:class:`NormalizedValue`)
    :param obs_layer_norm: Whether actor and critic each begin with a layer norm of the observation's features
    :param action_gain: Gain with which the layer that gives the actions is initialised, above 0
    :param kwargs: As in the policy
    :raises ValueError: For an option that makes no sense, or has no place in these networks
    """

    #: How the values are trained, while the algorithm trains on its own terms; None for SB3's loss
    value_options: ValueOptions | None = None
    #: Weight of their loss, and what it has been in the minibatches of this update
    value_coef: float = 0.0
    value_losses: list[float]
    #: Mean and deviation of the returns while the rollout was played, the unit of its values
    acted_in: tuple[th.Tensor, th.Tensor] | None = None
    value_norm: bool
    obs_layer_norm: bool
    action_gain: float

    def __init__(
        self,
        *args: Any,
        value_norm: bool = False,
        obs_layer_norm: bool = False,
        action_gain: float = ACTION_GAIN,
        **kwargs: Any,
    ) -> None:
        # Before SB3's constructor, which builds the networks
        if not isinstance(obs_layer_norm, bool):
            raise ValueError(f"obs_layer_norm is {obs_layer_norm!r}; it must be True or False")
        if not isinstance(action_gain, Real) or isinstance(action_gain, bool) or not action_gain > 0:
            raise ValueError(f"action_gain is {action_gain!r}; it must be a number above 0 (SB3: {ACTION_GAIN})")
        if action_gain != ACTION_GAIN and not kwargs.get("ortho_init", True):
            raise ValueError("action_gain is that of the orthogonal initialisation, which ortho_init=False leaves out")
        self.value_norm, self.obs_layer_norm, self.action_gain = value_norm, obs_layer_norm, action_gain
        self.value_losses = []
        super().__init__(*args, **kwargs)

    def _build_mlp_extractor(self) -> None:
        super()._build_mlp_extractor()
        self._add_layer_norms()

    def _add_layer_norms(self) -> None:
        # Those of a belief's fusion are within
        networks: Any = getattr(self.mlp_extractor, "base", self.mlp_extractor)
        if self.obs_layer_norm and isinstance(networks, MlpExtractor):
            width = getattr(self.features_extractor, "features", self.features_extractor).features_dim
            # An actor may be given the first of them only
            own_width = getattr(networks, "own_dim", width)
            if own_width == 1:
                raise ValueError("obs_layer_norm=True would make an observation of one number zero: leave it False")
            networks.policy_net = nn.Sequential(nn.LayerNorm(own_width, device=self.device), *networks.policy_net)
            networks.value_net = nn.Sequential(nn.LayerNorm(width, device=self.device), *networks.value_net)

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        if self.obs_layer_norm and not any(isinstance(module, nn.LayerNorm) for module in self.mlp_extractor.modules()):
            raise ValueError(
                "obs_layer_norm=True puts a layer norm before SB3's networks, but the policy has a"
                f" {type(self.mlp_extractor).__name__} of its own: normalise there."
            )
        if self.value_norm:
            # The optimizer has the weights of the head already
            self.value_net = NormalizedValue(self.value_net)  # type: ignore[assignment]

    def init_weights(self, module: nn.Module, gain: float = 1) -> None:  # type: ignore[override]
        """
        Initialise a layer as the policy does, that of the actions with its own gain.

        :param module: A layer
        :param gain: As in SB3
        """
        super().init_weights(module, self.action_gain if module is getattr(self, "action_net", None) else gain)

    @property
    def value_unit(self) -> th.Tensor | float:
        """In which errors of values count: the deviation of the returns where values are normalised, else 1."""
        return self.value_net.statistics()[1] if isinstance(self.value_net, NormalizedValue) else 1.0

    def evaluate_actions(self, obs: Any, actions: th.Tensor, *args: Any, **kwargs: Any) -> Any:
        """
        Evaluate actions as the policy does; the loss of the values joins where the algorithm does not train them as SB3.

        :param obs: Observations
        :param actions: As in SB3
        :param args: As in SB3 or sb3-contrib
        :param kwargs: As in SB3 or sb3-contrib
        :return: Values, log likelihood and entropy of the actions
        """
        values, log_prob, entropy = super().evaluate_actions(obs, actions, *args, **kwargs)
        targets = getattr(obs, "value_targets", None)
        if targets is None or self.value_options is None:
            return values, log_prob, entropy
        std: Any = 1.0
        if isinstance(self.value_net, NormalizedValue):
            assert self.acted_in is not None
            (was_mean, was_std), (mean, std) = self.acted_in, self.value_net.statistics()
            # What may not move far is the head's prediction, whatever its unit has become since
            targets = targets._replace(old_values=(targets.old_values - was_mean) / was_std * std + mean)
        loss = value_loss(values.flatten(), targets, std, self.value_options)
        self.value_losses.append(loss.item())
        return add_loss(values, self.value_coef * loss), log_prob, entropy

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            **super()._get_constructor_parameters(),
            "value_norm": self.value_norm,
            "obs_layer_norm": self.obs_layer_norm,
            "action_gain": self.action_gain,
        }


class DetailsAlgorithmMixin(ActiveStepsAlgorithmMixin):
    """Adds details to an algorithm of PPO's kind, whose policy and rollout buffer have the mixins for them."""

    # A DetailsPolicyMixin, and a DetailsBufferMixin
    policy: Any
    rollout_buffer: Any
    vf_coef: float
    clip_range_vf: Any
    value_norm: bool
    huber_delta: float | None
    value_clip: float | None

    def _setup_details(self, options: ValueOptions, active_masks: bool) -> None:
        """Check and store the arguments, between SB3's constructor and `_setup_model`."""
        if not isinstance(active_masks, bool):
            raise ValueError(f"active_masks is {active_masks!r}; it must be True or False")
        if self.clip_range_vf is not None and not options.is_of_sb3:
            raise ValueError(
                "clip_range_vf is of SB3's own loss of the values, which value_norm, huber_delta and value_clip replace: use"
                " value_clip in its place"
            )
        for name, value in asdict(options).items():
            setattr(self, name, value)
        self.active_masks = active_masks

    @property
    def _value_options(self) -> ValueOptions:
        return ValueOptions(self.value_norm, self.huber_delta, self.value_clip)

    def _update(self) -> None:
        options = self._value_options
        if options.is_of_sb3:
            return super()._update()
        policy, buffer = self.policy, self.rollout_buffer
        if isinstance(policy.value_net, NormalizedValue):
            # Once a rollout, so that its values keep their unit until the next
            policy.acted_in = policy.value_net.statistics()
            policy.value_net.update(th.as_tensor(buffer.returns[buffer.active]))
        policy.value_options, policy.value_coef, policy.value_losses = options, self.vf_coef, []
        vf_coef, self.vf_coef = self.vf_coef, 0.0
        buffer.shows_targets = True
        try:
            super()._update()
        finally:
            policy.value_options, self.vf_coef, buffer.shows_targets = None, vf_coef, False
        self.logger.record("train/value_loss", np.mean(policy.value_losses))
