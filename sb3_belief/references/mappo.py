"""
MAPPO (Yu et al. 2022, arXiv:2103.01955): PPO whose critic sees the global state in training, and whose actor does not.

The environment shows an agent its own observation with the state beside it (``references.with_state.WithState``). The actor's
network is given the columns of its own observation only, so its weights are all that a deployed agent needs.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, MlpExtractor
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_belief.belief_ppo.algorithm import BeliefAlgorithmMixin
from sb3_belief.belief_ppo.belief_ppo import BeliefPPO
from sb3_belief.belief_ppo.extractor import fitting_extractor
from sb3_belief.belief_ppo.maskable import MaskableBeliefActorCriticPolicy, MaskableBeliefPPO
from sb3_belief.belief_ppo.networks import BeliefNetworksMixin
from sb3_belief.belief_ppo.on_policy_details import DetailsPolicyMixin
from sb3_belief.belief_ppo.policies import BeliefActorCriticPolicy

#: Entries of an observation: the agent's own, and for the critic the global state and whose it is (one-hot)
OWN, STATE, CRITIC_ID = "obs", "state", "critic_id"


class CentralExtractor(BaseFeaturesExtractor):
    """
    Features of the agent's own observation, followed by the state and the agent's id.

    :param observation_space: As ``WithState`` makes it
    :param own: Extracts the features of the agent's own observation
    """

    def __init__(self, observation_space: spaces.Dict, own: BaseFeaturesExtractor) -> None:
        rest = sum(spaces.flatdim(observation_space[key]) for key in (STATE, CRITIC_ID))
        super().__init__(observation_space, own.features_dim + rest)
        self.own = own
        #: How many of the features the actor is given
        self.own_dim = own.features_dim

    def forward(self, observations: dict[str, th.Tensor]) -> th.Tensor:
        """
        Extract the features.

        :param observations: Preprocessed observations
        :return: ``[B, features_dim]``, the agent's own first
        """
        own: Any = {key: part for key, part in observations.items() if key not in (STATE, CRITIC_ID)}
        own = own[OWN] if own.keys() == {OWN} else own
        return th.cat([self.own(own), observations[STATE], observations[CRITIC_ID]], dim=1)


class CentralNetworks(MlpExtractor):
    """
    SB3's networks of policy and value, of which the policy's is given the agent's own features only.

    :param own_dim: Number of these, the first ones
    :param features_dim: Number of all features
    :param net_arch: As in SB3
    :param activation_fn: As in SB3
    :param device: As in SB3
    """

    def __init__(
        self,
        own_dim: int,
        features_dim: int,
        net_arch: list[int] | dict[str, list[int]],
        activation_fn: type[nn.Module],
        device: th.device | str,
    ) -> None:
        super().__init__(features_dim, net_arch, activation_fn, device)
        self.own_dim = own_dim
        actor = MlpExtractor(own_dim, net_arch, activation_fn, device)
        self.policy_net, self.latent_dim_pi = actor.policy_net, actor.latent_dim_pi

    def forward_actor(self, features: th.Tensor) -> th.Tensor:
        """
        Compute the policy's latents.

        :param features: ``[B, features_dim]``
        :return: ``[B, latent_dim_pi]``
        """
        return self.policy_net(features[:, : self.own_dim])


class CentralPolicyMixin(DetailsPolicyMixin, BeliefNetworksMixin):
    """
    Builds the networks of MAPPO, and lets them predict from the agent's own observation alone.

    :param args: As in the policy
    :param kwargs: As in the policy; ``features_extractor_class`` is that of the agent's own observation
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self._own_extractor: type[BaseFeaturesExtractor] | None = kwargs.get("features_extractor_class")
        super().__init__(*args, **kwargs)

    @property
    def own_space(self) -> spaces.Space:
        """The space of the agent's own observation."""
        assert isinstance(self.observation_space, spaces.Dict)
        own = {key: part for key, part in self.observation_space.spaces.items() if key not in (STATE, CRITIC_ID)}
        return own[OWN] if own.keys() == {OWN} else spaces.Dict(own)

    def make_features_extractor(self) -> BaseFeaturesExtractor:
        """Build the extractor of the agent's own observation, and put the state beside it."""
        space = self.own_space
        own = (self._own_extractor or fitting_extractor(space))(space, **self.features_extractor_kwargs)
        return CentralExtractor(self.observation_space, own)  # type: ignore[arg-type]

    def _build_mlp_extractor(self) -> None:
        features = self.features_extractor
        assert isinstance(features, CentralExtractor)
        self.mlp_extractor = CentralNetworks(
            features.own_dim, features.features_dim, self.net_arch, self.activation_fn, self.device
        )
        self._add_layer_norms()

    def complete(self, own: Any, zeros: Callable[..., Any] = th.zeros) -> dict[str, Any]:
        """
        Return observations with zeros for what only the critic sees, on which actions do not depend.

        :param own: The agent's own, in :attr:`own_space`: one or several, an array, a tensor, or a dict of such
        :param zeros: Makes the zeros of a shape, as ``own`` is a tensor or an array
        :return: In the policy's observation space
        """
        parts = own if isinstance(own, Mapping) else {OWN: own}
        space: Any = self.observation_space
        key, part = next(iter(parts.items()))
        leading = np.shape(part)[: len(np.shape(part)) - len(space[key].shape)]
        return {**parts, **{key: zeros((*leading, *space[key].shape)) for key in (STATE, CRITIC_ID)}}

    def obs_to_tensor(self, observation: np.ndarray | dict[str, np.ndarray]) -> tuple[PyTorchObs, bool]:
        """
        Convert observations as the policy does. Where they are the agent's own alone, zeros stand in for what only the critic
        sees: actions do not depend on it, values do.

        :param observation: As ``WithState`` makes them, or the agent's own
        :return: As in the policy
        """
        if not (isinstance(observation, Mapping) and STATE in observation):
            observation = self.complete(observation, partial(np.zeros, dtype=np.float32))
        return super().obs_to_tensor(observation)


class MAPPOPolicy(CentralPolicyMixin, BeliefActorCriticPolicy):
    """An actor that sees the agent's own observation, whatever its space is, and a critic that sees the state as well."""


class MaskableMAPPOPolicy(CentralPolicyMixin, MaskableBeliefActorCriticPolicy):  # type: ignore[misc]
    """The policy of MAPPO with invalid action masking."""


class CentralAlgorithmMixin(BeliefAlgorithmMixin):
    """Makes of BeliefPPO without a belief MAPPO."""

    def __init__(self, policy: Any, env: Any, *args: Any, **kwargs: Any) -> None:
        if kwargs.setdefault("belief", "none") != "none":
            raise ValueError(f"belief is {kwargs['belief']!r}; MAPPO's agents hold none: leave it 'none'")
        super().__init__(policy, env, *args, **kwargs)

    def _setup_model(self) -> None:
        space = self.observation_space
        if not (isinstance(space, spaces.Dict) and {STATE, CRITIC_ID} <= space.spaces.keys()):
            raise ValueError(
                f"MAPPO's critic needs the global state, but an agent's observation is {space}: make the environment of its"
                " team by sb3_belief.references.with_state.with_state(env)."
            )
        if not issubclass(self.policy_class, CentralPolicyMixin):
            raise ValueError(
                f"{type(self).__name__} needs a policy whose actor does not see the state, not {self.policy_class.__name__};"
                f" use 'MultiInputPolicy' or derive yours from sb3_belief.references.mappo.{self.policy_base.__name__}"
            )
        super()._setup_model()


class MAPPO(CentralAlgorithmMixin, BeliefPPO):
    """
    PPO for one agent of a team, whose critic sees the global state in training. It uses the global state in training.

    The critic's input is the agent's own observation, the state and the agent's id; the actor's is the agent's own observation
    alone, so the saved model predicts from that. All arguments are those of :class:`~sb3_belief.BeliefPPO`, whose belief is
    ``"none"`` here; MAPPO's authors use ``value_norm=True``, ``huber_delta=10``, ``value_clip=0.2``, ``vf_coef=1``.

    :param policy: ``"MultiInputPolicy"``, whose features extractor fits the agent's own observation, or a class derived from
        :class:`MAPPOPolicy`
    :param env: The environment of this one agent, in a team whose environment is a ``WithState``
    :param args: As in BeliefPPO
    :param kwargs: As in BeliefPPO
    :raises ValueError: If the observations hold no state, or the policy's actor would see it
    """

    policy_base = MAPPOPolicy
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MultiInputPolicy": MAPPOPolicy}


class MaskableMAPPO(CentralAlgorithmMixin, MaskableBeliefPPO):  # type: ignore[misc]
    """
    MAPPO with invalid action masking. It uses the global state in training.

    :param policy: As in MAPPO, or a class derived from :class:`MaskableMAPPOPolicy`
    :param env: As in MAPPO
    :param args: As in MaskableBeliefPPO
    :param kwargs: As in MaskableBeliefPPO
    :raises ValueError: As in MAPPO
    """

    policy_base = MaskableMAPPOPolicy
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MultiInputPolicy": MaskableMAPPOPolicy}
