"""Observations that also hold the agent's last ones: a window, for agents without a memory of their own."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space

from sb3_belief.common.action_encoding import RowEncoder
from sb3_belief.vec_env.team_vec_env import TeamObs, TeamStep, TeamVecEnv
from sb3_belief.vec_env.team_wrapper import TeamVecEnvWrapper
from sb3_belief.vec_env.validation import difference


class ObserveWindowVecEnv(TeamVecEnvWrapper):
    """
    Environment of a team in which agents observe their last ``L`` observations, float32 ``[L, d]``, the present one last.

    Before the beginning of the agent's own episode there are zeros, also where its life ends and it stays in the team.
    ``terminal_observation`` is the window that ends with its last observation. An observation is encoded as
    ``gymnasium.spaces.flatten`` does it, which for a Discrete one is one-hot.

    :param venv: Environment of the team
    :param windows: ``L`` for all agents, or by agent for some; at least 1
    :raises ValueError: If an agent is unknown, a window is not at least 1, or an observation is no vector (an image, a
        ``Dict``)
    """

    def __init__(self, venv: TeamVecEnv, windows: int | Mapping[str, int]):
        agents = venv.possible_agents
        if isinstance(windows, int) and not isinstance(windows, bool):
            windows = dict.fromkeys(agents, windows)
        if not isinstance(windows, Mapping) or not all(type(n) is int and n >= 1 for n in windows.values()):
            raise ValueError(
                f"observe_window={windows!r} must be a number of observations, at least 1, or a dict of it by agent."
            )
        _, unknown = difference(agents, windows)
        if unknown:
            raise ValueError(f"observe_window has the unknown agents {unknown}; the agents are {agents}.")
        observed: Any = venv.observation_space
        self._encoders = {agent: _encoder(agent, observed[agent]) for agent in windows}
        self._windows = {
            agent: np.zeros((venv.num_envs, n, self._encoders[agent].width), dtype=np.float32) for agent, n in windows.items()
        }
        super().__init__(
            venv,
            {
                agent: _stacked(observed[agent], self._encoders[agent].width, windows[agent])
                if agent in windows
                else observed[agent]
                for agent in agents
            },
        )

    def _reset_joint(self) -> TeamObs:
        obs = dict(super()._reset_joint())
        for agent, window in self._windows.items():
            self._windows[agent] = np.zeros_like(window)
            obs[agent] = self._with_last(agent, obs[agent])
        return obs

    def _step_joint(self, actions: TeamObs) -> TeamStep:
        obs, rewards, dones, infos = super()._step_joint(actions)
        joined: TeamObs = dict(obs)
        for i, agent in enumerate(self.possible_agents):
            if agent not in self._windows:
                continue
            own_ends = dones | np.array([info["life_end"][i] or info["truncated"][i] for info in infos])
            for copy in np.flatnonzero(own_ends):
                # Of an agent whose own return alone has ended, the present observation is the last one
                last = infos[copy].get("terminal_observation", {}).get(agent, obs[agent][copy])
                row = self._encoders[agent](np.asarray(last)[None])
                window = np.concatenate([self._windows[agent][copy, 1:], row])
                infos[copy].setdefault("terminal_observation", {})[agent] = window
            self._windows[agent][own_ends] = 0.0
            joined[agent] = self._with_last(agent, obs[agent])
        return joined, rewards, dones, infos

    def _with_last(self, agent: str, obs: np.ndarray) -> np.ndarray:
        # A new array, since models keep the old one
        window = np.concatenate([self._windows[agent][:, 1:], self._encoders[agent](np.asarray(obs))[:, None]], axis=1)
        self._windows[agent] = window.copy()
        return window

    def _copies_state(self) -> dict[str, Any]:
        return {"env": super()._copies_state(), "windows": {agent: window.copy() for agent, window in self._windows.items()}}

    def _set_copies_state(self, state: dict[str, Any]) -> None:
        super()._set_copies_state(state["env"])
        self._windows = {agent: state["windows"][agent].copy() for agent in self._windows}


def _encoder(agent: str, space: spaces.Space) -> RowEncoder:
    if isinstance(space, spaces.Dict) or is_image_space(space, check_channels=False):
        raise ValueError(
            f"{agent!r} observes {space}, of which there are no windows: they are of observations that can be a vector."
        )
    return RowEncoder(agent, space)


def _stacked(space: spaces.Space, width: int, n: int) -> spaces.Box:
    """Return the space of a window; the zeros before an episode lie in it, too."""
    low, high = (space.low, space.high) if isinstance(space, spaces.Box) else (np.zeros(width), np.ones(width))
    bounds = (np.minimum(np.ravel(low), 0), np.maximum(np.ravel(high), 0))
    low, high = (np.tile(np.asarray(part, dtype=np.float32), (n, 1)) for part in bounds)
    return spaces.Box(low, high, dtype=np.float32)
