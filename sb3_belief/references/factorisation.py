"""Value factorisation: VDN, QMIX, QPLEX and QTRAN. Uses the global state in training."""

import warnings
from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, RolloutReturn, Schedule

from sb3_belief.common.checks import check_integer, check_positive, check_share
from sb3_belief.common.kept_attributes import kept_attributes
from sb3_belief.references.agent_net import AgentValues
from sb3_belief.references.episodes import EpisodeBatch, EpisodeReplayBuffer, lambda_returns
from sb3_belief.references.factorised_policy import MIXERS, FactorisedPolicy
from sb3_belief.references.joint_learner import JointLearnerMixin


class ValueFactorisation(JointLearnerMixin, OffPolicyAlgorithm):
    """
    Deep Q-learning of a joint value that is made of each agent's own: VDN (Sunehag et al. 2018), QMIX (Rashid et al. 2018),
    QPLEX (Wang et al. 2021), QTRAN-base (Son et al. 2019). It uses the global state in training; the agents act without it.

    The loss is the mean of ``(Q_tot - y)²`` over the steps of whole episodes, with
    ``y_t = r_t + gamma (1 - end_t) [(1 - lambda) Q'_tot(s_{t+1}, u*) + lambda y_{t+1}]``: ``Q'`` of the target network,
    ``u*`` each agent's best legal action by its own present value (double Q). There is one update after as many episodes as
    the environment has copies, from the time when a batch of episodes is there.

    :param policy: ``"FactorisedPolicy"``, or a class derived from it
    :param env: A :class:`~sb3_belief.references.joint_vec_env.JointVecEnv` of agents with Discrete actions
    :param mixer: ``"vdn"``, ``"qmix"``, ``"qplex"`` or ``"qtran"``
    :param learning_rate: Learning rate, or a schedule of the progress remaining (from 1 to 0)
    :param buffer_size: Number of episodes in the replay, at least ``batch_size``
    :param batch_size: Episodes in an update, at least 1
    :param gamma: Discount factor, in [0, 1]
    :param td_lambda: ``lambda``, in [0, 1]; 0 for one-step targets
    :param gradient_steps: Updates each time, at least 1
    :param target_update_interval: Episodes after which the target network is replaced by the present one, at least 1
    :param exploration_steps: Steps of the environment, over all copies, in which the probability of a random action falls
        linearly, at least 1
    :param exploration_initial_eps: That probability at first, in [0, 1]
    :param exploration_final_eps: That probability at last, in [0, 1]
    :param max_grad_norm: Largest norm of the gradient
    :param stats_window_size: As in SB3
    :param tensorboard_log: As in SB3
    :param policy_kwargs: Arguments of :class:`~sb3_belief.references.factorised_policy.FactorisedPolicy` besides the mixer
    :param verbose: As in SB3
    :param seed: As in SB3
    :param device: As in SB3
    :param _init_setup_model: As in SB3
    :raises ValueError: For an argument out of its range, or an environment of another kind, with what is allowed
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"FactorisedPolicy": FactorisedPolicy}
    policy: FactorisedPolicy
    replay_buffer: EpisodeReplayBuffer

    def __init__(
        self,
        policy: str | type[FactorisedPolicy],
        env: GymEnv | str | None,
        mixer: str = "qmix",
        learning_rate: float | Schedule = 5e-4,
        buffer_size: int = 5000,
        batch_size: int = 32,
        gamma: float = 0.99,
        td_lambda: float = 0.0,
        gradient_steps: int = 1,
        target_update_interval: int = 200,
        exploration_steps: int = 50_000,
        exploration_initial_eps: float = 1.0,
        exploration_final_eps: float = 0.05,
        max_grad_norm: float = 10.0,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ):
        if mixer not in MIXERS:
            raise ValueError(f"mixer={mixer!r} must be one of {', '.join(map(repr, MIXERS))}.")
        check_integer("batch_size", batch_size, 1, "how many episodes there are in an update")
        check_integer("buffer_size", buffer_size, batch_size, "the episodes of the replay, of which batch_size are drawn")
        check_integer("gradient_steps", gradient_steps, 1, "how many updates there are each time")
        check_integer("target_update_interval", target_update_interval, 1, "the episodes between two target networks")
        check_integer("exploration_steps", exploration_steps, 1, "the steps in which epsilon falls")
        check_positive("max_grad_norm", max_grad_norm, "the largest norm of a gradient")
        check_share("gamma", gamma, "how much a later reward is worth")
        check_share("td_lambda", td_lambda, "0 for one-step targets, 1 for whole returns")
        check_share("exploration_initial_eps", exploration_initial_eps, "the probability of a random action")
        check_share("exploration_final_eps", exploration_final_eps, "the probability of a random action")
        self._check_joint_env(env)
        super().__init__(
            policy,
            env,  # type: ignore[arg-type]
            learning_rate,
            buffer_size=buffer_size,
            # Whether there is enough to learn from is known in episodes, by train()
            learning_starts=0,
            batch_size=batch_size,
            gamma=gamma,
            train_freq=(1, "step"),
            gradient_steps=gradient_steps,
            replay_buffer_class=EpisodeReplayBuffer,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            support_multi_env=True,
            seed=seed,
            sde_support=False,
        )
        self.mixer, self.td_lambda = mixer, td_lambda
        self.target_update_interval, self.max_grad_norm = target_update_interval, max_grad_norm
        self.exploration_steps = exploration_steps
        self.exploration_initial_eps, self.exploration_final_eps = exploration_initial_eps, exploration_final_eps
        #: Probability of a random action, as of now
        self.exploration_rate = exploration_initial_eps
        # Episodes that have ended, and of these those before the last update and the last target network
        self._n_episodes = self._episodes_updated = self._episodes_copied = 0
        self._last_states: tuple[np.ndarray, ...] | None = None
        if _init_setup_model:
            self._setup_model()

    def _policy_arguments(self) -> dict[str, Any]:
        """Return what of the algorithm's arguments is the policy's."""
        return {"mixer": self.mixer}

    def _setup_model(self) -> None:
        with kept_attributes(self, "policy_kwargs"):
            self.policy_kwargs = {**self.policy_kwargs, **self._policy_arguments()}
            super()._setup_model()

    # Acting

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        Return each agent's action, by its own values.

        :param observation: Joint observations, ``[n_envs, ...]`` by key, or a single one
        :param state: As returned by the last call: hidden states ``[n_envs, n, h]`` and last actions; None at first
        :param episode_start: Where the state starts anew, bool ``[n_envs]``
        :param deterministic: Whether to take the best actions only. Otherwise random ones as often as now in training
        :return: Actions int ``[n_envs, n]``, or ``[n]``, and the state for the next call
        """
        assert isinstance(observation, dict), "An observation of a JointVecEnv is a dict"
        return self.policy.act(observation, state, episode_start, 0.0 if deterministic else self.exploration_rate)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        assert isinstance(self._last_obs, dict)
        actions, self._last_states = self.predict(self._last_obs, self._last_states, self._last_episode_starts)
        return actions, actions

    def _store_transition(
        self, replay_buffer: Any, buffer_action: Any, new_obs: Any, reward: Any, dones: Any, infos: Any
    ) -> None:
        assert self._last_episode_starts is not None
        replay_buffer.begin(self._last_episode_starts)
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
        self._last_episode_starts = dones
        self._n_episodes += int(np.sum(dones))

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> RolloutReturn:
        rollout = super().collect_rollouts(*args, **kwargs)
        if not rollout.continue_training:
            # SB3 has made a step that it does not store: what goes on from there is no whole episode
            self._last_obs = None
        return rollout

    def _on_step(self) -> None:
        done = min(self.num_timesteps / self.exploration_steps, 1.0)
        self.exploration_rate = self.exploration_initial_eps + done * (
            self.exploration_final_eps - self.exploration_initial_eps
        )
        self.logger.record("rollout/exploration_rate", self.exploration_rate)

    # Learning

    def train(self, gradient_steps: int, batch_size: int) -> None:
        """
        Update the networks, if enough episodes have ended since the last time.

        :param gradient_steps: Number of updates
        :param batch_size: Episodes in each
        """
        if self._n_episodes - self._episodes_updated < self.n_envs:
            return
        if self.replay_buffer.size() < batch_size:
            self._episodes_updated = self._n_episodes
            return
        # Episodes of other lengths end at other times: those beyond n_envs count for the next update
        self._episodes_updated += self.n_envs
        self._update_learning_rate(self._optimizers)
        logs = [self._update(self.replay_buffer.sample(batch_size)) for _ in range(gradient_steps)]
        self._n_updates += gradient_steps
        if self._n_episodes - self._episodes_copied >= self.target_update_interval:
            self.policy.update_target()
            self._episodes_copied = self._n_episodes
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for name in logs[0]:
            self.logger.record(f"train/{name}", float(np.mean([log[name] for log in logs])))

    def _update(self, batch: EpisodeBatch) -> dict[str, float]:
        """Make one update, and return what is logged of it."""
        values = self.policy.net(batch)
        # Where no step exists the values of actions may be minus infinity, of which not even the gradient could be left out
        exists = batch.exists.flatten().bool()
        now, actions = values.rows(slice(None, -1)).where(exists), batch.actions.flatten(0, 1)[exists]
        joint = self.policy.net.mixer.joint_value(now, actions)
        errors = (joint - self.targets(batch, values).flatten()[exists].reshape(joint.shape)) ** 2
        consistency = self.policy.net.mixer.consistency_loss(now, actions, joint)
        loss = (errors if consistency is None else errors + consistency).mean()
        self.policy.optimizer.zero_grad()
        loss.backward()
        norm = th.nn.utils.clip_grad_norm_(self.policy.net.parameters(), self.max_grad_norm)
        self.policy.optimizer.step()
        return {"loss": loss.item(), "q_tot": joint.detach().mean().item(), "gradient_norm": norm.item()}

    def targets(self, batch: EpisodeBatch, values: AgentValues | None = None) -> th.Tensor:
        """
        Return what the joint values are trained towards.

        :param batch: Episodes of ``T`` steps
        :param values: The agents' values in them by the present networks; None to compute them
        :return: ``[B, T]``; where no step exists, any number
        """
        with th.no_grad():
            best = (self.policy.net(batch) if values is None else values).rows(slice(1, None)).greedy()
            after = self.policy.target_net(batch).rows(slice(1, None))
            next_values = self.policy.target_net.mixer.joint_value(after, best).reshape(batch.rewards.shape)
            return lambda_returns(batch.rewards, batch.ends, batch.exists, next_values, self.gamma, self.td_lambda)

    # SB3's protocol

    @property
    def _optimizers(self) -> list[th.optim.Optimizer]:
        return [self.policy.optimizer]

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        result = super()._setup_learn(*args, **kwargs)
        if self._last_states is not None and len(self._last_states[0]) != self.n_envs:
            # The environment has another number of copies now, which have been reset
            self._last_states = None
        return result

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "ValueFactorisation",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> "ValueFactorisation":
        """Learn as SB3's algorithms do. The arguments are those of DQN's ``learn``."""
        before = self._n_updates
        super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
        if self._n_updates == before and self.replay_buffer.size() < self.batch_size:
            warnings.warn(
                f"{type(self).__name__} has not learned anything: {self.replay_buffer.size()} episodes have ended in"
                f" {self.num_timesteps:,} steps, and an update takes batch_size={self.batch_size} of them. Train for longer,"
                " or make episodes end, by a limit for instance.",
                stacklevel=2,
            )
        return self
