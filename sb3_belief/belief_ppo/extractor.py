"""The features extractor that puts a belief about the others beside the features of the observation."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, MlpExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, TensorDict
from torch import nn

from sb3_belief.belief import BeliefOutput, DynamicBelief, History, HistoryContext, append_rows, empty_history
from sb3_belief.belief_ppo.options import BeliefOptions
from sb3_belief.common.tensor_version import TensorVersions


def flatten_observation(observation: th.Tensor | TensorDict) -> th.Tensor:
    """
    :param observation: A preprocessed observation (batch first), or a dict of them
    :return: One row an observation, ``[B, d_o]``; the parts of a dict in the order of its keys
    """
    if isinstance(observation, dict):
        return th.cat([observation[key].flatten(1).float() for key in sorted(observation)], dim=1)
    return observation.flatten(1).float()


def flat_observations(policy: BasePolicy, observations: PyTorchObs) -> th.Tensor:
    """
    :param policy: Whose observations they are
    :param observations: As the environment gives them, batch first
    :return: Preprocessed as SB3 does, and flat, ``[B, d_o]``
    """
    return flatten_observation(preprocess_obs(observations, policy.observation_space, policy.normalize_images))


class BeliefFeatures(NamedTuple):
    """
    What policy and value are computed from. Two tensors instead of one: SB3 only passes them on, and the features of most
    observations need no gradient, which they would get in one tensor with the belief.

    :param own: Features of the observation, ``[B, features]``
    :param latent: The belief about the others, ``[B, z]``
    """

    own: th.Tensor
    latent: th.Tensor


@dataclass(slots=True)
class Passing:
    """
    What changes from pass to pass. Not in the module itself, whose attributes take ten times as long to set.

    :param given: Noise, history rows and whether to sample, see :meth:`BeliefExtractor.conditioned`
    :param output: What the last pass believed, for whoever called it
    :param noise: The noise it drew
    :param acted_with: Noise and history rows of the last pass that chose actions, see :meth:`BeliefPolicyMixin.acted_with`
    :param context: The encoded history
    :param context_of: The weights and history that it was made from
    """

    given: tuple[th.Tensor | None, th.Tensor | None, bool] = (None, None, False)
    output: BeliefOutput | None = None
    noise: th.Tensor | None = None
    acted_with: tuple[th.Tensor, th.Tensor] | None = None
    context: HistoryContext | None = None
    context_of: TensorVersions = field(default_factory=TensorVersions)


class BeliefExtractor(BaseFeaturesExtractor):
    """
    Features of the observation and, beside them, the belief about the others: :class:`BeliefFeatures`.

    The history belongs to the weights: it is kept in buffers, and so is saved, loaded and moved with the policy. How the
    belief is drawn is said by :meth:`conditioned`; without it the belief is its mean.

    :param observation_space: The agent's observation space
    :param features: Extractor of the features of the observation itself
    :param belief: The belief network
    :param options: What the user says about the belief
    """

    history_observations: th.Tensor
    history_actions: th.Tensor
    history_valid: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Space,
        features: BaseFeaturesExtractor,
        belief: DynamicBelief,
        options: BeliefOptions,
    ) -> None:
        super().__init__(observation_space, features.features_dim + belief.latent_dim)
        self.features = features
        self.belief = belief
        self.options = options
        if belief.variant.attends:
            history = empty_history(options.history_length, belief.observation_dim, belief.action_dim)
            for name, rows in history._asdict().items():
                self.register_buffer(f"history_{name}", rows)
        self.passing = Passing()

    def __getstate__(self) -> dict[str, Any]:
        # What the last pass left behind is made again where it is needed
        return {**vars(self), "passing": Passing()}

    @property
    def history(self) -> History | None:
        """The history the belief is inferred from at present; None for a belief without one."""
        if not self.belief.variant.attends:
            return None
        return History(self.history_observations, self.history_actions, self.history_valid)

    def remember(self, observations: th.Tensor, actions: th.Tensor) -> None:
        """
        :param observations: Preprocessed flat observations of further steps, oldest first, ``[N, d_o]``
        :param actions: The others' actions at those steps, ``[N, W]``, zero where not visible
        """
        if self.history is not None:
            history = append_rows(self.history, observations, actions)
            self.history_observations, self.history_actions, self.history_valid = history

    @contextmanager
    def conditioned(
        self, noise: th.Tensor | None = None, kept: th.Tensor | None = None, sample: bool = False
    ) -> Iterator[None]:
        """
        How the belief of the passes within is drawn.

        :param noise: The noise of eq. 5, ``[B, z]``
        :param kept: The history rows to attend to, ``[B, N_h]``
        :param sample: Whether to draw the noise
        """
        self.passing.given = (noise, kept, sample)
        try:
            yield
        finally:
            self.passing.given = (None, None, False)

    def forward(self, observations: th.Tensor | TensorDict) -> BeliefFeatures:
        noise, kept, sample = self.passing.given
        flat = flatten_observation(observations)
        if sample:
            noise = self.draw_noise(flat)
        # Whoever acts asks for no prediction
        output = self.infer(flat, noise, kept, predict=th.is_grad_enabled())
        self.passing.output, self.passing.noise = output, noise
        return self.with_belief(self.features(observations), output)

    def draw_noise(self, flat: th.Tensor) -> th.Tensor | None:
        """
        :param flat: Preprocessed flat observations, ``[B, d_o]``
        :return: Noise for the beliefs about them, ``[B, z]``; None for a belief that does not sample
        """
        return th.randn(len(flat), self.belief.latent_dim, device=flat.device) if self.belief.variant.samples else None

    def with_belief(self, own: th.Tensor, output: BeliefOutput) -> BeliefFeatures:
        """
        :param own: Features of the observation
        :param output: The belief about it
        :return: Both, as the options want the belief
        """
        # The paper gives policy and value the sampled belief; the decoder predicts from it in any case
        latent = output.latent if self.options.policy_latent == "sample" else output.mean
        return BeliefFeatures(own, latent.detach() if self.options.detach_belief else latent)

    def infer(
        self, flat: th.Tensor, noise: th.Tensor | None = None, kept: th.Tensor | None = None, predict: bool = True
    ) -> BeliefOutput:
        """
        :param flat: Preprocessed flat observations, ``[B, d_o]``
        :param noise: The noise of eq. 5, ``[B, z]``; without it the belief is its mean
        :param kept: The history rows to attend to, ``[B, N_h]``; without them the most similar ones
        :param predict: Whether the others' actions are wanted
        :return: The belief, from the present history
        """
        history = self.history
        context = None if history is None or th.is_grad_enabled() else self.encoded(history)
        return self.belief(flat, history, noise, kept, context, predict)

    def encoded(self, history: History) -> HistoryContext:
        """
        Between two updates neither weights nor history change, so the encoded history is kept.

        :param history: The present one
        :return: The same as the network sees it, without gradients
        """
        passing = self.passing
        if passing.context_of.changed((*self.belief.context_parameters(), *history)) or passing.context is None:
            passing.context = self.belief.encode_history(history)
        return passing.context


class BeliefFusion(nn.Module):
    """
    Policy and value networks that fuse features and belief (Sec. 4.2): each has a base of its own on the features, beside
    whose output the shared belief is put, and a linear layer. The paper lets another linear layer follow at once, which
    would be one linear map; hence the activation between them.

    :param features_dim: Width of the features of the observation
    :param latent_dim: ``z``, width of the belief
    :param net_arch: Layers of the bases, as SB3 takes them; the fusion is as wide as the last one
    :param activation_fn: Activation within the bases
    :param fusion_activation_fn: Activation after the fusion; ``torch.nn.Identity`` for the paper's literal two linear layers
    :param device: Device of the weights
    """

    def __init__(
        self,
        features_dim: int,
        latent_dim: int,
        net_arch: list[int] | dict[str, list[int]],
        activation_fn: type[nn.Module],
        fusion_activation_fn: type[nn.Module],
        device: th.device | str,
    ) -> None:
        super().__init__()
        self.latent_dim = latent_dim
        self.base = MlpExtractor(features_dim, net_arch, activation_fn, device)
        self.latent_dim_pi = self.base.latent_dim_pi
        self.latent_dim_vf = self.base.latent_dim_vf
        self.fuse_pi = nn.Linear(self.latent_dim_pi + latent_dim, self.latent_dim_pi, device=device)
        self.fuse_vf = nn.Linear(self.latent_dim_vf + latent_dim, self.latent_dim_vf, device=device)
        self.activation = fusion_activation_fn()

    def forward(self, features: BeliefFeatures) -> tuple[th.Tensor, th.Tensor]:
        """
        :param features: Output of :class:`BeliefExtractor`
        :return: Latent codes of policy and value
        """
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features: BeliefFeatures) -> th.Tensor:
        return self.activation(self.fuse_pi(th.cat([self.base.forward_actor(features.own), features.latent], dim=-1)))

    def forward_critic(self, features: BeliefFeatures) -> th.Tensor:
        return self.activation(self.fuse_vf(th.cat([self.base.forward_critic(features.own), features.latent], dim=-1)))

    def belief_share(self) -> float:
        """
        :return: Summed absolute fusion weights on the belief over those on everything, in [0, 1] (Fig. 5e of the paper)
        """
        with th.no_grad():
            weights = [self.fuse_pi.weight.abs(), self.fuse_vf.weight.abs()]
            belief = sum(float(weight[:, -self.latent_dim :].sum()) for weight in weights)
            return belief / sum(float(weight.sum()) for weight in weights)
