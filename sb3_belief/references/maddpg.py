"""Multi-agent deep deterministic policy gradients. Uses the global state in training."""

from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import polyak_update
from torch import nn

from sb3_belief.common.checks import check_integer, check_share
from sb3_belief.references.joint_learner import JointLearnerMixin
from sb3_belief.references.joint_replay import JointReplayBuffer, JointSamples
from sb3_belief.references.maddpg_policy import MaddpgPolicy, maddpg_actor_loss, sum_of_means


class MADDPG(JointLearnerMixin, OffPolicyAlgorithm):
    """
    MADDPG (Lowe et al. 2017): for each agent an actor of its own, and a critic that sees the state and all actions.

    ``y_i = r_i + gamma (1 - end_i) Q'_i(s', u')`` with all agents' target actors' actions; actor i is trained by
    ``-Q_i(s, u_1 .. own .. u_n) + 1e-3 mean(outputs²)``, the others' actions being those of the replay. Rewards and ends are
    each agent's own. Discrete actions pass a gradient by the straight-through Gumbel softmax over what is legal, and are hard
    ones in acting; Box actions are hyperbolic tangents with normal noise in training. It uses the global state in training;
    the agents act without it.

    :param policy: ``"MaddpgPolicy"``, or a class derived from it
    :param env: A :class:`~sb3_belief.references.joint_vec_env.JointVecEnv`
    :param learning_rate: Learning rate of actors and critics, or a schedule of the progress remaining (from 1 to 0)
    :param buffer_size: Number of joint steps in the replay
    :param learning_starts: Joint steps before the first update
    :param batch_size: Joint steps in an update, at least 1
    :param tau: Share of the present networks in their targets after each update, in [0, 1]
    :param gamma: Discount factor, in [0, 1]
    :param train_freq: Steps of each copy between updates, at least 1
    :param gradient_steps: Updates each time, at least 1
    :param exploration_noise: Standard deviation of the noise of Box actions, whose range is 2, at least 0
    :param output_coef: Weight of the squares of the actors' outputs, at least 0
    :param max_grad_norm: Largest norm of the gradient of each agent's actor, and of its critic
    :param stats_window_size: As in SB3
    :param tensorboard_log: As in SB3
    :param policy_kwargs: Arguments of :class:`~sb3_belief.references.maddpg_policy.MaddpgPolicy`
    :param verbose: As in SB3
    :param seed: As in SB3
    :param device: As in SB3
    :param _init_setup_model: As in SB3
    :raises ValueError: For an argument out of its range, or an environment of another kind, with what is allowed
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MaddpgPolicy": MaddpgPolicy}
    joint_actions = (spaces.MultiDiscrete, spaces.Box)
    optimizer_names = ("optimizer", "critic_optimizer")
    policy: MaddpgPolicy

    def __init__(
        self,
        policy: str | type[MaddpgPolicy],
        env: GymEnv | str | None,
        learning_rate: float | Schedule = 1e-2,
        buffer_size: int = 1_000_000,
        learning_starts: int = 1024,
        batch_size: int = 1024,
        tau: float = 0.01,
        gamma: float = 0.95,
        train_freq: int = 100,
        gradient_steps: int = 1,
        exploration_noise: float = 0.1,
        output_coef: float = 1e-3,
        max_grad_norm: float = 0.5,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ):
        check_integer("batch_size", batch_size, 1, "the joint steps in an update")
        check_integer("gradient_steps", gradient_steps, 1, "how many updates there are each time")
        check_integer("learning_starts", learning_starts, 0, "the joint steps before the first update")
        if isinstance(train_freq, int):
            check_integer("train_freq", train_freq, 1, "the steps between two updates")
        check_share("tau", tau, "the share of the present networks in their targets")
        check_share("gamma", gamma, "how much a later reward is worth")
        for name, value in (("exploration_noise", exploration_noise), ("output_coef", output_coef)):
            if value < 0:
                raise ValueError(f"{name}={value!r} must be at least 0.")
        self._check_joint_env(env)
        super().__init__(
            policy,
            env,  # type: ignore[arg-type]
            learning_rate,
            buffer_size=buffer_size,
            learning_starts=learning_starts,
            batch_size=batch_size,
            tau=tau,
            gamma=gamma,
            train_freq=(train_freq, "step") if isinstance(train_freq, int) else train_freq,
            gradient_steps=gradient_steps,
            replay_buffer_class=JointReplayBuffer,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            support_multi_env=True,
            seed=seed,
            sde_support=False,
        )
        self.exploration_noise, self.output_coef, self.max_grad_norm = exploration_noise, output_coef, max_grad_norm
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        if isinstance(self.action_space, spaces.Box):
            # Anew also for a model that is loaded, whose noise was for as many copies as it had; it has no memory
            shape = self.action_space.shape
            self.action_noise = NormalActionNoise(np.zeros(shape), np.full(shape, self.exploration_noise))
        super()._setup_model()

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        if reset_num_timesteps or self._last_obs is None:
            # SB3 resets the environment
            assert isinstance(self.replay_buffer, JointReplayBuffer)
            self.replay_buffer.begin_episodes()
        return super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        # SB3's random actions before the first update would not heed the masks of discrete ones. New actors choose these
        # nearly at random, but not numbers
        warm_up = learning_starts if isinstance(self.action_space, spaces.Box) else 0
        return super()._sample_action(warm_up, action_noise, n_envs)

    def train(self, gradient_steps: int, batch_size: int) -> None:
        """
        Update actors, critics and their targets.

        :param gradient_steps: Number of updates
        :param batch_size: Joint steps in each
        """
        policy = self.policy
        policy.set_training_mode(True)
        self._update_learning_rate([policy.optimizer, policy.critic_optimizer])
        losses = []
        for _ in range(gradient_steps):
            samples: Any = self.replay_buffer.sample(batch_size)  # type: ignore[union-attr]
            critic_loss = self.critic_loss(samples)
            self._step(policy.critic_optimizer, critic_loss, policy.critics)
            actor_loss = self.actor_loss(samples)
            self._step(policy.optimizer, actor_loss, policy.actors)
            polyak_update(policy.critics.parameters(), policy.critic_targets.parameters(), self.tau)
            polyak_update(policy.actors.parameters(), policy.actor_targets.parameters(), self.tau)
            losses.append([critic_loss.item(), actor_loss.item()])
        self._n_updates += gradient_steps
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for name, loss in zip(("critic_loss", "actor_loss"), np.mean(losses, axis=0), strict=True):
            self.logger.record(f"train/{name}", float(loss))

    def targets(self, samples: JointSamples) -> th.Tensor:
        """
        Return what the critics are trained towards.

        :param samples: ``B`` joint steps
        :return: ``[B, n]``
        """
        policy = self.policy
        with th.no_grad():
            after = samples.next_observations
            actions = policy.act(policy.outputs(policy.actor_targets, after))
            values = policy.critic_values(policy.critic_targets, after["state"], actions)
            return samples.rewards + self.gamma * (1 - samples.ends) * values

    def critic_loss(self, samples: JointSamples) -> th.Tensor:
        """
        Return the critics' mean squared errors, each over the steps in which its agent's own return ran: those of a dead agent
        as well, on whose values the target before its death relies, and not those between two lives.

        :param samples: ``B`` joint steps
        :return: Their sum over the agents, a number
        """
        policy = self.policy
        values = policy.critic_values(policy.critics, samples.observations["state"], policy.joint(samples.actions))
        return sum_of_means((values - self.targets(samples)) ** 2, samples.return_runs)

    def actor_loss(self, samples: JointSamples) -> th.Tensor:
        """
        Return the actors' losses.

        :param samples: ``B`` joint steps
        :return: Their sum over the agents, a number
        """
        policy, n = self.policy, self.policy.n_agents
        outputs = policy.outputs(policy.actors, samples.observations)
        # For agent i's critic only its own action is new
        is_own = th.eye(n, dtype=th.bool, device=self.device)[:, None, :, None]
        actions = th.where(is_own, policy.act(outputs), policy.joint(samples.actions))
        values = policy.critic_values(policy.critics, samples.observations["state"], actions)
        return maddpg_actor_loss(values, outputs, samples.in_play, self.output_coef)

    def _step(self, optimizer: th.optim.Optimizer, loss: th.Tensor, networks: nn.Module) -> None:
        optimizer.zero_grad()
        loss.backward()
        # Each agent's networks are clipped by themselves: the first dimension of every parameter is the agents'
        gradients = [parameter.grad for parameter in networks.parameters() if parameter.grad is not None]
        norms = th.stack([gradient.flatten(1).norm(dim=1) for gradient in gradients]).norm(dim=0)
        for gradient in gradients:
            gradient.mul_((self.max_grad_norm / (norms + 1e-6)).clamp(max=1.0)[:, None, None])
        optimizer.step()

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "MADDPG",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> "MADDPG":
        """Learn as SB3's algorithms do. The arguments are those of TD3's ``learn``."""
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
