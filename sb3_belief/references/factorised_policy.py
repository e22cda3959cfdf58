"""The networks of a factorised value, and how they act: by each agent's own values, as it could without the others."""

from copy import deepcopy
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import Schedule
from torch import nn

from sb3_belief.common.checks import check_integer
from sb3_belief.references.agent_net import AgentNet, AgentValues
from sb3_belief.references.episodes import EpisodeBatch
from sb3_belief.references.mixers import QMIX, QPLEX, VDN, Mixer
from sb3_belief.references.qtran import QTRAN

#: The mixers by name; each is made of the numbers of agents and actions, the width of the state and its own arguments
MIXERS: dict[str, type[Mixer] | type[QTRAN]] = {"vdn": VDN, "qmix": QMIX, "qplex": QPLEX, "qtran": QTRAN}
# As SB3's recurrent policies take and return it: hidden states [n_envs, n, h] and last actions, one-hot [n_envs, n, U]
ActingState = tuple[np.ndarray, ...]


def explore(chosen: np.ndarray, mask: np.ndarray, epsilon: float) -> np.ndarray:
    """
    Replace choices by random ones, by a coin for each.

    :param chosen: int ``[n_envs, n]``
    :param mask: What may be chosen, bool ``[n_envs, n, U]``
    :param epsilon: Probability of a random choice, in [0, 1]
    :return: int ``[n_envs, n]``
    """
    if epsilon == 0:
        return chosen
    # Of the uniform numbers of what is legal the largest is that of any of it with the same probability
    anything = np.where(mask, np.random.rand(*mask.shape), -1.0).argmax(axis=-1)
    return np.where(np.random.rand(*chosen.shape) < epsilon, anything, chosen)


class FactorisedValue(nn.Module):
    """
    The agents' networks and the mixer of their values.

    :param agents: The agents' networks
    :param mixer: The mixer
    """

    def __init__(self, agents: AgentNet, mixer: Mixer | QTRAN):
        super().__init__()
        self.agents, self.mixer = agents, mixer

    def forward(self, batch: EpisodeBatch) -> AgentValues:
        """
        Return the agents' values in all observations of episodes.

        :param batch: Episodes of ``T`` steps
        :return: Values ``[B, T + 1, ...]``
        """
        taken = nn.functional.one_hot(batch.actions, self.agents.n_actions).float()
        last_actions = th.cat([th.zeros_like(taken[:, :1]), taken], dim=1)
        q, features, _ = self.agents(batch.obs, last_actions, self.agents.initial_hidden(len(batch.obs)))
        return AgentValues(q.masked_fill(~batch.mask, -th.inf), features, batch.state)


class FactorisedPolicy(BasePolicy):
    """
    Policy of :class:`~sb3_belief.references.factorisation.ValueFactorisation`, with the networks and their target.

    Each agent acts by its own values, of its own observations and actions so far. The mixer, and with it the global state, is
    for training.

    :param observation_space: That of a ``JointVecEnv``
    :param action_space: That of a ``JointVecEnv``, MultiDiscrete
    :param lr_schedule: Learning rate by the progress remaining
    :param mixer: A key of ``MIXERS``
    :param mixer_kwargs: Arguments of the mixer: its widths, kernels and weights
    :param hidden_dim: Width of the agents' networks, at least 1
    :param recurrent: Whether the agents' networks remember the episode (GRU)
    :param share: Whether all agents share the weights of one network
    :param optimizer_class: Class of the optimizer
    :param optimizer_kwargs: Its arguments, without the learning rate; by default PyTorch's fused implementation of Adam
    """

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.MultiDiscrete,
        lr_schedule: Schedule,
        mixer: str = "qmix",
        mixer_kwargs: dict[str, Any] | None = None,
        hidden_dim: int = 64,
        recurrent: bool = True,
        share: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
    ):
        check_integer("hidden_dim", hidden_dim, 1, "the width of the agents' networks")
        if optimizer_kwargs is None and optimizer_class is th.optim.Adam:
            optimizer_kwargs = {"fused": True}
        super().__init__(observation_space, action_space, optimizer_class=optimizer_class, optimizer_kwargs=optimizer_kwargs)
        self.arguments: dict[str, Any] = dict(
            mixer=mixer, mixer_kwargs=mixer_kwargs, hidden_dim=hidden_dim, recurrent=recurrent, share=share
        )
        sizes: Any = {key: space.shape for key, space in observation_space.spaces.items()}
        self.n_agents, self.n_actions = sizes["mask"]
        self.obs_dim, self.state_dim = sizes["obs"][1], sizes["state"][0]
        self.net: Any = self._make_net()
        self.target_net: Any = deepcopy(self.net).requires_grad_(False)
        self.optimizer = self.optimizer_class(
            self.net.parameters(),
            lr=lr_schedule(1),  # type: ignore[call-arg]
            **self.optimizer_kwargs,
        )

    def _make_net(self) -> nn.Module:
        """Return the networks that are trained, and copied into the target."""
        mixer, hidden_dim = self.arguments["mixer"], self.arguments["hidden_dim"]
        agents = AgentNet(
            self.n_agents, self.obs_dim, self.n_actions, hidden_dim, self.arguments["recurrent"], self.arguments["share"]
        )
        kwargs = {**({"features_dim": hidden_dim} if mixer == "qtran" else {}), **(self.arguments["mixer_kwargs"] or {})}
        return FactorisedValue(agents, MIXERS[mixer](self.n_agents, self.n_actions, self.state_dim, **kwargs))

    def set_training_mode(self, mode: bool) -> None:
        """
        Remember the mode, on which no layer here depends: SB3 sets it at each step, and to tell all of them takes long.

        :param mode: Whether the networks are being trained
        """
        self.training = mode

    def update_target(self) -> None:
        """Copy the networks into their target."""
        self.target_net.load_state_dict(self.net.state_dict())

    def act(
        self,
        observation: dict[str, np.ndarray],
        state: ActingState | None = None,
        episode_start: np.ndarray | None = None,
        epsilon: float = 0.0,
    ) -> tuple[np.ndarray, ActingState]:
        """
        Choose each agent's best legal action or, for each agent and copy by a coin of its own, any legal one.

        :param observation: Joint observations, ``[n_envs, ...]`` by key, or a single one
        :param state: As returned by the last call; None at the beginning of episodes
        :param episode_start: Where the state starts anew, bool ``[n_envs]``
        :param epsilon: Probability of a random action, in [0, 1]
        :return: Actions int64 ``[n_envs, n]``, or ``[n]``, and the state for the next call
        """
        obs, is_batch = self.obs_to_tensor(observation)
        with th.no_grad():
            values, hidden = self._step_values(obs, state, episode_start)
        mask = values.q.isfinite().cpu().numpy()
        actions = explore(values.greedy().cpu().numpy(), mask, epsilon)
        last_actions = np.eye(mask.shape[-1], dtype=np.float32)[actions]
        return actions if is_batch else actions[0], (hidden.cpu().numpy(), last_actions)

    def joint_values(
        self, observation: dict[str, np.ndarray], actions: np.ndarray, state: ActingState | None = None
    ) -> np.ndarray:
        """
        Return the values of joint actions, ``Q_tot`` or ``Qjt``.

        :param observation: Joint observations, ``[n_envs, ...]`` by key
        :param actions: Joint actions, int ``[n_envs, n]``
        :param state: As returned by ``act`` for the step before; None at the beginning of episodes
        :return: ``[n_envs]``
        """
        obs, _ = self.obs_to_tensor(observation)
        with th.no_grad():
            values, _ = self._step_values(obs, state, None)
            joint = self.net.mixer.joint_value(values, th.as_tensor(actions, dtype=th.int64, device=self.device))
        return joint[:, 0].cpu().numpy()

    def _step_values(
        self, obs: Any, state: ActingState | None, episode_start: np.ndarray | None
    ) -> tuple[AgentValues, th.Tensor]:
        """Return the agents' values in single joint observations, and their hidden states after them."""
        agents, n_rows = self.net.agents, len(obs["obs"])
        hidden = agents.initial_hidden(n_rows)
        last_actions = th.zeros(n_rows, agents.n_agents, agents.n_actions, device=self.device)
        if state is not None:
            hidden, last_actions = (th.as_tensor(part, device=self.device) for part in state)
            if episode_start is not None:
                goes_on = ~th.as_tensor(np.asarray(episode_start, dtype=bool), device=self.device)[:, None, None]
                hidden, last_actions = hidden * goes_on, last_actions * goes_on
        q, features, hidden = agents(obs["obs"][:, None], last_actions[:, None], hidden)
        q = q[:, 0].masked_fill(~obs["mask"].bool(), -th.inf)
        return AgentValues(q, features[:, 0], obs["state"].float()), hidden

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Return each agent's best legal action, and the state for the next call, as SB3's recurrent policies do."""
        assert isinstance(observation, dict)
        return self.act(observation, state, episode_start)

    def forward(self, obs: Any, deterministic: bool = False) -> th.Tensor:
        return self._predict(obs, deterministic)

    def _predict(self, observation: Any, deterministic: bool = False) -> th.Tensor:
        return self._step_values(observation, None, None)[0].greedy()

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            "observation_space": self.observation_space,
            "action_space": self.action_space,
            # Not needed to load a policy alone
            "lr_schedule": self._dummy_schedule,
            "optimizer_class": self.optimizer_class,
            "optimizer_kwargs": self.optimizer_kwargs,
            **self.arguments,
        }
