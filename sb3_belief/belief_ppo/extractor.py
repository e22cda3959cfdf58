"""The features extractor that infers a belief about the others beside the features of the observation, and their fusion."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import is_image_space, preprocess_obs
from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
    CombinedExtractor,
    FlattenExtractor,
    MlpExtractor,
    NatureCNN,
)
from stable_baselines3.common.type_aliases import PyTorchObs, TensorDict
from stable_baselines3.common.utils import obs_as_tensor
from torch import nn

from sb3_belief.belief import BeliefOutput, DynamicBelief, History, HistoryContext, append_rows, empty_history
from sb3_belief.belief_ppo.buffers import BeliefMinibatch
from sb3_belief.belief_ppo.options import BeliefOptions
from sb3_belief.common.kept_tensors import KeptTensors

# The least height and width of which NatureCNN's convolutions leave anything
_MIN_IMAGE_SIZE = 36


def fitting_extractor(observation_space: spaces.Space) -> type[BaseFeaturesExtractor]:
    """
    Return the features extractor of that policy of SB3 which is meant for an observation space.

    :param observation_space: Of the agent
    :return: The class
    """
    if isinstance(observation_space, spaces.Dict):
        return CombinedExtractor
    if isinstance(observation_space, spaces.Box) and is_image_space(observation_space):
        _, height, width = observation_space.shape
        if min(height, width) >= _MIN_IMAGE_SIZE:
            return NatureCNN
    return FlattenExtractor


def flatten_observation(observation: th.Tensor | TensorDict) -> th.Tensor:
    """
    Flatten observations.

    :param observation: Preprocessed observations (batch first), or a dict of them
    :return: One row for each, ``[B, d_o]``; the parts of a dict in the order of its keys
    """
    if isinstance(observation, dict):
        return th.cat([observation[key].flatten(1).float() for key in sorted(observation)], dim=1)
    return observation.flatten(1).float()


def flat_observations(policy: BasePolicy, observations: PyTorchObs) -> th.Tensor:
    """
    Preprocess observations as SB3 does, and flatten them.

    :param policy: The policy that observes
    :param observations: As the environment returns them, batch first
    :return: ``[B, d_o]``
    """
    return flatten_observation(preprocess_obs(observations, policy.observation_space, policy.normalize_images))


def rollout_rows(observations: Any, rows: tuple[np.ndarray, ...], device: th.device) -> PyTorchObs:
    """
    Return some rows of a rollout's observations as tensors.

    :param observations: Of the rollout buffer: an array, or a dict of arrays
    :param rows: Index into its first dimensions, as of ``BeliefBufferMixin.rows_of``
    :param device: Device of the tensors
    """
    is_dict = isinstance(observations, dict)
    return obs_as_tensor({k: v[rows] for k, v in observations.items()} if is_dict else observations[rows], device)


@dataclass(slots=True)
class BeliefPass:
    """
    How the belief of one forward pass is drawn, and what came of it.

    A method of the policy makes it and passes it on with the observations; the extractor fills in ``noise``, ``output`` and
    ``features``; the same method reads them when the pass is over, and drops it.

    :param noise: The noise of eq. 5, ``[B, z]``; None for the mean of the belief
    :param selected: The history rows to attend to, ``[B, N_h]``; None for the most similar ones
    :param sample: Whether to draw the noise in this pass
    :param acts: Whether it is a pass of the agent's own rollout, which a belief that is online attends to
    :param stamps: When and where the observations were made, for a belief that is online, int64 ``[B, 3]``
    :param output: The belief
    :param features: What policy and value are computed from
    """

    noise: th.Tensor | None = None
    selected: th.Tensor | None = None
    sample: bool = False
    acts: bool = False
    stamps: th.Tensor | None = None
    output: BeliefOutput | None = None
    features: Any = None


class BeliefFeatures(NamedTuple):
    """
    What policy and value are computed from. These are two tensors instead of one because SB3 only passes them on, and because
    the features of most observations need no gradient, which they would get in one tensor with the belief.

    :param own: Features of the observation, ``[B, features]``
    :param latent: The belief about the others, ``[B, z]``
    """

    own: th.Tensor
    latent: th.Tensor


class BeliefExtractor(BaseFeaturesExtractor):
    """
    Features of the observation and, beside them, the belief about the others: :class:`BeliefFeatures`; or both in one tensor,
    for a policy whose class overrides ``_build_mlp_extractor`` with another network than :class:`BeliefFusion`.

    The history belongs to the weights: it is kept in buffers, and so is saved, loaded and moved with the policy.

    :param observation_space: The agent's observation space
    :param features: Extractor of the features of the observation itself
    :param belief: The belief network
    :param options: The user's options of the belief
    :param from_features: Whether belief and history see these features instead of the observation itself
    """

    #: Whether features and belief are returned in one tensor
    in_one_tensor = False

    history_observations: th.Tensor
    history_actions: th.Tensor
    history_valid: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Space,
        features: BaseFeaturesExtractor,
        belief: DynamicBelief,
        options: BeliefOptions,
        from_features: bool = False,
    ) -> None:
        super().__init__(observation_space, features.features_dim + belief.latent_dim)
        self.features = features
        self.belief = belief
        #: Width of what policy and value are given of the belief
        self.belief_width = belief.latent_dim
        self.options = options
        self.from_features = from_features
        if belief.variant.attends:
            for name, rows in self._empty_history()._asdict().items():
                self.register_buffer(f"history_{name}", rows)
        self._context: HistoryContext | None = None
        self._context_inputs = KeptTensors()

    def _empty_history(self) -> Any:
        return empty_history(self.options.history_length, self.belief.observation_dim, self.belief.action_dim)

    def __getstate__(self) -> dict[str, Any]:
        # The encoded history is made again where it is needed
        return {**vars(self), "_context": None, "_context_inputs": KeptTensors()}

    @property
    def history(self) -> History | None:
        """The history from which the belief is inferred at present; None for a belief without one."""
        if not self.belief.variant.attends:
            return None
        return History(self.history_observations, self.history_actions, self.history_valid)

    def remember(self, observations: th.Tensor, actions: th.Tensor) -> None:
        """
        Append steps to the history.

        :param observations: Preprocessed flat observations, oldest first, ``[N, d_o]``
        :param actions: The others' actions at those steps, ``[N, W]``, zero where not visible
        """
        if self.history is not None:
            self.restore_history(append_rows(self.history, observations, actions))

    def restore_history(self, history: History) -> None:
        """
        Replace the history.

        :param history: Another one of the same shapes
        """
        self.history_observations, self.history_actions, self.history_valid = history

    def forward(
        self, observations: th.Tensor | TensorDict, belief_pass: BeliefPass | None = None
    ) -> BeliefFeatures | th.Tensor:
        """
        Infer the belief and extract the features.

        :param observations: Preprocessed observations
        :param belief_pass: How to draw the belief; None for its mean
        :return: Features and belief, as of :meth:`with_belief`
        """
        belief_pass = belief_pass or BeliefPass()
        own = self.features(observations)
        flat = own if self.from_features else flatten_observation(observations)
        belief_pass.output = self.believe(flat, belief_pass)
        belief_pass.features = self.with_belief(own, belief_pass.output)
        return belief_pass.features

    def believe(self, flat: th.Tensor, belief_pass: BeliefPass) -> BeliefOutput:
        """
        Infer the belief of a pass.

        :param flat: Preprocessed flat observations, ``[B, d_o]``
        :param belief_pass: How to draw it
        :return: The belief
        """
        if belief_pass.sample:
            belief_pass.noise = self.draw_noise(flat)
        # While acting, no prediction is needed
        return self.infer(flat, belief_pass.noise, belief_pass.selected, predict=th.is_grad_enabled())

    def draw_noise(self, flat: th.Tensor) -> th.Tensor | None:
        """
        Draw the noise of eq. 5.

        :param flat: Preprocessed flat observations, ``[B, d_o]``
        :return: Noise for the beliefs about them, ``[B, z]``; None for a belief that does not sample
        """
        return th.randn(len(flat), self.belief.latent_dim, device=flat.device) if self.belief.variant.samples else None

    def with_belief(self, own: th.Tensor, output: BeliefOutput) -> BeliefFeatures | th.Tensor:
        """
        Put the belief beside the features.

        :param own: Features of the observation
        :param output: The belief
        :return: Both, the belief as the options want it; in one tensor ``[B, features_dim]`` if ``in_one_tensor``
        """
        # The paper gives policy and value the sampled belief; the decoder predicts from it in any case
        return self._beside(own, output.latent if self.options.policy_latent == "sample" else output.mean)

    def _beside(self, own: th.Tensor, latent: th.Tensor) -> BeliefFeatures | th.Tensor:
        features = BeliefFeatures(own, latent.detach() if self.options.detach_belief else latent)
        return th.cat(features, dim=-1) if self.in_one_tensor else features

    def infer(
        self, flat: th.Tensor, noise: th.Tensor | None = None, selected: th.Tensor | None = None, predict: bool = True
    ) -> BeliefOutput:
        """
        Infer the belief from the present history.

        :param flat: Preprocessed flat observations, ``[B, d_o]``
        :param noise: The noise of eq. 5, ``[B, z]``; None for the mean of the belief
        :param selected: The history rows to attend to, ``[B, N_h]``; None for the most similar ones
        :param predict: Whether to predict the others' actions
        :return: The belief
        """
        history = self.history
        # An update changes the weights with each minibatch and needs their gradients, so it encodes the history each time
        context = None if history is None or th.is_grad_enabled() else self.encoded(history)
        return self.belief(flat, history, noise, selected, context, predict)

    def context(self) -> Any:
        """Return the encoded history; None for a belief without one."""
        return None if self.history is None else self.belief.encode_history(self.history)

    def infer_from(self, context: Any, flat: th.Tensor) -> BeliefOutput:
        """
        Infer the mean of the belief from an encoded history.

        :param context: As of :meth:`context`
        :param flat: Preprocessed flat observations, ``[B, d_o]``
        :return: The belief
        """
        return self.belief(flat, context=context)

    def attended(self) -> History | None:
        """Return what the rows of an update attend to."""
        return self.history

    def judged(self, flat: th.Tensor, minibatch: BeliefMinibatch, history: Any = None) -> BeliefOutput:
        """
        Infer the belief of a minibatch as it was while acting.

        :param flat: Its preprocessed flat observations, ``[B, d_o]``
        :param minibatch: Its noise and the rows it attended to
        :param history: What it attends to instead of :meth:`attended`
        :return: The belief
        """
        if history is None:
            return self.infer(flat, minibatch.noise, minibatch.selected)
        return self.belief(flat, history, minibatch.noise, minibatch.selected)

    def encoded(self, history: History) -> HistoryContext:
        """
        Return the encoded history. It is kept, because between two updates neither weights nor history change.

        :param history: The present one
        :return: The same as the network sees it, without gradients
        """
        if self._context_inputs.changed((*self.belief.context_parameters(), *history)) or self._context is None:
            self._context = self.belief.encode_history(history)
        return self._context


class BeliefFusion(nn.Module):
    """
    Policy and value networks that fuse features and belief (Sec. 4.2): each has a base of its own on the features, whose
    output is concatenated with the shared belief and fed to a linear layer. The paper lets another linear layer follow at
    once, which would be one linear map; hence the activation between them.

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
        Fuse features and belief for policy and value.

        :param features: Output of :class:`BeliefExtractor`
        :return: Latent codes of policy and value
        """
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features: BeliefFeatures) -> th.Tensor:
        """
        Fuse features and belief for the policy.

        :param features: Output of :class:`BeliefExtractor`
        :return: Latent code of the policy
        """
        return self.activation(self.fuse_pi(th.cat([self.base.forward_actor(features.own), features.latent], dim=-1)))

    def forward_critic(self, features: BeliefFeatures) -> th.Tensor:
        """
        Fuse features and belief for the value.

        :param features: Output of :class:`BeliefExtractor`
        :return: Latent code of the value
        """
        return self.activation(self.fuse_vf(th.cat([self.base.forward_critic(features.own), features.latent], dim=-1)))

    def belief_share(self) -> float:
        """
        Return how much the fusion weighs the belief (Fig. 5e of the paper).

        :return: Summed absolute fusion weights on the belief over those on everything, in [0, 1]
        """
        with th.no_grad():
            weights = [self.fuse_pi.weight.abs(), self.fuse_vf.weight.abs()]
            belief = sum(float(weight[:, -self.latent_dim :].sum()) for weight in weights)
            return belief / sum(float(weight.sum()) for weight in weights)
