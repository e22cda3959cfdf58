"""Counterfactual multi-agent policy gradients. Uses the global state in training."""

from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule

from sb3_belief.common.checks import check_integer, check_share
from sb3_belief.references.coma_policy import ComaPolicy, coma_actor_loss, counterfactual_advantages, taken
from sb3_belief.references.joint_learner import JointLearnerMixin


class COMA(JointLearnerMixin, OnPolicyAlgorithm):
    """
    COMA (Foerster et al. 2018): actors of their own for the agents, trained by a critic that sees the state and all actions.

    After a rollout the critic takes a step for each time step of it, the last first, towards
    ``G_t = r_t + gamma (1 - end_t) [(1 - lambda) Q'_{t+1} + lambda G_{t+1}]``, where ``Q'`` is the mean over agents of the
    target critic's value of the joint action taken; then the actors take one step by ``A_i = Q(u_i) - sum_u pi_i(u) Q(u)``.
    Steps in which an agent was out of play do not train its actor. It uses the global state in training; the actors act
    without it.

    :param policy: ``"ComaPolicy"``, or a class derived from it
    :param env: A :class:`~sb3_belief.references.joint_vec_env.JointVecEnv` of agents with Discrete actions
    :param learning_rate: Learning rate of actors and critic, or a schedule of the progress remaining (from 1 to 0)
    :param n_steps: Steps of each copy in a rollout, at least 1: those of an episode, in the paper
    :param gamma: Discount factor, in [0, 1]
    :param td_lambda: ``lambda``, in [0, 1]
    :param ent_coef: Weight of the actors' entropy, at least 0
    :param target_update_interval: Steps of the critic after which its target is replaced, at least 1
    :param max_grad_norm: Largest norm of the gradients
    :param stats_window_size: As in SB3
    :param tensorboard_log: As in SB3
    :param policy_kwargs: Arguments of :class:`~sb3_belief.references.coma_policy.ComaPolicy`
    :param verbose: As in SB3
    :param seed: As in SB3
    :param device: As in SB3
    :param _init_setup_model: As in SB3
    :raises ValueError: For an argument out of its range, or an environment of another kind, with what is allowed
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"ComaPolicy": ComaPolicy}
    optimizer_names = ("optimizer", "critic_optimizer")
    policy: ComaPolicy  # type: ignore[assignment]

    def __init__(
        self,
        policy: str | type[ComaPolicy],
        env: GymEnv | str | None,
        learning_rate: float | Schedule = 5e-4,
        n_steps: int = 32,
        gamma: float = 0.99,
        td_lambda: float = 0.8,
        ent_coef: float = 0.01,
        target_update_interval: int = 200,
        max_grad_norm: float = 10.0,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ):
        check_integer("n_steps", n_steps, 1, "the steps of each copy in a rollout")
        check_integer("target_update_interval", target_update_interval, 1, "the critic's steps between two targets")
        check_share("gamma", gamma, "how much a later reward is worth")
        check_share("td_lambda", td_lambda, "0 for one-step targets, 1 for whole returns")
        if ent_coef < 0:
            raise ValueError(f"ent_coef={ent_coef!r} must be at least 0: the weight of the entropy.")
        self._check_joint_env(env)
        super().__init__(
            policy,  # type: ignore[arg-type]
            env,  # type: ignore[arg-type]
            learning_rate,
            n_steps=n_steps,
            gamma=gamma,
            # SB3's returns are then those above
            gae_lambda=td_lambda,
            ent_coef=ent_coef,
            # There is no joint loss, in which it would have a weight
            vf_coef=0.0,
            max_grad_norm=max_grad_norm,
            use_sde=False,
            sde_sample_freq=-1,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=False,
        )
        self.td_lambda, self.target_update_interval = td_lambda, target_update_interval
        self._n_critic_steps = 0
        # Who was in play at each step of the rollout, [n_envs, n] each
        self._in_play: list[np.ndarray] = []
        if _init_setup_model:
            self._setup_model()

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> bool:
        self._in_play = []
        return super().collect_rollouts(*args, **kwargs)

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: np.ndarray | None = None) -> None:
        # Called once for each step, just before it is stored
        super()._update_info_buffer(infos, dones)
        self._in_play.append(np.array([info["in_play"] for info in infos]))

    def train(self) -> None:
        """Update the critic at each step of the rollout, the last first, and then the actors."""
        policy = self.policy
        policy.set_training_mode(True)
        self._update_learning_rate([policy.optimizer, policy.critic_optimizer])
        buffer: Any = self.rollout_buffer
        # By time and copy: SB3 flattens them when it draws minibatches, which is not done here
        obs = {key: th.as_tensor(part, device=self.device) for key, part in buffer.observations.items()}
        actions = th.as_tensor(buffer.actions, device=self.device).long()
        returns = th.as_tensor(buffer.returns, device=self.device)
        losses = [
            self._critic_step({key: part[t] for key, part in obs.items()}, actions[t], returns[t])
            for t in reversed(range(self.n_steps))
        ]
        rows, chosen = {key: part.flatten(0, 1) for key, part in obs.items()}, actions.flatten(0, 1)
        in_play = th.as_tensor(np.stack(self._in_play), device=self.device).flatten(0, 1).float()
        distribution = policy.distribution(rows)
        with th.no_grad():
            q = policy.critic_values(policy.critic, rows, chosen)
        advantages = counterfactual_advantages(q, distribution.probs, chosen)
        loss = coma_actor_loss(distribution, chosen, advantages, in_play, self.ent_coef)
        policy.optimizer.zero_grad()
        loss.backward()
        th.nn.utils.clip_grad_norm_(policy.actor.parameters(), self.max_grad_norm)
        policy.optimizer.step()
        self._n_updates += 1
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/policy_loss", loss.item())
        self.logger.record("train/critic_loss", float(np.mean(losses)))
        self.logger.record("train/entropy", distribution.entropy().mean().item())

    def _critic_step(self, obs: dict[str, th.Tensor], actions: th.Tensor, returns: th.Tensor) -> float:
        """Let the critic take a step, and return its loss, ``(Q_i(u_i) - G)²``."""
        policy = self.policy
        loss = ((taken(policy.critic_values(policy.critic, obs, actions), actions) - returns.unsqueeze(-1)) ** 2).mean()
        policy.critic_optimizer.zero_grad()
        loss.backward()
        th.nn.utils.clip_grad_norm_(policy.critic.parameters(), self.max_grad_norm)
        policy.critic_optimizer.step()
        self._n_critic_steps += 1
        if self._n_critic_steps % self.target_update_interval == 0:
            policy.critic_target.load_state_dict(policy.critic.state_dict())
        return loss.item()

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "COMA",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> "COMA":
        """Learn as SB3's algorithms do. The arguments are those of A2C's ``learn``."""
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
