"""
PPO with learned policy features of the other agents (AMF): Hernandez-Leal, Kartal and Taylor, "Agent Modeling as Auxiliary
Task for Deep Reinforcement Learning", 2019 (arXiv:1907.09597), there on A3C.

    e = relu(W_0 o)        x = relu(W_x e)        p = relu(W_p e)
    logits_j = W_j p       z = x * p              policy and value are linear in z

The policy features p predict what each other agent does, and are multiplied with the agent's own features x. Policy, value and
prediction all train them: nothing is stopped. Nothing is sampled, and there is no history.
"""

import math
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, FlattenExtractor, NatureCNN
from torch import nn

from sb3_belief.belief import VARIANTS, BeliefOutput
from sb3_belief.belief_ppo.algorithm import BeliefAlgorithmMixin
from sb3_belief.belief_ppo.belief_ppo import BeliefPPO
from sb3_belief.belief_ppo.extractor import BeliefExtractor
from sb3_belief.belief_ppo.maskable import MaskableBeliefActorCriticPolicy, MaskableBeliefPPO
from sb3_belief.belief_ppo.networks import BeliefNetworksMixin
from sb3_belief.belief_ppo.policies import BeliefActorCriticPolicy
from sb3_belief.common.checks import check_integer

#: What the name stands for among the arguments of BeliefPPO
FIXED: dict[str, Any] = {"belief": "static", "action_loss": "cross_entropy", "detach_belief": False}


class FirstLayer(BaseFeaturesExtractor):
    """
    The layer that own features and policy features share: ``e = relu(W_0 o)``.

    :param observed: Extracts from an observation what the layer is given
    :param width: ``h``, width of the layer
    """

    def __init__(self, observed: BaseFeaturesExtractor, width: int) -> None:
        super().__init__(observed._observation_space, width)
        self.observed = observed
        self.layer = nn.Sequential(nn.Linear(observed.features_dim, width), nn.ReLU())

    def forward(self, observations: Any) -> th.Tensor:
        """
        Extract the shared features.

        :param observations: Preprocessed observations
        :return: ``e``, ``[B, h]``
        """
        return self.layer(self.observed(observations))


class PolicyFeatures(nn.Module):
    """
    The policy features and the prediction from them, in the place of a belief: ``p = relu(W_p e)``, ``logits_j = W_j p``.

    :param width: ``h``
    :param action_dim: ``W``, width of the others' flattened actions
    """

    variant = VARIANTS["static"]

    def __init__(self, width: int, action_dim: int) -> None:
        super().__init__()
        self.observation_dim = self.latent_dim = width
        self.action_dim = action_dim
        self.encoder = nn.Sequential(nn.Linear(width, width), nn.ReLU())
        self.decoder = nn.Linear(width, action_dim)

    def forward(
        self,
        observations: th.Tensor,
        history: None = None,
        noise: th.Tensor | None = None,
        selected: th.Tensor | None = None,
        context: None = None,
        predict: bool = True,
    ) -> BeliefOutput:
        """
        Infer the policy features.

        :param observations: The shared features ``e``, ``[B, h]``
        :param history: None: there is none
        :param noise: Not used: nothing is sampled
        :param selected: Not used: nothing is attended to
        :param context: None: there is no history
        :param predict: Whether to predict the others' actions
        :return: ``p`` as the belief, and the logits
        """
        features = self.encoder(observations)
        # Of shape[0], since len() would make the number of rows a constant of an exported program
        rows = th.zeros(features.shape[0], 0, dtype=th.int, device=features.device)
        prediction = self.decoder(features) if predict else None
        return BeliefOutput(
            features, features, th.full_like(features, -math.inf), prediction, rows, features.new_zeros(rows.shape)
        )


class Multiplication(nn.Module):
    """
    Own features, multiplied with the policy features: ``x = relu(W_x e)``, ``z = x * p``, for policy and value alike.

    :param width: ``h``
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.own = nn.Sequential(nn.Linear(width, width), nn.ReLU())
        self.latent_dim_pi = self.latent_dim_vf = width

    def forward(self, features: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        Fuse shared features and policy features.

        :param features: ``e`` and ``p`` side by side, ``[B, 2 h]``
        :return: ``z`` for policy and value, ``[B, h]`` each
        """
        fused = self.forward_actor(features)
        return fused, fused

    def forward_actor(self, features: th.Tensor) -> th.Tensor:
        """
        Fuse shared features and policy features.

        :param features: ``[B, 2 h]``
        :return: ``z``, ``[B, h]``
        """
        shared, policy_features = features.chunk(2, dim=-1)
        return self.own(shared) * policy_features

    def forward_critic(self, features: th.Tensor) -> th.Tensor:
        """
        Fuse shared features and policy features.

        :param features: ``[B, 2 h]``
        :return: ``z``, ``[B, h]``
        """
        return self.forward_actor(features)


class AMFNetworksMixin(BeliefNetworksMixin):
    """
    Builds the networks of AMF in the place of a belief's.

    :param args: As in the policy
    :param hidden_dim: ``h``, width of all layers, at least 1
    :param kwargs: As in the policy
    :raises ValueError: If ``net_arch`` is given, since there are no further layers
    """

    def __init__(self, *args: Any, hidden_dim: int = 64, **kwargs: Any) -> None:
        check_integer("hidden_dim", hidden_dim, 1, "the width of all layers")
        if kwargs.get("net_arch") is not None:
            raise ValueError(
                f"net_arch is {kwargs['net_arch']!r}, but AMF's layers are all of one width: use hidden_dim instead"
            )
        self.hidden_dim = hidden_dim
        super().__init__(*args, **kwargs)

    def make_features_extractor(self) -> BaseFeaturesExtractor:
        """Build SB3's features extractor, the first layer, and the policy features beside it."""
        observed = BasePolicy.make_features_extractor(self)
        if not self.has_belief:
            return observed
        predicted: Any = PolicyFeatures(self.hidden_dim, self.layout.width)
        first = FirstLayer(observed, self.hidden_dim)
        # What it calls a belief is inferred from the features of the first layer
        return BeliefExtractor(self.observation_space, first, predicted, self.options, from_features=True)

    def _build_mlp_extractor(self) -> None:
        if self.has_belief:
            self.mlp_extractor = Multiplication(self.hidden_dim).to(self.device)  # type: ignore[assignment]
        else:
            super()._build_mlp_extractor()

    def init_weights(self, module: nn.Module, gain: float = 1) -> None:  # type: ignore[override]
        """
        Initialise a layer as SB3 does, all of them alike.

        :param module: A layer
        :param gain: As in SB3
        """
        ActorCriticPolicy.init_weights(module, gain)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        parameters = {**super()._get_constructor_parameters(), "hidden_dim": self.hidden_dim}
        return {key: value for key, value in parameters.items() if key != "net_arch"}


class AMFPolicy(AMFNetworksMixin, BeliefActorCriticPolicy):
    """SB3's ``ActorCriticPolicy`` with the networks of AMF, and a features extractor that fits the observation space."""


class AMFMlpPolicy(AMFPolicy):
    """The policy for vectors; images are flattened."""

    default_extractor = FlattenExtractor


class AMFCnnPolicy(AMFPolicy):
    """The policy for images."""

    default_extractor = NatureCNN


class AMFMultiInputPolicy(AMFPolicy):
    """The policy for Dict observations."""

    default_extractor = CombinedExtractor


class MaskableAMFPolicy(AMFNetworksMixin, MaskableBeliefActorCriticPolicy):  # type: ignore[misc]
    """sb3-contrib's ``MaskableActorCriticPolicy`` with the networks of AMF."""


class MaskableAMFMlpPolicy(MaskableAMFPolicy):
    """The masked policy for vectors; images are flattened."""

    default_extractor = FlattenExtractor


class MaskableAMFCnnPolicy(MaskableAMFPolicy):
    """The masked policy for images."""

    default_extractor = NatureCNN


class MaskableAMFMultiInputPolicy(MaskableAMFPolicy):
    """The masked policy for Dict observations."""

    default_extractor = CombinedExtractor


class AMFAlgorithmMixin(BeliefAlgorithmMixin):
    """Makes of BeliefPPO with a static belief AMF."""

    def __init__(self, policy: Any, env: Any, *args: Any, **kwargs: Any) -> None:
        for name, value in FIXED.items():
            if kwargs.setdefault(name, value) != value:
                raise ValueError(f"{name} is {kwargs[name]!r}; AMF is what it is with {name}={value!r}")
        super().__init__(policy, env, *args, **kwargs)


class AMFPPO(AMFAlgorithmMixin, BeliefPPO):
    """
    PPO with the auxiliary task of predicting the others' actions, whose features are multiplied with the agent's own: AMF.

        ``L = L_PPO + action_coef * L_AM``,  ``L_AM`` the cross-entropy of the others' visible actions, averaged over them

    All arguments are those of :class:`~sb3_belief.BeliefPPO`, of which ``belief``, ``action_loss`` and ``detach_belief`` are
    fixed, and those of a history or of a latent's distribution have no effect. With ``action_coef=0`` it is the control: the
    same network without the task.

    :param policy: ``"MlpPolicy"``, ``"CnnPolicy"``, ``"MultiInputPolicy"``, ``"BeliefPolicy"`` (what fits the observation
        space), or a class derived from :class:`AMFPolicy`
    :param env: The environment of this one agent
    :param args: As in BeliefPPO
    :param kwargs: As in BeliefPPO
    :raises ValueError: If an argument is another than what the name stands for, or another agent's actions are numbers
    """

    policy_base = AMFPolicy
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "BeliefPolicy": AMFPolicy,
        "MlpPolicy": AMFMlpPolicy,
        "CnnPolicy": AMFCnnPolicy,
        "MultiInputPolicy": AMFMultiInputPolicy,
    }


class MaskableAMFPPO(AMFAlgorithmMixin, MaskableBeliefPPO):  # type: ignore[misc]
    """
    AMF with invalid action masking: :class:`AMFPPO` on sb3-contrib's ``MaskablePPO``.

    :param policy: As in AMFPPO, or a class derived from :class:`MaskableAMFPolicy`
    :param env: The environment of this one agent
    :param args: As in MaskableBeliefPPO
    :param kwargs: As in MaskableBeliefPPO
    :raises ValueError: As in AMFPPO
    """

    policy_base = MaskableAMFPolicy
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "BeliefPolicy": MaskableAMFPolicy,
        "MlpPolicy": MaskableAMFMlpPolicy,
        "CnnPolicy": MaskableAMFCnnPolicy,
        "MultiInputPolicy": MaskableAMFMultiInputPolicy,
    }
