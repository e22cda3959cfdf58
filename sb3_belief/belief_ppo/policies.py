"""Actor-critic policies whose features hold a belief about the other agents."""

from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict
from numbers import Integral
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.preprocessing import get_flattened_obs_dim, is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, FlattenExtractor, NatureCNN
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn
from torch.distributions import Distribution

from sb3_belief.belief import ACTION_LOSSES, DynamicBelief, History, expected_actions, kl_divergence
from sb3_belief.belief_ppo.buffers import BeliefMinibatch
from sb3_belief.belief_ppo.extractor import BeliefExtractor, BeliefFusion, flat_observations
from sb3_belief.belief_ppo.loss_injection import add_loss
from sb3_belief.belief_ppo.options import EMBEDDING_DIM, LATENT_DIM, BeliefOptions
from sb3_belief.belief_ppo.others import OthersPrediction, action_layout
from sb3_belief.belief_ppo.terminal_values import TerminalValues
from sb3_belief.common.tensor_version import count_fused_step

if TYPE_CHECKING:
    _Policy = ActorCriticPolicy
else:
    _Policy = object

# The least height and width that NatureCNN's convolutions leave anything of
_MIN_IMAGE_SIZE = 36


def _fast_adam(optimizer_kwargs: Mapping[str, Any] | None) -> dict[str, Any]:
    """
    One call for all weights instead of ten for each of these many small ones: the same step to the last bits, faster.

    :param optimizer_kwargs: What the user says of Adam; None: SB3's default
    :return: The same with the fused implementation, unless the user has chosen another
    """
    given = {"eps": 1e-5} if optimizer_kwargs is None else dict(optimizer_kwargs)
    chosen = given.keys() & {"fused", "foreach", "capturable", "differentiable"}
    return given if chosen else {**given, "fused": True}


class _Unchecked:
    """
    Lets torch's distributions leave out their checks, a fifth of a pass through a small network. Drawing from a discrete one
    notices numbers that are none (NaN) by itself.
    """

    def __enter__(self) -> None:
        self._before = Distribution._validate_args
        Distribution.set_default_validate_args(False)

    def __exit__(self, *_: object) -> None:
        Distribution.set_default_validate_args(self._before)


class BeliefPolicyMixin(_Policy):
    """
    Makes an SB3 actor-critic policy one with a belief. All of SB3's own passes (`forward`, `evaluate_actions`,
    `get_distribution`, `predict_values`) go through the features extractor, so that is where the belief is inferred, once a
    pass, for policy and value alike; what is left here is to say how it is drawn.

    :param observation_space: As in SB3
    :param action_space: As in SB3
    :param lr_schedule: As in SB3
    :param features_extractor_class: As in SB3; None for the policy's usual one
    :param others_action_spaces: The others' action spaces in their fixed order; none without others
    :param belief: As in :class:`~sb3_belief.BeliefPPO`; with ``"none"``, and without others, this is SB3's policy
    :param history_length: As in :class:`~sb3_belief.BeliefPPO`
    :param keep_ratio: As in :class:`~sb3_belief.BeliefPPO`
    :param action_loss: As in :class:`~sb3_belief.BeliefPPO`
    :param policy_latent: As in :class:`~sb3_belief.BeliefPPO`
    :param similarity: As in :class:`~sb3_belief.BeliefPPO`
    :param detach_belief: As in :class:`~sb3_belief.BeliefPPO`
    :param embedding_dim: ``d``, width of the belief's embeddings, queries, keys and values
    :param latent_dim: ``z``, width of the belief
    :param fusion_activation_fn: Activation after policy and value have fused the belief
    """

    #: The features extractor if the user names none; None for the one that fits the observation space
    default_extractor: ClassVar[type[BaseFeaturesExtractor] | None] = None

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        lr_schedule: Schedule,
        *args: Any,
        features_extractor_class: type[BaseFeaturesExtractor] | None = None,
        others_action_spaces: Mapping[str, spaces.Space] | None = None,
        belief: str = "dynamic",
        history_length: int = 800,
        keep_ratio: float = 0.05,
        action_loss: str = "mse",
        policy_latent: str = "sample",
        similarity: str = "embedding",
        detach_belief: bool = False,
        embedding_dim: int = EMBEDDING_DIM,
        latent_dim: int = LATENT_DIM,
        fusion_activation_fn: type[nn.Module] = nn.ReLU,
        **kwargs: Any,
    ) -> None:
        # All this before SB3's constructor, which builds the networks
        self.options = BeliefOptions(belief, history_length, keep_ratio, action_loss, policy_latent, similarity, detach_belief)
        for name, width in (("embedding_dim", embedding_dim), ("latent_dim", latent_dim)):
            if not isinstance(width, Integral) or width < 1:
                raise ValueError(f"{name} is {width!r}; it must be an integer of at least 1")
        self.others_action_spaces = dict(others_action_spaces or {})
        self.embedding_dim = embedding_dim
        self.latent_dim = latent_dim
        self.fusion_activation_fn = fusion_activation_fn
        self.layout = action_layout(self.others_action_spaces)
        self.options.check_others(self.others_action_spaces, self.layout)
        self.has_belief = self.options.variant is not None and self.layout.n_others > 0
        #: Weights of the two terms of the belief's loss (eq. 8), set by the algorithm before each update
        self.action_coef = 0.5
        self.kl_coef = 0.005
        self._minibatch: BeliefMinibatch | None = None
        self.terminal_values = TerminalValues()
        if features_extractor_class is None:
            features_extractor_class = self.default_extractor or fitting_extractor(observation_space)
        kwargs["features_extractor_class"] = features_extractor_class
        if kwargs.get("optimizer_class", th.optim.Adam) is th.optim.Adam:
            kwargs["optimizer_kwargs"] = _fast_adam(kwargs.get("optimizer_kwargs"))
        super().__init__(observation_space, action_space, lr_schedule, *args, **kwargs)
        self.optimizer.register_step_post_hook(count_fused_step)
        if self.has_belief and not self.share_features_extractor:
            raise ValueError(
                "share_features_extractor=False would give the value a belief of its own; policy and value share the belief "
                "(Sec. 4.2 of the paper). Leave it True, or use belief='none'."
            )

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        # A copied optimiser has no hooks
        self.optimizer.register_step_post_hook(count_fused_step)

    # -- construction, within SB3's constructor ------------------------------------------------------------------------

    def make_features_extractor(self) -> BaseFeaturesExtractor:
        features = super().make_features_extractor()
        if not self.has_belief:
            return features
        # A stream aside: with the same seed, all variants of a belief begin with the same weights beside it
        with th.random.fork_rng(devices=[]):
            belief = DynamicBelief(
                get_flattened_obs_dim(self.observation_space),
                self.layout.width,
                self.embedding_dim,
                self.latent_dim,
                self.options.keep_ratio,
                self.options.belief,
                self.options.similarity,
            )
        return BeliefExtractor(self.observation_space, features, belief, self.options)

    def _build_mlp_extractor(self) -> None:
        if not self.has_belief:
            super()._build_mlp_extractor()
            return
        self.mlp_extractor = BeliefFusion(  # type: ignore[assignment]
            self._extractor.features.features_dim,
            self.latent_dim,
            self.net_arch,
            self.activation_fn,
            self.fusion_activation_fn,
            self.device,
        )

    def init_weights(self, module: nn.Module, gain: float = 1) -> None:  # type: ignore[override]
        """
        SB3 initialises every layer of a features extractor orthogonally with a gain of sqrt(2), which is meant for layers
        before a ReLU: not for the belief's queries, keys and log deviations, which keep PyTorch's initialisation.
        """
        if not (self.has_belief and any(module is layer for layer in self._extractor.belief.modules())):
            super().init_weights(module, gain)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            **super()._get_constructor_parameters(),
            "share_features_extractor": self.share_features_extractor,  # SB3 forgets it
            **asdict(self.options),
            "others_action_spaces": self.others_action_spaces,
            "embedding_dim": self.embedding_dim,
            "latent_dim": self.latent_dim,
            "fusion_activation_fn": self.fusion_activation_fn,
        }

    # -- what the algorithm uses ---------------------------------------------------------------------------------------

    @property
    def _extractor(self) -> BeliefExtractor:
        assert isinstance(self.features_extractor, BeliefExtractor)
        return self.features_extractor

    @property
    def belief(self) -> DynamicBelief | None:
        """The belief network, if there is one."""
        return self._extractor.belief if self.has_belief else None

    @property
    def history(self) -> History | None:
        """The history from which the belief is inferred at present, if there is a belief that has one."""
        return self._extractor.history if self.has_belief else None

    def remember(self, observations: np.ndarray | dict[str, np.ndarray], actions: np.ndarray) -> None:
        """
        Append the agent's own active steps to its history: all that an agent needs to adapt to other teammates. The algorithm
        does so after each update; where an agent is deployed, its user does. A belief without a history remembers nothing.

        :param observations: Its observations as :meth:`predict` takes them, oldest first, ``[N, ...]``
        :param actions: The others' flattened actions at these steps, ``[N, W]``, zero where not visible
        :raises ValueError: if the actions are not of this shape
        """
        if self.history is None:
            return
        # Images with the channels last come as the environment gives them, too
        rows = self.flat_observations(self.obs_to_tensor(observations)[0])
        if actions.shape != (len(rows), self.layout.width):
            raise ValueError(
                f"the others' actions have the shape {actions.shape}; {len(rows)} steps beside "
                f"{', '.join(self.others_action_spaces)} need {(len(rows), self.layout.width)}, coded as in the environment's "
                "info['others_actions']: one-hot for Discrete and each dimension of MultiDiscrete, else the values"
            )
        self._extractor.remember(rows, th.as_tensor(actions, device=self.device))

    def stage(self, minibatch: BeliefMinibatch | None) -> None:
        """
        :param minibatch: What the next call of :meth:`evaluate_actions` is about; it is used once
        """
        self._minibatch = minibatch

    @property
    def acted_with(self) -> tuple[th.Tensor, th.Tensor] | None:
        """
        Noise ``[B, z]`` and history rows ``[B, N_h]`` of the last call of :meth:`forward`; of width 0 for a belief that does
        not sample, or does not attend; None without a belief. Can be set, for a call that was made in another process.
        """
        return self._extractor.passing.acted_with if self.has_belief else None

    @acted_with.setter
    def acted_with(self, noise_and_rows: tuple[th.Tensor, th.Tensor]) -> None:
        self._extractor.passing.acted_with = noise_and_rows

    def flat_observations(self, observations: PyTorchObs) -> th.Tensor:
        """
        :param observations: Observations as the environment gives them, batch first
        :return: As belief and history take them: preprocessed as SB3 does, and flat, ``[B, d_o]``
        """
        return flat_observations(self, observations)

    # -- SB3's passes --------------------------------------------------------------------------------------------------

    def _distributions(self, trusted: bool = True) -> AbstractContextManager[None]:
        """How torch's distributions are made within a pass."""
        return _Unchecked() if trusted and not isinstance(self.action_space, spaces.Box) else nullcontext()

    def forward(self, obs: Any, deterministic: bool = False, *args: Any, **kwargs: Any) -> Any:
        if not self.has_belief:
            with self._distributions(trusted=not deterministic):
                return super().forward(obs, deterministic, *args, **kwargs)
        extractor = self._extractor
        with extractor.conditioned(sample=not deterministic), self._distributions(trusted=not deterministic):
            result = super().forward(obs, deterministic, *args, **kwargs)
        output, noise = extractor.passing.output, extractor.passing.noise
        assert output is not None
        if noise is None:
            noise = th.zeros_like(output.mean if extractor.belief.variant.samples else output.mean[:, :0])
        self.acted_with = noise, output.kept
        return result

    def _predict(self, observation: PyTorchObs, deterministic: bool = False, *args: Any, **kwargs: Any) -> th.Tensor:
        if not self.has_belief:
            return super()._predict(observation, deterministic, *args, **kwargs)
        with self._extractor.conditioned(sample=not deterministic):
            return super()._predict(observation, deterministic, *args, **kwargs)

    def predict_values(self, obs: PyTorchObs) -> th.Tensor:
        value = self.terminal_values.take(obs)
        return super().predict_values(obs) if value is None else value

    def evaluate_actions(self, obs: PyTorchObs, actions: th.Tensor, *args: Any, **kwargs: Any) -> Any:
        minibatch, self._minibatch = self._minibatch, None
        if not self.has_belief or minibatch is None:
            with self._distributions():
                return super().evaluate_actions(obs, actions, *args, **kwargs)
        extractor = self._extractor
        with extractor.conditioned(minibatch.noise, minibatch.kept), self._distributions():
            values, log_prob, entropy = super().evaluate_actions(obs, actions, *args, **kwargs)
        loss = self.belief_loss(minibatch)
        extractor.passing.output = None  # it holds the graph of this minibatch
        return values if loss is None else add_loss(values, loss), log_prob, entropy

    def belief_loss(self, minibatch: BeliefMinibatch) -> th.Tensor | None:
        """
        :param minibatch: The minibatch whose belief the extractor has inferred last
        :return: The terms of eq. 8 that train the belief, a scalar; None if there are none
        """
        output, variant = self._extractor.passing.output, self.options.variant
        assert output is not None and variant is not None
        if output.prediction is None:
            return None
        loss = self.action_coef * self.action_error(output.prediction, minibatch)
        if variant.samples:
            loss = loss + self.kl_coef * kl_divergence(output.mean, output.log_std)
        return loss

    def action_error(self, prediction: th.Tensor, minibatch: BeliefMinibatch) -> th.Tensor:
        """
        :param prediction: Predicted actions of the others in the minibatch, ``[B, W]``
        :param minibatch: Their actions and visibility
        :return: Eq. 7, or the cross-entropy in its place, a scalar
        """
        loss = ACTION_LOSSES[self.options.action_loss]
        return loss(prediction, minibatch.others_actions, minibatch.others_visible, self.layout)

    # -- a belief one can look at --------------------------------------------------------------------------------------

    def predict_others(self, observation: np.ndarray | dict[str, np.ndarray]) -> OthersPrediction:
        """
        What the agent believes the others do when it is shown an observation now. The prediction is that of the belief's mean.

        :param observation: One observation or a batch of them, as :meth:`predict` takes them
        :return: The others' expected actions, the belief behind them, and the history rows that it comes from
        :raises ValueError: for a policy that predicts nothing
        """
        if not (self.has_belief and self.options.variant.predicts):  # type: ignore[union-attr]
            raise ValueError(
                f"this policy has belief={self.options.belief!r} and {self.layout.n_others} others: it predicts nobody's "
                "actions. A belief that does needs others and one of 'dynamic', 'context', 'variational', 'static'."
            )
        self.set_training_mode(False)
        tensor, vectorized = self.obs_to_tensor(observation)
        with th.no_grad():
            output = self._extractor.infer(self.flat_observations(tensor))
            assert output.prediction is not None
            expected = expected_actions(output.prediction, self.layout, self.options.action_loss)

        def shown(tensor: th.Tensor) -> np.ndarray:
            array = tensor.cpu().numpy()
            return array if vectorized else array[0]

        return OthersPrediction(
            {name: shown(expected[:, self.layout.columns_of(i)]) for i, name in enumerate(self.others_action_spaces)},
            shown(output.mean),
            shown(output.log_std.exp()),
            shown(output.kept),
            shown(output.weights),
        )


def fitting_extractor(observation_space: spaces.Space) -> type[BaseFeaturesExtractor]:
    """
    :param observation_space: Of the agent
    :return: The features extractor of that one of SB3's policies that is meant for it
    """
    if isinstance(observation_space, spaces.Dict):
        return CombinedExtractor
    if is_image_space(observation_space):
        _, height, width = observation_space.shape  # type: ignore[misc]
        if min(height, width) >= _MIN_IMAGE_SIZE:
            return NatureCNN
    return FlattenExtractor


class BeliefActorCriticPolicy(BeliefPolicyMixin, ActorCriticPolicy):
    """
    SB3's ``ActorCriticPolicy`` with a belief; takes all of its arguments and those of :class:`BeliefPolicyMixin`. Its features
    extractor is the one that SB3's own policies have for the observation space: for vectors, images (at least 36x36), Dicts.
    """


class BeliefMlpPolicy(BeliefActorCriticPolicy):
    """The same for vectors; images are flattened."""

    default_extractor = FlattenExtractor


class BeliefCnnPolicy(BeliefActorCriticPolicy):
    """The same for images."""

    default_extractor = NatureCNN


class BeliefMultiInputPolicy(BeliefActorCriticPolicy):
    """The same for Dicts."""

    default_extractor = CombinedExtractor
