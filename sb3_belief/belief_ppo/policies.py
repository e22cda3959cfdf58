"""Actor-critic policies whose features hold a belief about the other agents."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.preprocessing import get_flattened_obs_dim, preprocess_obs
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_belief.belief import DynamicBelief, History, action_loss, kl_divergence
from sb3_belief.belief_ppo.auxiliary import add_loss
from sb3_belief.belief_ppo.buffers import BeliefMinibatch
from sb3_belief.belief_ppo.extractor import BeliefExtractor, BeliefFusion, flatten_observation
from sb3_belief.belief_ppo.others import action_layout

BELIEFS = ("dynamic", "none")
#: The default of ``latent_dim``
LATENT_DIM = 64

if TYPE_CHECKING:
    _Policy = ActorCriticPolicy
else:
    _Policy = object


class BeliefPolicyMixin(_Policy):
    """
    Makes an SB3 actor-critic policy one with a belief. All of SB3's own passes (`forward`, `evaluate_actions`,
    `get_distribution`, `predict_values`) go through the features extractor, so that is where the belief is inferred, once a
    pass, for policy and value alike; what is left here is to say how it is drawn.

    :param others_action_spaces: The others' action spaces in their fixed order; none without others
    :param belief: ``"dynamic"``, the paper's method, or ``"none"``: then, and without others, this is SB3's policy
    :param history_length: ``T_h``, how many of its own steps the agent remembers, at least 1
    :param keep_ratio: ``p``, the share of them that is attended to, in (0, 1]
    :param detach_belief: Whether to keep the gradient of policy and value out of the belief network
    :param embedding_dim: ``d``, width of the belief's embeddings, queries, keys and values
    :param latent_dim: ``z``, width of the belief
    :param fusion_activation_fn: Activation after policy and value have fused the belief
    """

    def __init__(
        self,
        *args: Any,
        others_action_spaces: Mapping[str, spaces.Space] | None = None,
        belief: str = "dynamic",
        history_length: int = 800,
        keep_ratio: float = 0.05,
        detach_belief: bool = False,
        embedding_dim: int = 64,
        latent_dim: int = LATENT_DIM,
        fusion_activation_fn: type[nn.Module] = nn.ReLU,
        **kwargs: Any,
    ) -> None:
        check_belief(belief, history_length, keep_ratio)
        for name, width in (("embedding_dim", embedding_dim), ("latent_dim", latent_dim)):
            if not isinstance(width, int) or width < 1:
                raise ValueError(f"{name} is {width!r}; it must be an integer of at least 1")
        others = dict(others_action_spaces or {})
        # Before SB3's constructor, which builds the networks
        self._belief_kwargs: dict[str, Any] = dict(
            others_action_spaces=others,
            belief=belief,
            history_length=history_length,
            keep_ratio=keep_ratio,
            detach_belief=detach_belief,
            embedding_dim=embedding_dim,
            latent_dim=latent_dim,
            fusion_activation_fn=fusion_activation_fn,
        )
        self.layout = action_layout(others)
        self.has_belief = belief != "none" and self.layout.n_others > 0
        #: Weights of the two terms of the belief's loss (eq. 8), set by the algorithm before each update
        self.action_coef = 0.5
        self.kl_coef = 0.005
        self._minibatch: BeliefMinibatch | None = None
        super().__init__(*args, **kwargs)
        if self.has_belief and not self.share_features_extractor:
            raise ValueError(
                "share_features_extractor=False would give the value a belief of its own; policy and value share the belief "
                "(Sec. 4.2 of the paper). Leave it True, or use belief='none'."
            )

    # -- construction, within SB3's constructor ------------------------------------------------------------------------

    def make_features_extractor(self) -> BaseFeaturesExtractor:
        features = super().make_features_extractor()
        if not self.has_belief:
            return features
        options = self._belief_kwargs
        # A belief must not shift the random stream from which SB3 draws the other weights
        with th.random.fork_rng(devices=[]):
            belief = DynamicBelief(
                get_flattened_obs_dim(self.observation_space),
                self.layout.width,
                options["embedding_dim"],
                options["latent_dim"],
                options["keep_ratio"],
            )
        return BeliefExtractor(self.observation_space, features, belief, options["history_length"], options["detach_belief"])

    def _build_mlp_extractor(self) -> None:
        if not self.has_belief:
            super()._build_mlp_extractor()
            return
        self.mlp_extractor = BeliefFusion(  # type: ignore[assignment]
            self._extractor.features.features_dim,
            self._belief_kwargs["latent_dim"],
            self.net_arch,
            self.activation_fn,
            self._belief_kwargs["fusion_activation_fn"],
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
        return {**super()._get_constructor_parameters(), **self._belief_kwargs}

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
        """The history from which the belief is inferred at present, if there is a belief."""
        return self._extractor.history if self.has_belief else None

    def remember(self, observations: PyTorchObs, actions: th.Tensor) -> None:
        """
        Append the agent's own active steps to its history.

        :param observations: Its observations, as the environment gives them, oldest first
        :param actions: The others' flattened actions at these steps, ``[N, W]``, zero where not visible
        """
        self._extractor.remember(self.flat_observations(observations), actions)

    def stage(self, minibatch: BeliefMinibatch | None) -> None:
        """
        :param minibatch: What the next call of :meth:`evaluate_actions` is about; it is used once
        """
        self._minibatch = minibatch

    def acted_with(self) -> tuple[th.Tensor, th.Tensor]:
        """
        :return: Noise ``[B, z]`` and history rows ``[B, N_h]`` of the last call of :meth:`forward`
        """
        return self._acted_with

    def flat_observations(self, observations: PyTorchObs) -> th.Tensor:
        """
        :param observations: Observations as the environment gives them, batch first
        :return: As belief and history take them: preprocessed as SB3 does, and flat, ``[B, d_o]``
        """
        preprocessed = preprocess_obs(observations, self.observation_space, normalize_images=self.normalize_images)
        return flatten_observation(preprocessed)

    # -- SB3's passes --------------------------------------------------------------------------------------------------

    def forward(self, obs: Any, deterministic: bool = False, *args: Any, **kwargs: Any) -> Any:
        if not self.has_belief:
            return super().forward(obs, deterministic, *args, **kwargs)
        extractor = self._extractor
        with extractor.conditioned(sample=not deterministic):
            result = super().forward(obs, deterministic, *args, **kwargs)
        assert extractor.output is not None
        noise = th.zeros_like(extractor.output.mean) if extractor.noise is None else extractor.noise
        self._acted_with = noise, extractor.output.kept
        return result

    def _predict(self, observation: PyTorchObs, deterministic: bool = False, *args: Any, **kwargs: Any) -> th.Tensor:
        if not self.has_belief:
            return super()._predict(observation, deterministic, *args, **kwargs)
        with self._extractor.conditioned(sample=not deterministic):
            return super()._predict(observation, deterministic, *args, **kwargs)

    def evaluate_actions(self, obs: PyTorchObs, actions: th.Tensor, *args: Any, **kwargs: Any) -> Any:
        minibatch, self._minibatch = self._minibatch, None
        if not self.has_belief or minibatch is None:
            return super().evaluate_actions(obs, actions, *args, **kwargs)
        extractor = self._extractor
        with extractor.conditioned(minibatch.noise, minibatch.kept):
            values, log_prob, entropy = super().evaluate_actions(obs, actions, *args, **kwargs)
        loss = self.belief_loss(minibatch)
        extractor.output = None  # it holds the graph of this minibatch
        return add_loss(values, loss), log_prob, entropy

    def belief_loss(self, minibatch: BeliefMinibatch) -> th.Tensor:
        """
        :param minibatch: The minibatch whose belief the extractor has inferred last
        :return: The two terms of eq. 8 that train the belief, a scalar
        """
        output = self._extractor.output
        assert output is not None
        error = self.action_error(output.prediction, minibatch)
        return self.action_coef * error + self.kl_coef * kl_divergence(output.mean, output.log_std)

    def action_error(self, prediction: th.Tensor, minibatch: BeliefMinibatch) -> th.Tensor:
        """
        :param prediction: Predicted actions of the others in the minibatch, ``[B, W]``
        :param minibatch: Their actions and visibility
        :return: Eq. 7, a scalar
        """
        owners = th.as_tensor(self.layout.owners, device=prediction.device)
        return action_loss(prediction, minibatch.others_actions, minibatch.others_visible, owners)


class BeliefActorCriticPolicy(BeliefPolicyMixin, ActorCriticPolicy):
    """SB3's ``ActorCriticPolicy`` with a belief; takes all of its arguments and those of :class:`BeliefPolicyMixin`."""


def check_belief(belief: str, history_length: int, keep_ratio: float) -> None:
    """
    :raises ValueError: where one of them has no meaning; the message says what is allowed
    """
    if belief not in BELIEFS:
        raise ValueError(f"belief is {belief!r}; it must be one of {', '.join(map(repr, BELIEFS))}")
    if not isinstance(history_length, int) or history_length < 1:
        raise ValueError(
            f"history_length is {history_length!r}; it must be an integer of at least 1 (the paper uses 800). "
            "For PPO without a history use belief='none'."
        )
    if not 0 < keep_ratio <= 1:
        raise ValueError(
            f"keep_ratio is {keep_ratio!r}; it must be in (0, 1]: the share of the history attended to (the paper uses 0.05)"
        )
