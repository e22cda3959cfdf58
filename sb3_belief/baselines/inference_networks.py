"""Q-networks of which a part predicts the others' actions."""

from collections.abc import Mapping
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.dqn.policies import CnnPolicy, DQNPolicy, MultiInputPolicy, QNetwork
from torch import nn

from sb3_belief.baselines.others_replay import OthersMinibatch
from sb3_belief.baselines.q_networks import MaskedQPolicyMixin
from sb3_belief.belief.loss import cross_entropy
from sb3_belief.belief_ppo.buffers import attached
from sb3_belief.belief_ppo.others import action_layout
from sb3_belief.belief_ppo.policies import add_loss


class InferenceQNetwork(QNetwork):
    """
    Network of DPIQN: ``e = trunk(o)``, ``g = leaky(W_q e)``, ``p = leaky(W_p e)``, ``Q = W (g * p)``, ``logits_j = W_j p``.

    Where a minibatch has the others' actions attached to its observations, the returned values add the loss of their
    prediction to whatever loss is computed from them (see :func:`~sb3_belief.belief_ppo.policies.add_loss`).

    :param args: As of SB3's ``QNetwork``
    :param others_action_spaces: The others' action spaces, in order
    :param kwargs: As of SB3's ``QNetwork``. The last width of ``net_arch`` is that of g and p, too; without any it is that of
        the features
    """

    #: Least value of the prediction's loss in the weight, set by the algorithm
    inference_floor = 0.01

    def __init__(self, *args: Any, others_action_spaces: Mapping[str, spaces.Space], **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.layout = action_layout(others_action_spaces)
        #: Loss and weight of each minibatch since the algorithm has read them
        self.recorded: list[tuple[float, float]] = []
        n_actions, width = int(self.action_space.n), self._width
        self.q_net = nn.Sequential(*create_mlp(self._trunk_width, -1, self.net_arch, self.activation_fn))
        self.value_features = nn.Sequential(nn.Linear(width, width), nn.LeakyReLU())
        self.policy_features = nn.Sequential(nn.Linear(width, width), nn.LeakyReLU())
        self.values = nn.Linear(width, n_actions)
        self.others = nn.Linear(width, self.layout.width)

    @property
    def _trunk_width(self) -> int:
        return self.features_dim

    @property
    def _width(self) -> int:
        # Without a layer of its own, as behind a convolutional network, the trunk is what it is given
        return int([self._trunk_width, *self.net_arch][-1])

    def features(self, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor]:
        """
        Return the two kinds of features.

        :param obs: Observations
        :return: ``g`` and ``p``, each ``[B, h]``
        """
        trunk = self.q_net(self.extract_features(obs, self.features_extractor))
        return self.value_features(trunk), self.policy_features(trunk)

    def forward(self, obs: PyTorchObs) -> th.Tensor:
        """
        Return the values of all actions.

        :param obs: Observations; with an :class:`OthersMinibatch` attached the values add the prediction's loss
        :return: ``[B, n_actions]``
        """
        value_features, policy_features = self.features(obs)
        values, others = self.values(value_features * policy_features), attached(obs)
        if not isinstance(others, OthersMinibatch):
            return values
        loss = self.inference_loss(self.others(policy_features), others)
        weight = self.adaptive_weight(loss, others)
        self.recorded.append((loss.item(), weight.item()))
        return add_loss(values, loss, scale=weight)

    def inference_loss(self, logits: th.Tensor, others: OthersMinibatch) -> th.Tensor:
        """
        Return ``L_PI``: the mean cross-entropy of the visible others' actions, times the number of others.

        :param logits: ``[B, W]``
        :param others: What the minibatch holds of the others
        :return: A scalar, zero if no other is visible
        """
        return self.layout.n_others * cross_entropy(logits, others.actions, others.visible, self.layout)

    def adaptive_weight(self, loss: th.Tensor, others: OthersMinibatch) -> th.Tensor:
        """
        Return ``lambda``, the weight of the loss of the values.

        :param loss: ``L_PI``
        :param others: What the minibatch holds of the others
        :return: A scalar without a gradient, ``1 / sqrt(L_PI)``, and 1 if no other is visible
        """
        weight = loss.detach().clamp(min=self.inference_floor).rsqrt()
        return weight if others.visible.any() else th.ones_like(weight)

    def predict_others(self, obs: PyTorchObs) -> th.Tensor:
        """
        Return what is predicted of the others.

        :param obs: Observations
        :return: Logits of their actions, encoded side by side, ``[B, W]``
        """
        return self.others(self.features(obs)[1])


class RecurrentInferenceQNetwork(InferenceQNetwork):
    """
    Network of DRPIQN: ``g`` and ``p`` of each observation of a window go through an LSTM each, from a state of zeros, and the
    last outputs take their places.

    :param args: As of :class:`InferenceQNetwork`, for observations ``[L, d]``
    :param kwargs: As of :class:`InferenceQNetwork`
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        width = self._width
        self.value_memory, self.policy_memory = (
            nn.LSTM(width, width, batch_first=True),
            nn.LSTM(width, width, batch_first=True),
        )

    @property
    def _trunk_width(self) -> int:
        return int(self.observation_space.shape[1])  # type: ignore[index]

    def features(self, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor]:
        flat = self.extract_features(obs, self.features_extractor)
        trunk = self.q_net(flat.reshape(len(flat), *self.observation_space.shape))  # type: ignore[misc]
        values, _ = self.value_memory(self.value_features(trunk))
        policies, _ = self.policy_memory(self.policy_features(trunk))
        return values[:, -1], policies[:, -1]


class InferencePolicyMixin(MaskedQPolicyMixin):
    """
    Makes a policy of DQN one with a network that predicts the others.

    :param args: As of SB3's policy
    :param others_action_spaces: The others' action spaces, in order
    :param kwargs: As of SB3's policy
    """

    network: type[InferenceQNetwork] = InferenceQNetwork

    def __init__(self, *args: Any, others_action_spaces: Mapping[str, spaces.Space], **kwargs: Any) -> None:
        # Before SB3's constructor, which builds the networks
        self._others_action_spaces = dict(others_action_spaces)
        super().__init__(*args, **kwargs)

    def make_q_net(self) -> QNetwork:
        """Return a network of the policy's kind, as SB3 makes it."""
        net_args = self._update_features_extractor(self.net_args, features_extractor=None)
        return self.network(**net_args, others_action_spaces=self._others_action_spaces).to(self.device)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "others_action_spaces": self._others_action_spaces}


class InferencePolicy(InferencePolicyMixin, DQNPolicy):
    """``MlpPolicy`` of DPIQN."""


class InferenceCnnPolicy(InferencePolicyMixin, CnnPolicy):
    """``CnnPolicy`` of DPIQN."""


class InferenceMultiInputPolicy(InferencePolicyMixin, MultiInputPolicy):
    """``MultiInputPolicy`` of DPIQN."""


class RecurrentInferencePolicy(InferencePolicy):
    """``MlpPolicy`` of DRPIQN, for windows of observations ``[L, d]``."""

    network = RecurrentInferenceQNetwork
