"""Independent Q-learning: SB3's DQN for an agent of a team, with double Q-learning and action masks."""

from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.dqn.dqn import DQN

from sb3_belief.baselines.masked_replay import MaskedDictReplayBuffer, MaskedReplayBuffer, MaskedReplayMixin
from sb3_belief.baselines.q_networks import MaskedQCnnPolicy, MaskedQMultiInputPolicy, MaskedQPolicy
from sb3_belief.common.action_masks import env_masks
from sb3_belief.common.checks import check_integer
from sb3_belief.common.safe_files.algorithm import SafeFilesMixin

SelfIQL = TypeVar("SelfIQL", bound="IQL")
# SB3's default
_EXPLORATION_FRACTION = 0.1


class IQL(SafeFilesMixin, DQN):
    """
    Independent Q-learning (Tan 1993) with a deep network (Mnih et al. 2015): each agent learns its own values, and the others
    are part of its environment. The target of an action u at the observation o is

        ``y = r + gamma * (1 - end) * Q_target(o', argmax of Q(o', u') over the possible u')``

    (double Q-learning, van Hasselt et al. 2016), and the loss SB3's Huber loss. ``end`` is the end of the agent's own return;
    at a truncation the target goes on from the last observation and its masks. It differs from SB3's DQN in this:

    - Action masks, where the environment gives them, are heeded in acting, in random actions, in the warm-up and in the
      target. A truncated episode's last masks come as ``info["terminal_action_masks"]``; where an environment does not say
      them, all actions count as possible there.
    - Each copy of the environment tosses its own coin for exploration. SB3's DQN tosses one for all copies.
    - Steps before the agent's first life and between two, in which it is out of play, are not learned from. Those of a dead
      agent whose return runs on are: its only action has a value, on which the target before its death relies.

    Without masks, with ``double_q=False`` and one copy it is SB3's DQN, weight for weight.

    :param policy: ``"MlpPolicy"``, ``"CnnPolicy"`` or ``"MultiInputPolicy"``, or a subclass of one of those in ``q_networks``
    :param env: The environment, with ``Discrete`` actions; in a ``Team`` the agent's own
    :param learning_rate: Learning rate, or a schedule of it
    :param buffer_size: Number of transitions in the replay buffer, of all copies together
    :param learning_starts: Number of steps before the first update, with random actions
    :param batch_size: Size of a minibatch
    :param tau: Share of the online network in the target network when that is updated, 1 for a copy
    :param gamma: Discount factor
    :param train_freq: An update follows each ``train_freq`` steps of all copies
    :param gradient_steps: Minibatches of an update; -1 for as many as there were steps
    :param target_update_interval: Steps between two updates of the target network, those of all copies counted
    :param exploration_fraction: Share of the training in which epsilon falls
    :param exploration_initial_eps: Epsilon at first
    :param exploration_final_eps: Epsilon in the end
    :param max_grad_norm: Largest norm of the gradient
    :param double_q: Whether the online network chooses the action of the target
    :param exploration_steps: Steps of all copies in which epsilon falls, at least 1, however long the training is, as in the
        references whose training is centralised; None for a share of the training, ``exploration_fraction``
    :param replay_buffer_kwargs: Further arguments of the replay buffer
    :param stats_window_size: Number of episodes over which logged returns are averaged
    :param tensorboard_log: Folder of the TensorBoard log; None for none
    :param policy_kwargs: Arguments of the policy. By default two layers of 64 with ReLU
    :param verbose: 0 for no output, 1 for what is wrapped and which device is used, 2 for debugging
    :param seed: Seed of the random numbers
    :param device: Device of the networks
    :param _init_setup_model: Whether to build the networks, internal to SB3
    :raises ValueError: If ``exploration_steps`` is not a positive integer, or given beside an ``exploration_fraction``
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MaskedQPolicy,
        "CnnPolicy": MaskedQCnnPolicy,
        "MultiInputPolicy": MaskedQMultiInputPolicy,
    }
    #: Masks are heeded where there are any; sb3-contrib's algorithms with masks cannot do without
    needs_action_masks = False

    def __init__(
        self,
        policy: str | type[MaskedQPolicy],
        env: GymEnv | str | None,
        learning_rate: float | Schedule = 5e-4,
        buffer_size: int = 100_000,
        learning_starts: int = 1_000,
        batch_size: int = 128,
        tau: float = 1.0,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 8,
        gradient_steps: int = 1,
        target_update_interval: int = 10_000,
        exploration_fraction: float = _EXPLORATION_FRACTION,
        exploration_initial_eps: float = 1.0,
        exploration_final_eps: float = 0.05,
        max_grad_norm: float = 10,
        double_q: bool = True,
        exploration_steps: int | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        if exploration_steps is not None:
            check_integer("exploration_steps", exploration_steps, 1, "the steps in which epsilon falls")
            if exploration_fraction != _EXPLORATION_FRACTION:
                raise ValueError(
                    f"exploration_fraction={exploration_fraction} and exploration_steps={exploration_steps} both say how long"
                    " epsilon falls; leave one of them out, or give exploration_steps=None."
                )
        self.double_q, self.exploration_steps = double_q, exploration_steps
        #: Whether the environment has given masks, without which the agent then acts otherwise than in training
        self.learned_with_masks = False
        # Where the agent's own return runs: since the first step of a life in which it was in play, bool [n_envs]
        self._return_runs = np.zeros(0, dtype=bool)
        super().__init__(
            policy,
            env,  # type: ignore[arg-type]
            learning_rate=learning_rate,
            buffer_size=buffer_size,
            learning_starts=learning_starts,
            batch_size=batch_size,
            tau=tau,
            gamma=gamma,
            train_freq=train_freq,
            gradient_steps=gradient_steps,
            replay_buffer_kwargs=replay_buffer_kwargs,
            target_update_interval=target_update_interval,
            exploration_fraction=exploration_fraction,
            exploration_initial_eps=exploration_initial_eps,
            exploration_final_eps=exploration_final_eps,
            max_grad_norm=max_grad_norm,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=_init_setup_model,
        )

    def _setup_model(self) -> None:
        if self.replay_buffer_class is None:
            is_dict = isinstance(self.observation_space, spaces.Dict)
            self.replay_buffer_class = MaskedDictReplayBuffer if is_dict else MaskedReplayBuffer
        super()._setup_model()
        target: Any = self.q_net_target
        target.double_q = self.double_q

    # Acting

    def action_masks(self) -> np.ndarray | None:
        """
        Return which actions are possible now in the environment.

        :return: bool ``[n_envs, n_actions]``; None if the environment has no masks
        """
        assert self.env is not None
        if not self.env.has_attr("action_masks"):
            return None
        self.learned_with_masks = True
        return env_masks(self.env)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        masks = self.action_masks()
        if self.num_timesteps < learning_starts:
            actions = self._random_actions(n_envs, masks)
        else:
            assert self._last_obs is not None
            actions, _ = self.predict(self._last_obs, deterministic=False, action_masks=masks)
        return actions, actions

    def _random_actions(self, n: int, masks: np.ndarray | None) -> np.ndarray:
        sample = self.action_space.sample
        if masks is None:
            return np.array([sample() for _ in range(n)])
        return np.array([sample(mask.astype(np.int8)) for mask in masks])

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
        action_masks: np.ndarray | None = None,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        Return actions: the best possible ones, or with the probability epsilon random ones, for each observation by itself.

        :param observation: One observation or a batch of them
        :param state: Not used
        :param episode_start: Not used
        :param deterministic: Whether never to explore
        :param action_masks: Which actions are possible, bool ``[B, n_actions]`` or ``[n_actions]``; None if all are
        :return: The action(s), and ``state``
        """
        actions, state = self.policy.predict(observation, state, episode_start, deterministic, action_masks)  # type: ignore[call-arg]
        if deterministic:
            return actions, state
        explores = np.random.rand(actions.size) < self.exploration_rate
        if explores.any():
            n_actions = int(self.action_space.n)  # type: ignore[attr-defined]
            masks = None if action_masks is None else np.asarray(action_masks, dtype=bool).reshape(-1, n_actions)[explores]
            chosen = np.array(actions.reshape(-1))
            chosen[explores] = self._random_actions(int(explores.sum()), masks)
            actions = chosen.reshape(actions.shape)
        return actions, state

    # Learning

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        if reset_num_timesteps or self._last_obs is None or len(self._return_runs) != self.n_envs:
            # SB3 resets the environment
            self._return_runs = np.zeros(self.n_envs, dtype=bool)
        result = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        if self.exploration_steps is not None and self._total_timesteps:
            # As a share of all steps, which are known here only
            share = self.exploration_steps / self._total_timesteps
            self.exploration_schedule = LinearSchedule(self.exploration_initial_eps, self.exploration_final_eps, share)
        return result

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        assert isinstance(replay_buffer, MaskedReplayMixin)
        replay_buffer.stage(self._next_masks(dones, infos), self._learnable(dones, infos))
        # A limit cuts off the return of a dead agent, too, whose values are learned here
        infos = [{**info, "TimeLimit.truncated": True} if info.get("truncated", False) else info for info in infos]
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)

    def _next_masks(self, dones: np.ndarray, infos: list[dict[str, Any]]) -> np.ndarray | None:
        """Return which actions are possible at the observations after a step, before a reset."""
        masks = self.action_masks()
        if masks is not None and dones.any():
            masks = masks.copy()
            for copy in np.flatnonzero(dones):
                masks[copy] = infos[copy].get("terminal_action_masks", True)
        return masks

    def _learnable(self, dones: np.ndarray, infos: list[dict[str, Any]]) -> np.ndarray:
        """Return in which copies the agent's own return ran during a step."""
        active = np.array([info.get("active", True) for info in infos], dtype=bool)
        learnable = active | self._return_runs
        self._return_runs = learnable & ~dones
        return learnable

    def learn(
        self: SelfIQL,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "IQL",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfIQL:
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
