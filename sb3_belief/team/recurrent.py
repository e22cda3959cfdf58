"""RecurrentPPO of sb3-contrib with a memory that lasts for as long as a partner stays, over the ends of episodes."""

from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from sb3_contrib import RecurrentPPO
from sb3_contrib.common.recurrent.policies import RecurrentMultiInputActorCriticPolicy
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import MaybeCallback

from sb3_belief.vec_env.observe_last import MEMORY_START


def memory_starts(obs: Any) -> th.Tensor:
    """
    Return where the memory starts anew.

    :param obs: Observations with the entry ``memory_start``, ``[B, 1]``
    :return: 1 where it does, otherwise 0, float ``[B]``
    """
    return obs[MEMORY_START].float().flatten()


class PartnerMemoryPolicy(RecurrentMultiInputActorCriticPolicy):
    """
    Policy of sb3-contrib whose LSTM starts anew where the observation says so, instead of where episodes start.

    So the memory is the same wherever the policy acts: in training, in evaluations, as a partner, and when it is deployed.
    """

    def forward(  # type: ignore[override]
        self, obs: Any, lstm_states: Any, episode_starts: th.Tensor, deterministic: bool = False
    ) -> Any:
        return super().forward(obs, lstm_states, memory_starts(obs), deterministic)

    def get_distribution(self, obs: Any, lstm_states: Any, episode_starts: th.Tensor) -> Any:  # type: ignore[override]
        return super().get_distribution(obs, lstm_states, memory_starts(obs))

    def predict_values(self, obs: Any, lstm_states: Any, episode_starts: th.Tensor) -> th.Tensor:  # type: ignore[override]
        return super().predict_values(obs, lstm_states, memory_starts(obs))

    def evaluate_actions(  # type: ignore[override]
        self, obs: Any, actions: th.Tensor, lstm_states: Any, episode_starts: th.Tensor
    ) -> Any:
        return super().evaluate_actions(obs, actions, lstm_states, memory_starts(obs))


class PartnerRecurrentPPO(RecurrentPPO):
    """
    ``RecurrentPPO`` whose memory lasts over the episodes that it plays with one partner, ``memory_span: partner`` in YAML.

    sb3-contrib's own starts the LSTM anew with each episode. Here it starts anew where the observation's entry
    ``memory_start`` is 1, which ``make_team_env(partner_starts=True)`` and ``ObserveLast(partner_starts=True)`` add. Returns
    and advantages still end with the episodes, and are bootstrapped at limits. Gradients pass through the memory from one
    episode to the one before, within a rollout; so let ``n_steps`` hold the episodes of a partner.

    All arguments are those of ``RecurrentPPO``. Its policies are the same one, since observations are always a ``Dict`` here.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = dict.fromkeys(RecurrentPPO.policy_aliases, PartnerMemoryPolicy)

    def _setup_model(self) -> None:
        if not (isinstance(self.observation_space, spaces.Dict) and MEMORY_START in self.observation_space.spaces):
            raise ValueError(
                f"{type(self).__name__} needs observations that say where another partner has come, in the entry"
                f" {MEMORY_START!r}, got {self.observation_space}: make_team_env(..., partner_starts=True), or"
                " ObserveLast(..., partner_starts=True) around an AgentEnv."
            )
        if not issubclass(self.policy_class, PartnerMemoryPolicy):
            raise ValueError(
                f"{type(self).__name__} needs a policy whose memory starts where the observation says so, derived from"
                f" {PartnerMemoryPolicy.__name__}, not {self.policy_class.__name__}."
            )
        super()._setup_model()

    def train(self) -> None:
        """Update the policy as ``RecurrentPPO`` does, on sequences that begin where the memory starts anew."""
        # The returns have been computed by the starts of episodes. From here on these are only read to cut the rollout into
        # sequences, of which each begins with the state that was stored
        buffer: Any = self.rollout_buffer
        buffer.episode_starts = buffer.observations[MEMORY_START][..., 0].astype(np.float32)
        super().train()

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "PartnerRecurrentPPO",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Any:
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
