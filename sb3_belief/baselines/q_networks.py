"""Policies of DQN that heed action masks, in acting and in the targets."""

from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.dqn.policies import CnnPolicy, DQNPolicy, MultiInputPolicy
from torch import nn

from sb3_belief.belief_ppo.buffers import attached


def possible_values(values: th.Tensor, masks: th.Tensor | None) -> th.Tensor:
    """
    Return values of which a maximum is that of a possible action.

    :param values: Values of all actions, ``[B, n_actions]``
    :param masks: Which actions are possible, bool ``[B, n_actions]``; None if all are
    :return: The values, minus infinity where an action is impossible
    """
    return values if masks is None else values.masked_fill(~masks, -th.inf)


class NextValue(nn.Module):
    """
    Target network that returns one column: the value of the action that is chosen at the next observation.

    The action is the best of those that are possible there, by the online network (double Q) or by the target network itself;
    of equal ones that of the lowest index. SB3 takes the maximum of whatever columns a target network returns, which of one
    column is that column, so its ``train()`` need not be copied.

    :param target: The target network, whose weights these are
    :param online: The online network, which is no part of this module: SB3 pairs the parameters of the two
    """

    def __init__(self, target: nn.Module, online: nn.Module):
        super().__init__()
        self.target = target
        self._online = (online,)
        #: Whether the online network chooses the action (van Hasselt et al. 2016)
        self.double_q = True

    def forward(self, obs: PyTorchObs) -> th.Tensor:
        """
        Return the value of the next action.

        :param obs: Next observations, with the masks attached; without any, all actions are possible
        :return: ``[B, 1]``
        """
        values = self.target(obs)
        choosing = self._online[0](obs) if self.double_q else values
        return values.gather(1, possible_values(choosing, attached(obs)).argmax(dim=1, keepdim=True))


if TYPE_CHECKING:
    _Policy = DQNPolicy
else:
    _Policy = object


class MaskedQPolicyMixin(_Policy):
    """Makes a policy of DQN one that heeds action masks."""

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        self.q_net_target: Any = NextValue(self.q_net_target, self.q_net)

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
        action_masks: np.ndarray | None = None,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        Return the best possible action of each observation; of equal ones that of the lowest index.

        :param observation: One observation or a batch of them
        :param state: Not used, since the policy is not recurrent
        :param episode_start: Not used
        :param deterministic: Not used: the policy itself is greedy
        :param action_masks: Which actions are possible, bool ``[B, n_actions]`` or ``[n_actions]``; None if all are
        :return: The action(s), and ``state``
        """
        if action_masks is None:
            return super().predict(observation, state, episode_start, deterministic)
        self.set_training_mode(False)
        obs, is_batch = self.obs_to_tensor(observation)
        masks = th.as_tensor(np.asarray(action_masks, dtype=bool), device=self.device).reshape(-1, int(self.action_space.n))  # type: ignore[attr-defined]
        with th.no_grad():
            actions = possible_values(self.q_net(obs), masks).argmax(dim=1).cpu().numpy()
        return (actions if is_batch else actions.squeeze(axis=0)), state


class MaskedQPolicy(MaskedQPolicyMixin, DQNPolicy):
    """SB3's ``MlpPolicy`` of DQN, with masks."""


class MaskedQCnnPolicy(MaskedQPolicyMixin, CnnPolicy):
    """SB3's ``CnnPolicy`` of DQN, with masks."""


class MaskedQMultiInputPolicy(MaskedQPolicyMixin, MultiInputPolicy):
    """SB3's ``MultiInputPolicy`` of DQN, with masks."""
