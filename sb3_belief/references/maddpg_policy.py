"""Actors and critics of MADDPG, one each for every agent, computed side by side."""

from copy import deepcopy
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import Schedule
from torch import nn

from sb3_belief.common.checks import check_positive
from sb3_belief.references.mixers import ParallelLinear


class MaddpgPolicy(BasePolicy):
    """
    Policy of :class:`~sb3_belief.references.maddpg.MADDPG`.

    Agent i's actor sees its own observation, its critic the state and the actions of all. They share nothing.

    :param observation_space: That of a ``JointVecEnv``
    :param action_space: That of a ``JointVecEnv``, MultiDiscrete or Box
    :param lr_schedule: Learning rate by the progress remaining
    :param net_arch: Widths of the hidden layers of actors and critics
    :param temperature: Of the Gumbel softmax, greater than 0
    :param optimizer_class: Class of both optimizers
    :param optimizer_kwargs: Their arguments, without the learning rate
    """

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.Space,
        lr_schedule: Schedule,
        net_arch: list[int] | None = None,
        temperature: float = 1.0,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
    ):
        check_positive("temperature", temperature, "of the Gumbel softmax")
        super().__init__(
            observation_space,
            action_space,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            squash_output=isinstance(action_space, spaces.Box),
        )
        self.temperature = temperature
        self.net_arch = [64, 64] if net_arch is None else net_arch
        sizes: Any = {key: space.shape for key, space in observation_space.spaces.items()}
        (self.n_agents, obs_dim), (state_dim,) = sizes["obs"], sizes["state"]
        self.is_discrete = isinstance(action_space, spaces.MultiDiscrete)
        # Of an agent's action: the largest number of actions, or of the numbers that make one
        self.width = sizes["mask"][1] if self.is_discrete else action_space.shape[1]  # type: ignore[index]
        self.actors = _networks(self.n_agents, obs_dim, self.width, self.net_arch)
        self.critics = _networks(self.n_agents, state_dim + self.n_agents * self.width, 1, self.net_arch)
        self.actor_targets, self.critic_targets = (deepcopy(net).requires_grad_(False) for net in (self.actors, self.critics))
        arguments: Any = {"lr": lr_schedule(1), **self.optimizer_kwargs}
        self.optimizer = self.optimizer_class(self.actors.parameters(), **arguments)
        self.critic_optimizer = self.optimizer_class(self.critics.parameters(), **arguments)

    def outputs(self, actors: nn.Module, obs: dict[str, th.Tensor]) -> th.Tensor:
        """
        Return what actors say, before it becomes an action.

        :param actors: The actors, or their targets
        :param obs: Joint observations, ``[B, ...]`` by key
        :return: Logits, minus infinity for what is not legal, or numbers before the hyperbolic tangent, ``[B, n, W]``
        """
        outputs = actors(obs["obs"].float().transpose(0, 1)).transpose(0, 1)
        if not self.is_discrete:
            return outputs
        return outputs.masked_fill(~obs["mask"].bool(), -th.inf)

    def act(self, outputs: th.Tensor, deterministic: bool = False) -> th.Tensor:
        """
        Return actions through which a gradient passes.

        :param outputs: As :meth:`outputs` returned them, ``[B, n, W]``
        :param deterministic: Whether to take the most likely of discrete actions; numbers have no noise here
        :return: One-hot rows (straight-through Gumbel softmax), or numbers in [-1, 1], ``[B, n, W]``
        """
        if not self.is_discrete:
            return outputs.tanh()
        if deterministic:
            return nn.functional.one_hot(outputs.argmax(dim=-1), self.width).float()
        return nn.functional.gumbel_softmax(outputs, self.temperature, hard=True)

    def critic_values(self, critics: nn.Module, state: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        Return what critics say of joint actions.

        :param critics: The critics, or their targets
        :param state: Global states ``[B, d_s]``
        :param actions: Joint actions ``[B, n, W]`` for all critics, or ``[n, B, n, W]`` with others for each
        :return: ``[B, n]``
        """
        flat = actions.flatten(-2)
        states = state.float() if flat.ndim == 2 else state.float().expand(self.n_agents, -1, -1)
        return critics(th.cat([states, flat], dim=-1)).squeeze(-1).T

    def joint(self, actions: th.Tensor) -> th.Tensor:
        """
        Return joint actions as the critics take them.

        :param actions: As they are stored: ``[B, n]`` numbers of actions, or ``[B, n * W]`` in [-1, 1]
        :return: ``[B, n, W]``
        """
        if self.is_discrete:
            return nn.functional.one_hot(actions.long(), self.width).float()
        return actions.float().reshape(-1, self.n_agents, self.width)

    def forward(self, observation: Any, deterministic: bool = False) -> th.Tensor:
        return self._predict(observation, deterministic)

    def _predict(self, observation: Any, deterministic: bool = False) -> th.Tensor:
        actions = self.act(self.outputs(self.actors, observation), deterministic)
        return actions.argmax(dim=-1) if self.is_discrete else actions

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            "observation_space": self.observation_space,
            "action_space": self.action_space,
            # Not needed to load a policy alone
            "lr_schedule": self._dummy_schedule,
            "net_arch": self.net_arch,
            "temperature": self.temperature,
            "optimizer_class": self.optimizer_class,
            "optimizer_kwargs": self.optimizer_kwargs,
        }


def maddpg_actor_loss(values: th.Tensor, outputs: th.Tensor, in_play: th.Tensor, coef: float) -> th.Tensor:
    """
    Return the actors' loss: of each agent the mean of ``-Q_i + coef mean(outputs²)`` over the steps in which it was in play.

    :param values: What agent i's critic says with its own new action, the others' being those of the replay, ``[B, n]``
    :param outputs: Logits, or numbers before the hyperbolic tangent; minus infinity where not legal, ``[B, n, W]``
    :param in_play: 1 for an agent in play, otherwise 0, ``[B, n]``
    :param coef: Weight of the squares
    :return: The sum over agents, a number
    """
    counts = outputs.isfinite()
    squares = (outputs.masked_fill(~counts, 0.0) ** 2).sum(dim=-1) / counts.sum(dim=-1)
    return sum_of_means(coef * squares - values, in_play)


def sum_of_means(losses: th.Tensor, counts: th.Tensor) -> th.Tensor:
    """
    Return the sum over the agents of each one's mean loss over the steps that count.

    :param losses: ``[B, n]``
    :param counts: 1 for a step of an agent that counts, otherwise 0, ``[B, n]``
    :return: A number; nothing of an agent of which no step counts
    """
    return ((counts * losses).sum(dim=0) / counts.sum(dim=0).clamp(min=1)).sum()


def _networks(n_agents: int, n_in: int, n_out: int, net_arch: list[int]) -> nn.Sequential:
    modules: list[nn.Module] = []
    for width in net_arch:
        modules += [ParallelLinear(n_agents, n_in, width), nn.ReLU()]
        n_in = width
    return nn.Sequential(*modules, ParallelLinear(n_agents, n_in, n_out))
