"""RODE: roles to decompose a task. Uses the global state in training."""

from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from sb3_belief.common.checks import check_integer
from sb3_belief.references.agent_net import AgentValues
from sb3_belief.references.episodes import EpisodeBatch, lambda_returns
from sb3_belief.references.factorisation import ValueFactorisation
from sb3_belief.references.rode_policy import RodePolicy


class RODE(ValueFactorisation):
    """
    RODE (Wang et al. 2021): agents choose a role every few steps, and at each step one of the role's actions.

    For ``role_start`` steps it plays at random and learns embeddings of actions, from which what an agent observes next and
    what the team is paid can be told. Then, once, k-means groups the actions into roles; embeddings and roles stay as they
    are, the replay begins anew, and roles and actions are learned as two QMIX: roles from the discounted rewards of the steps
    for which they are kept. The loss is the sum of both. It uses the global state in training; the agents act without it.

    :param policy: ``"RodePolicy"``, or a class derived from it
    :param env: A :class:`~sb3_belief.references.joint_vec_env.JointVecEnv` of agents with Discrete actions
    :param role_start: Steps of the environment, over all copies, before the roles are made, at least 1
    :param learning_rate: As in :class:`~sb3_belief.references.factorisation.ValueFactorisation`
    :param buffer_size: As there
    :param batch_size: As there
    :param gamma: As there
    :param td_lambda: As there, for actions
    :param gradient_steps: As there
    :param target_update_interval: As there
    :param exploration_steps: As there, from ``role_start`` on: the probability of a random role, and of a random action
    :param exploration_initial_eps: As there
    :param exploration_final_eps: As there
    :param max_grad_norm: As there
    :param stats_window_size: As in SB3
    :param tensorboard_log: As in SB3
    :param policy_kwargs: Arguments of :class:`~sb3_belief.references.rode_policy.RodePolicy`
    :param verbose: As in SB3
    :param seed: As in SB3
    :param device: As in SB3
    :param _init_setup_model: As in SB3
    :raises ValueError: For an argument out of its range, or an environment of another kind, with what is allowed
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"RodePolicy": RodePolicy}
    optimizer_names = ("optimizer", "effects_optimizer")
    policy: RodePolicy

    def __init__(
        self,
        policy: str | type[RodePolicy],
        env: GymEnv | str | None,
        role_start: int = 50_000,
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
        check_integer("role_start", role_start, 1, "the steps from which roles are made")
        super().__init__(
            policy,
            env,
            learning_rate=learning_rate,
            buffer_size=buffer_size,
            batch_size=batch_size,
            gamma=gamma,
            td_lambda=td_lambda,
            gradient_steps=gradient_steps,
            target_update_interval=target_update_interval,
            exploration_steps=exploration_steps,
            exploration_initial_eps=exploration_initial_eps,
            exploration_final_eps=exploration_final_eps,
            max_grad_norm=max_grad_norm,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=False,
        )
        self.role_start = role_start
        if _init_setup_model:
            self._setup_model()

    def _policy_arguments(self) -> dict[str, Any]:
        # It has mixers of its own
        return {}

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        actions, _ = super()._sample_action(learning_starts, action_noise, n_envs)
        assert self._last_states is not None
        # The replay keeps each agent's role beside its action
        return actions, np.stack([actions, self._last_states[2]], axis=-1)

    def _on_step(self) -> None:
        if self.policy.has_roles:
            # Below zero where a model that has roles counts its steps anew
            share = float(np.clip((self.num_timesteps - self.role_start) / self.exploration_steps, 0.0, 1.0))
            initial, final = self.exploration_initial_eps, self.exploration_final_eps
            self.exploration_rate = (1 - share) * initial + share * final
        else:
            self.exploration_rate = 1.0
        self.logger.record("rollout/exploration_rate", self.exploration_rate)

    @property
    def _optimizers(self) -> list[th.optim.Optimizer]:
        return [*super()._optimizers, self.policy.effects_optimizer]

    def train(self, gradient_steps: int, batch_size: int) -> None:
        super().train(gradient_steps, batch_size)
        # Before the first update the embeddings that would be grouped are random
        if self.num_timesteps >= self.role_start and self._n_updates and not self.policy.has_roles:
            self.policy.make_roles(np.random.default_rng(np.random.randint(2**31)))
            self.policy.update_target()
            # Its roles were chosen when they meant nothing
            self.replay_buffer.reset()

    def _update(self, batch: EpisodeBatch) -> dict[str, float]:
        return self._learn_values(batch) if self.policy.has_roles else self._learn_effects(batch)

    def _learn_effects(self, batch: EpisodeBatch) -> dict[str, float]:
        exists, policy = batch.exists.bool(), self.policy
        loss = policy.effects.loss(
            batch.obs[:, :-1][exists], batch.actions[exists][..., 0], batch.obs[:, 1:][exists], batch.rewards[exists]
        )
        policy.effects_optimizer.zero_grad()
        loss.backward()
        policy.effects_optimizer.step()
        return {"effects_loss": loss.item()}

    def _learn_values(self, batch: EpisodeBatch) -> dict[str, float]:
        policy, now = self.policy, slice(None, -1)
        role_values, features = policy.pass_episodes(policy.net, batch)
        # As in _update(), only steps that exist, and of roles those at which they are chosen
        exists = batch.exists.flatten().bool()
        begins = th.arange(batch.exists.shape[1], device=self.device) % policy.role_interval == 0
        starts = exists & begins.repeat(len(batch.exists))
        actions, roles = batch.actions.flatten(0, 1).unbind(dim=-1)
        of_roles = AgentValues(role_values, features, batch.state).rows(now).where(starts)
        seen, mask, state = (part[:, now].flatten(0, 1)[exists] for part in (features, batch.mask, batch.state))
        of_actions = policy.values_in(policy.net, seen, roles[exists], mask, state)
        role_targets, action_targets = (targets.flatten() for targets in self.role_targets(batch))
        losses = []
        for joint, targets in (
            (policy.net.role_mixer.joint_value(of_roles, roles[starts]), role_targets[starts]),
            (policy.net.action_mixer.joint_value(of_actions, actions[exists]), action_targets[exists]),
        ):
            losses.append(((joint.reshape(targets.shape) - targets) ** 2).mean())
        policy.optimizer.zero_grad()
        (losses[0] + losses[1]).backward()
        norm = th.nn.utils.clip_grad_norm_(policy.net.parameters(), self.max_grad_norm)
        policy.optimizer.step()
        return {"role_loss": losses[0].item(), "action_loss": losses[1].item(), "gradient_norm": norm.item()}

    def role_targets(self, batch: EpisodeBatch) -> tuple[th.Tensor, th.Tensor]:
        """
        Return what the joint values of roles and of actions are trained towards.

        :param batch: Episodes of ``T`` steps, with actions and roles as their actions ``[B, T, n, 2]``
        :return: Two times ``[B, T]``; of the roles those count at which roles are chosen
        """
        policy, later = self.policy, slice(1, None)
        with th.no_grad():
            online_roles, online_features = policy.pass_episodes(policy.net, batch)
            target_roles, target_features = policy.pass_episodes(policy.target_net, batch)
            state = batch.state[:, later].flatten(0, 1)
            best_roles = online_roles[:, later].argmax(dim=-1)
            of_roles = AgentValues(target_roles, target_features, batch.state).rows(later)
            next_role_values = policy.target_net.role_mixer.joint_value(of_roles, best_roles.flatten(0, 1))
            # The roles of the steps after these: as chosen, and where the episode has no more, as they would have been
            n_steps = batch.rewards.shape[1]
            is_start = th.arange(1, n_steps + 1, device=self.device) % policy.role_interval == 0
            kept = batch.actions[..., 1]
            follows = th.cat([batch.exists[:, 1:], th.zeros_like(batch.exists[:, :1])], dim=1).bool()
            chosen = th.cat([kept[:, 1:], kept[:, -1:]], dim=1)
            otherwise = th.where(is_start[:, None], best_roles, kept)
            next_roles = th.where(follows[..., None], chosen, otherwise).flatten(0, 1)
            mask = batch.mask[:, later].flatten(0, 1)
            best = policy.values_in(policy.net, online_features[:, later].flatten(0, 1), next_roles, mask, state).greedy()
            after = policy.values_in(policy.target_net, target_features[:, later].flatten(0, 1), next_roles, mask, state)
            next_action_values = policy.target_net.action_mixer.joint_value(after, best)
            known = batch.rewards, batch.ends, batch.exists
            # A role's return goes on until the next one is chosen
            role_lambda = 1 - is_start.float()
            return (
                lambda_returns(*known, next_role_values.reshape(batch.rewards.shape), self.gamma, role_lambda),
                lambda_returns(*known, next_action_values.reshape(batch.rewards.shape), self.gamma, self.td_lambda),
            )

    def targets(self, batch: EpisodeBatch, values: AgentValues | None = None) -> th.Tensor:
        """
        Return what the joint values of actions are trained towards.

        :param batch: As of :meth:`role_targets`
        :param values: Not used
        :return: ``[B, T]``
        """
        return self.role_targets(batch)[1]
