"""Many copies of the Traffic Junction that are stepped at once."""

from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_belief.envs.base import check_render_mode, require_render_mode
from sb3_belief.envs.batched_vec_env import BatchedVecEnv
from sb3_belief.envs.traffic_junction.config import JunctionConfig
from sb3_belief.envs.traffic_junction.core import BRAKE, GAS, Step, TrafficCore
from sb3_belief.envs.traffic_junction.observation import Observer
from sb3_belief.envs.traffic_junction.parallel_env import (
    ACTION_NAMES,
    RENDER_MODES,
    TrafficJunction,
    action_masks,
    agent_names,
)
from sb3_belief.envs.traffic_junction.rendering import Renderer, positions_in_picture
from sb3_belief.vec_env.team_vec_env import TeamObs, TeamStep


class TrafficJunctionVecEnv(BatchedVecEnv):
    """
    Vectorised environment of ``num_envs`` copies of :class:`TrafficJunction` in one numpy core.

    ``seed(s)`` seeds copy i with s + i. That copy then behaves the same, bit for bit, as one :class:`TrafficJunction` that is
    reset with the seed s + i at first and without a seed afterwards.

    :param num_envs: Number of environment copies, at least 1
    :param render_mode: None, ``"rgb_array"`` or ``"human"`` (a window with the first copy)
    :param env_kwargs: The other arguments of :class:`TrafficJunction`
    :raises ValueError: For a value that is not allowed
    """

    action_names = ACTION_NAMES

    def __init__(self, num_envs: int, render_mode: str | None = None, **env_kwargs: Any):
        if num_envs < 1:
            raise ValueError(f"num_envs={num_envs} must be at least 1.")
        self.config = JunctionConfig(**env_kwargs)
        self.core = TrafficCore(num_envs, self.config)
        self._observer = Observer(self.core)
        self._renderer: Renderer | None = None
        agents = agent_names(self.config)
        layout = self._observer.layout
        super().__init__(
            num_envs,
            agents,
            {agent: layout.space() for agent in agents},
            {agent: spaces.Discrete(2) for agent in agents},
            render_mode=check_render_mode(render_mode, RENDER_MODES),
        )
        self._sees_now = np.zeros((num_envs, len(agents), len(agents)), dtype=bool)
        self._no_life_end = np.zeros((num_envs, len(agents)), dtype=bool)

    def _reset_joint(self) -> TeamObs:
        obs = super()._reset_joint()
        self._show()
        return obs

    def _step_joint(self, actions: TeamObs) -> TeamStep:
        joint = np.stack([actions[agent] for agent in self.possible_agents], axis=1)
        if not ((joint == GAS) | (joint == BRAKE)).all():
            raise ValueError(f"Actions must be {GAS} (gas) or {BRAKE} (brake), got {np.unique(joint).tolist()}.")
        saw = self._observer.of_others(self._sees_now)
        result = self.core.step(joint)
        infos = self._infos(result, saw)
        obs = self._observe()
        # Drawn before the reset, so that a window also shows the last step
        self._show()
        ended = np.flatnonzero(result.dones)
        if len(ended):
            masks = self.action_masks()
            for copy in ended:
                infos[copy]["terminal_action_masks"] = {agent: rows[copy] for agent, rows in masks.items()}
                infos[copy]["is_success"] = bool(self.core.n_collisions[copy] == 0)
                infos[copy]["TimeLimit.truncated"] = True
                infos[copy]["terminal_observation"] = {agent: values[copy] for agent, values in obs.items()}
            self.core.reset(ended)
            obs = self._observe()
        return obs, result.rewards.mean(axis=1).astype(np.float32), result.dones, infos

    def _infos(self, result: Step, saw: np.ndarray) -> list[dict[str, Any]]:
        rewards = result.rewards.astype(np.float32)
        life_end = result.left if self.config.reward == "own" else self._no_life_end
        truncated = result.dones[:, None] & ~life_end
        return [
            {"agent_rewards": reward, "visible": visible, "active": active, "life_end": life, "truncated": cut}
            for reward, visible, active, life, cut in zip(rewards, saw, result.acted, life_end, truncated, strict=True)
        ]

    def _observe(self) -> TeamObs:
        obs, self._sees_now = self._observer.observe()
        return dict(zip(self.possible_agents, obs, strict=True))

    def action_masks(self) -> dict[str, np.ndarray]:
        """
        Return which actions are possible now.

        :return: {agent: bool [num_envs, 2]}. A slot without a car may only brake
        """
        return dict(zip(self.possible_agents, action_masks(self.core).transpose(1, 0, 2), strict=True))

    def set_arrival_rate(self, arrival_rate: float) -> None:
        """
        Set the arrival rate of all copies, see :meth:`TrafficJunction.set_arrival_rate`.

        :param arrival_rate: Probability in [0, 1] that a car wants to enter, per entry and step
        :raises ValueError: If it is not a number in [0, 1]
        """
        self.core.set_arrival_rate(arrival_rate)

    @property
    def batched_game(self) -> TrafficCore:
        """The core that holds all copies."""
        return self.core

    def get_images(self) -> list[np.ndarray | None]:
        """
        Return a picture of each copy.

        :return: One array per copy, uint8 [height, width, 3]
        """
        return [self._get_renderer().image(self.core, copy) for copy in range(self.num_envs)]

    def picture_positions(self) -> dict[str, tuple[float, float]]:
        """
        Return where the cars are in the picture of the first copy, as :meth:`TrafficJunction.picture_positions` does.

        :return: {agent: (x, y)}
        """
        return positions_in_picture(self.core, 0, self.possible_agents)

    def render(self, mode: str | None = None) -> np.ndarray | None:
        """
        Return a picture of all copies, or show the first copy in a window.

        :param mode: ``"rgb_array"`` or ``"human"``. None for the render mode that the environment was made with
        :return: The pictures of all copies as tiles of one, uint8 [height, width, 3], or None with ``"human"``
        :raises ValueError: If there is no render mode
        """
        mode = require_render_mode(check_render_mode(mode or self.render_mode, RENDER_MODES), RENDER_MODES)
        if mode == "human":
            # VecEnv.render would open a window with OpenCV, which this package does not require
            self._get_renderer().show(self.core, 0, fps=TrafficJunction.metadata["render_fps"])
            return None
        return super().render(mode)

    def close(self) -> None:
        """Close the window and the monitor files."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        super().close()

    def _show(self) -> None:
        if self.render_mode == "human":
            self.render()

    def _get_renderer(self) -> Renderer:
        if self._renderer is None:
            self._renderer = Renderer(self.core.layout, self.core.max_steps)
        return self._renderer
