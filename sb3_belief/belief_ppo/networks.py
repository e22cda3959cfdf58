"""How the networks of a policy with a belief are built."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from numbers import Integral
from typing import TYPE_CHECKING, Any, ClassVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import Schedule
from torch import nn

from sb3_belief.belief import ROW_FEATURES, AdaptiveBelief, DynamicBelief
from sb3_belief.belief_ppo.adaptive import AdaptiveExtractor
from sb3_belief.belief_ppo.extractor import BeliefExtractor, BeliefFusion, fitting_extractor
from sb3_belief.belief_ppo.options import EMBEDDING_DIM, LATENT_DIM, BeliefOptions
from sb3_belief.belief_ppo.others import action_layout
from sb3_belief.belief_ppo.others_baseline import OthersBaseline
from sb3_belief.common.action_encoding import RowEncoder

if TYPE_CHECKING:
    _Policy = ActorCriticPolicy
else:
    _Policy = object


class BeliefNetworksMixin(_Policy):
    """
    Builds the networks of a policy with a belief: overrides what SB3's constructor calls.

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
    :param n_own: As in :class:`~sb3_belief.BeliefPPO`
    :param n_pool: As in :class:`~sb3_belief.BeliefPPO`
    :param row_features: As in :class:`~sb3_belief.BeliefPPO`
    :param history_dropout: As in :class:`~sb3_belief.BeliefPPO`
    :param belief_replay: As in :class:`~sb3_belief.BeliefPPO`
    :param prediction_steps: As in :class:`~sb3_belief.BeliefPPO`
    :param critic_sees_others: As in :class:`~sb3_belief.BeliefPPO`
    :param embedding_dim: ``d``, width of the belief's embeddings, queries, keys and values
    :param latent_dim: ``z``, width of the belief
    :param fusion_activation_fn: Activation after policy and value have fused the belief
    :param belief_from_features: Whether the belief and its history see the features of an observation, which the features
        extractor computes, instead of the observation itself; :class:`~sb3_belief.BeliefPPO` turns it on for images
    """

    #: The baseline that sees what the others did, if there is one
    others_baseline: OthersBaseline | None
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
        embedding_dim: int = EMBEDDING_DIM,
        latent_dim: int = LATENT_DIM,
        fusion_activation_fn: type[nn.Module] = nn.ReLU,
        belief_from_features: bool = False,
        **kwargs: Any,
    ) -> None:
        # Before SB3's constructor, which builds the networks
        self.others_baseline = None
        self.options = BeliefOptions(
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
        for name, width in (("embedding_dim", embedding_dim), ("latent_dim", latent_dim)):
            if not isinstance(width, Integral) or width < 1:
                raise ValueError(f"{name} is {width!r}; it must be an integer of at least 1")
        if not isinstance(belief_from_features, bool):
            raise ValueError(f"belief_from_features is {belief_from_features!r}; it must be True or False")
        self.others_action_spaces = dict(others_action_spaces or {})
        self.embedding_dim = embedding_dim
        self.latent_dim = latent_dim
        self.fusion_activation_fn = fusion_activation_fn
        self.belief_from_features = belief_from_features
        self.layout = action_layout(self.others_action_spaces)
        self.options.check_others(self.others_action_spaces, self.layout)
        self.action_loss = self.options.loss_of(self.layout)
        self.has_belief = self.options.variant is not None and self.layout.n_others > 0
        if features_extractor_class is None:
            features_extractor_class = self.default_extractor or fitting_extractor(observation_space)
        kwargs["features_extractor_class"] = features_extractor_class
        super().__init__(observation_space, action_space, lr_schedule, *args, **kwargs)
        if self.has_belief and not self.share_features_extractor:
            raise ValueError(
                "share_features_extractor=False would give the value a belief of its own; policy and value share the belief "
                "(Sec. 4.2 of the paper). Leave it True, or use belief='none'."
            )

    def make_features_extractor(self) -> BaseFeaturesExtractor:
        """Build SB3's features extractor, and the belief beside it."""
        features = super().make_features_extractor()
        if not self.has_belief:
            return features
        # From a copy of the generator: with the same seed, all variants of a belief start with equal weights in the rest
        with th.random.fork_rng(devices=[]):
            if not self.ortho_init:
                # Nothing else draws the rest anew, whose first layer would start with the very weights of the belief's
                th.manual_seed(int(th.randint(2**62, ())))
            sees = features.features_dim if self.belief_from_features else get_flattened_obs_dim(self.observation_space)
            widths, options = (self.embedding_dim, self.latent_dim), self.options
            if options.belief == "adaptive":
                own = RowEncoder("the agent", self.action_space).width + 1
                scopes, features_of_rows = (options.n_own, options.n_pool), options.row_features
                adaptive = AdaptiveBelief(
                    sees, self.layout.width, own, *widths, *scopes, features_of_rows, options.prediction_steps
                )
            else:
                keep_ratio, variant, similarity = options.keep_ratio, options.belief, options.similarity
                belief = DynamicBelief(sees, self.layout.width, *widths, keep_ratio, variant, similarity)
        given = self.belief_from_features
        if options.belief == "adaptive":
            return AdaptiveExtractor(self.observation_space, features, adaptive, options, given, self.layout)
        return BeliefExtractor(self.observation_space, features, belief, options, given)

    def _build_mlp_extractor(self) -> None:
        if not self.has_belief:
            super()._build_mlp_extractor()
            return
        assert isinstance(self.features_extractor, BeliefExtractor)
        self.mlp_extractor = BeliefFusion(  # type: ignore[assignment]
            self.features_extractor.features.features_dim,
            self.features_extractor.belief_width,
            self.net_arch,
            self.activation_fn,
            self.fusion_activation_fn,
            self.device,
        )

    def _build(self, lr_schedule: Schedule) -> None:
        if self.options.critic_sees_others and self.has_belief:
            seen = self.layout.width + self.layout.n_others
            with th.random.fork_rng(devices=[]):
                # As the belief's; before the optimizer is made
                self.others_baseline = OthersBaseline(self.features_extractor.features_dim, seen, self.device)
        super()._build(lr_schedule)
        if isinstance(self.features_extractor, BeliefExtractor):
            # A network of the user's own takes one tensor, as wide as features_dim says
            self.features_extractor.in_one_tensor = not isinstance(self.mlp_extractor, BeliefFusion)

    def init_weights(self, module: nn.Module, gain: float = 1) -> None:  # type: ignore[override]
        """
        Initialise a layer as SB3 does, except those of the belief.

        SB3 initialises every layer of a features extractor orthogonally with a gain of sqrt(2), which is meant for layers
        before a ReLU: not for the belief's queries, keys and log deviations, which keep PyTorch's initialisation.

        :param module: A layer
        :param gain: As in SB3
        """
        extractor = self.features_extractor
        in_belief = isinstance(extractor, BeliefExtractor) and any(module is layer for layer in extractor.belief.modules())
        if not in_belief:
            super().init_weights(module, gain)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            **super()._get_constructor_parameters(),
            # SB3 leaves it out
            "share_features_extractor": self.share_features_extractor,
            **asdict(self.options),
            "others_action_spaces": self.others_action_spaces,
            "embedding_dim": self.embedding_dim,
            "latent_dim": self.latent_dim,
            "fusion_activation_fn": self.fusion_activation_fn,
            "belief_from_features": self.belief_from_features,
        }
