"""DPIQN and DRPIQN: Q-learning on features that also predict what the others do."""

from typing import Any, ClassVar, TypeVar

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_belief.baselines.inference_networks import (
    InferenceCnnPolicy,
    InferenceMultiInputPolicy,
    InferencePolicy,
    RecurrentInferencePolicy,
)
from sb3_belief.baselines.iql import IQL
from sb3_belief.baselines.others_replay import OthersDictReplayBuffer, OthersReplayBuffer, OthersReplayMixin
from sb3_belief.belief_ppo.buffers import read_others
from sb3_belief.belief_ppo.others import ActionSpaces, action_layout, check_same_others, others_of
from sb3_belief.common.kept_attributes import kept_attributes

SelfDPIQN = TypeVar("SelfDPIQN", bound="DPIQN")


class DPIQN(IQL):
    """
    Deep Policy Inference Q-Network (Hong et al. 2018, "A Deep Policy Inference Q-Network for Multi-Agent Systems"): the
    features from which the values are computed are multiplied with features that predict the others' actions of the same step.

        ``e = trunk(o)    g = leaky(W_q e)    p = leaky(W_p e)    logits_j = W_j p    Q = W (g * p)``

        ``L = lambda L_Q + L_PI,    lambda = 1 / sqrt(L_PI)``, of which no gradient is taken

    ``L_Q`` is the loss of :class:`~sb3_belief.baselines.iql.IQL`, and ``L_PI`` the cross-entropy of the visible others'
    actions, averaged over these and times the number of others: with all visible it is the sum over them, as in the authors'
    code. ``lambda`` grows without bound as ``L_PI`` falls; ``inference_floor`` bounds it. In a minibatch in which no other is
    visible it is 1.

    :param args: As of ``IQL``
    :param inference_floor: Least value of ``L_PI`` in ``lambda``, > 0
    :param kwargs: As of ``IQL``. The trunk is ``policy_kwargs["net_arch"]``; its last width is that of g and p, too
    :raises ValueError: If the environment names no others, one of them has actions that are numbers (Box), or the floor is not
        positive
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": InferencePolicy,
        "CnnPolicy": InferenceCnnPolicy,
        "MultiInputPolicy": InferenceMultiInputPolicy,
    }
    others_action_spaces: ActionSpaces

    def __init__(self, *args: Any, inference_floor: float = 0.01, **kwargs: Any) -> None:
        if not inference_floor > 0:
            raise ValueError(
                f"inference_floor={inference_floor!r} must be greater than 0: the weight 1 / sqrt(L_PI) is unbounded."
            )
        self.inference_floor = inference_floor
        self.others_action_spaces = {}
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        if self.others_action_spaces and self.env is not None:
            check_same_others(self.env, self.others_action_spaces)
        elif self.env is not None:
            self.others_action_spaces = self._checked_others(self.env)
        is_dict = isinstance(self.observation_space, spaces.Dict)
        self.replay_buffer_class = OthersDictReplayBuffer if is_dict else OthersReplayBuffer
        layout = action_layout(self.others_action_spaces)
        widths = {"others_width": layout.width, "n_others": layout.n_others}
        with kept_attributes(self, "policy_kwargs", "replay_buffer_kwargs"):
            self.policy_kwargs = {**self.policy_kwargs, "others_action_spaces": self.others_action_spaces}
            self.replay_buffer_kwargs = {**self.replay_buffer_kwargs, **widths}
            super()._setup_model()
        network: Any = self.q_net
        network.inference_floor = self.inference_floor

    def _checked_others(self, env: VecEnv) -> ActionSpaces:
        others, name = others_of(env), type(self).__name__
        if not others:
            raise ValueError(
                f"The environment names no others, whose actions {name} predicts: let it learn in a Team of several agents,"
                " bring 'others_action_spaces', or take IQL."
            )
        numbers = [other for other, space in others.items() if isinstance(space, spaces.Box)]
        if numbers:
            raise ValueError(
                f"{name} predicts the others' actions by their probabilities, and {numbers} have actions that are numbers"
                f" ({others[numbers[0]]}). Take IQL, or give them discrete actions."
            )
        return others

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        check_same_others(self._wrap_env(env, verbose=0), self.others_action_spaces)
        super().set_env(env, force_reset)

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        assert isinstance(replay_buffer, OthersReplayMixin)
        network: Any = self.q_net
        replay_buffer.stage_others(*read_others(infos, network.layout))
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """
        Update as SB3's DQN does; the values of each minibatch bring the loss of the prediction along.

        ``train/loss`` is ``L_Q``, ``train/inference_loss`` is ``L_PI`` and ``train/adaptive_weight`` is ``lambda``, all means
        over the minibatches.

        :param gradient_steps: Number of minibatches
        :param batch_size: Rows of each
        """
        network: Any = self.q_net
        network.recorded = []
        super().train(gradient_steps, batch_size)
        loss, weight = np.mean(network.recorded, axis=0)
        self.logger.record("train/inference_loss", float(loss))
        self.logger.record("train/adaptive_weight", float(weight))

    def learn(
        self: SelfDPIQN,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "DPIQN",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfDPIQN:
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)


class DRPIQN(DPIQN):
    """
    Deep Recurrent Policy Inference Q-Network (Hong et al. 2018): :class:`DPIQN` in which g and p of the last observations go
    through an LSTM each, from a state of zeros.

    The window belongs to the environment: ``make_team_env(..., observe_window=12)`` lets each agent observe its last twelve
    observations, ``[12, d]``, zeros before the beginning of its own episode. So neither the replay buffer nor ``predict`` has
    a recurrent state.

    :param args: As of :class:`DPIQN`
    :param kwargs: As of :class:`DPIQN`
    :raises ValueError: If observations are no windows, or as for ``DPIQN``
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": RecurrentInferencePolicy}

    def _setup_model(self) -> None:
        if len(self.observation_space.shape or ()) != 2:
            raise ValueError(
                f"DRPIQN reads windows of observations, [L, d], and the observation space is {self.observation_space}: make"
                " the environment with make_team_env(..., observe_window=12), or set observe_window: 12 in the YAML file."
            )
        super()._setup_model()

    def learn(
        self: SelfDPIQN,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "DRPIQN",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfDPIQN:
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
