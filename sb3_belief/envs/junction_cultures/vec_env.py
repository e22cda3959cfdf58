"""Many copies of the junction with cultures that are stepped at once."""

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from sb3_belief.envs.base import check_render_mode
from sb3_belief.envs.batched_vec_env import BatchedVecEnv
from sb3_belief.envs.junction_cultures.config import CultureConfig
from sb3_belief.envs.junction_cultures.core import CultureCore
from sb3_belief.envs.junction_cultures.parallel_env import LEARNER, learner_position, learner_space
from sb3_belief.envs.traffic_junction.core import BRAKE, GAS
from sb3_belief.envs.traffic_junction.parallel_env import ACTION_NAMES, action_masks, agent_names
from sb3_belief.envs.traffic_junction.rendering import Renderer
from sb3_belief.vec_env.team_vec_env import TeamObs, TeamStep


class JunctionCulturesVecEnv(BatchedVecEnv):
    """
    Vectorised environment of ``num_envs`` copies of :class:`JunctionCultures` in one numpy core.

    ``seed(s)`` seeds copy i with s + i. That copy then behaves the same, bit for bit, as one :class:`JunctionCultures` that is
    reset with the seed s + i at first and without a seed afterwards. ``get_attr("partner")`` returns the name of each copy's
    present culture, and ``info["partner"]`` that of the culture that was valid in the step.

    :param num_envs: Number of environment copies, at least 1
    :param render_mode: None or ``"rgb_array"``
    :param env_kwargs: The other arguments of :class:`JunctionCultures`
    :raises ValueError: For a value that is not allowed
    """

    action_names = ACTION_NAMES

    def __init__(self, num_envs: int, render_mode: str | None = None, **env_kwargs: Any):
        if num_envs < 1:
            raise ValueError(f"num_envs={num_envs} must be at least 1.")
        self.config = CultureConfig(**env_kwargs)
        self.core = CultureCore(num_envs, self.config)
        super().__init__(
            num_envs,
            [LEARNER],
            {LEARNER: learner_space(self.config)},
            {LEARNER: spaces.Discrete(2)},
            render_mode=check_render_mode(render_mode, ("rgb_array",)),
            scripted_action_spaces={car: spaces.Discrete(2) for car in agent_names(self.config.junction)[1:]},
        )
        self._names = self.config.names
        self._one_hot = np.eye(2, dtype=np.float32)
        self._renderer: Renderer | None = None

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """
        Return an attribute of each copy.

        :param attr_name: Name of the attribute. ``"partner"`` gives the name of each copy's present culture
        :param indices: Indices of the copies. None for all
        :return: One value for each of these copies
        """
        if attr_name == "partner":
            return [self._names[self.core.types.current[copy]] for copy in self._get_indices(indices)]
        return super().get_attr(attr_name, indices)

    def _step_joint(self, actions: TeamObs) -> TeamStep:
        chosen = actions[LEARNER]
        if not ((chosen == GAS) | (chosen == BRAKE)).all():
            raise ValueError(f"Actions must be {GAS} (gas) or {BRAKE} (brake), got {np.unique(chosen).tolist()}.")
        partners = self.get_attr("partner")
        result = self.core.step(chosen)
        rewards = result.rewards[:, :1].astype(np.float32)
        scripted = self._one_hot[self.core.actions[:, 1:]].reshape(self.num_envs, -1)
        life_ends = result.left[:, :1]
        infos: list[dict[str, Any]] = [
            {
                "agent_rewards": own,
                "visible": saw,
                "scripted_actions": did,
                "active": active,
                "life_end": life_end,
                "truncated": truncated,
                "partner": name,
            }
            for own, saw, did, active, life_end, truncated, name in zip(
                rewards,
                self.core.saw[:, None].copy(),
                scripted,
                result.acted[:, :1],
                life_ends,
                result.dones[:, None] & ~life_ends,
                partners,
                strict=True,
            )
        ]
        obs = self.core.observe()
        ended = np.flatnonzero(result.dones)
        if len(ended):
            masks = self.action_masks()[LEARNER]
            for copy in ended:
                infos[copy]["terminal_action_masks"] = {LEARNER: masks[copy]}
                infos[copy]["is_success"] = bool(self.core.traffic.n_collisions[copy] == 0)
                infos[copy]["TimeLimit.truncated"] = bool(infos[copy]["truncated"][0])
                infos[copy]["terminal_observation"] = {LEARNER: obs[copy]}
            self.core.reset(ended)
            obs = self.core.observe()
        return {LEARNER: obs}, rewards[:, 0].copy(), result.dones, infos

    def action_masks(self) -> dict[str, np.ndarray]:
        """
        Return which actions are possible now.

        :return: {agent: bool [num_envs, 2]}. A slot without a car may only brake
        """
        return {LEARNER: action_masks(self.core.traffic)[:, 0]}

    def get_images(self) -> list[np.ndarray | None]:
        """
        Return a picture of each copy.

        :return: One array per copy, uint8 [height, width, 3]
        """
        if self._renderer is None:
            self._renderer = Renderer(self.core.traffic.layout, self.core.traffic.max_steps)
        return [self._renderer.image(self.core.traffic, copy) for copy in range(self.num_envs)]

    def picture_positions(self) -> dict[str, tuple[float, float]]:
        """
        Return where the learner is in the picture of the first copy, as :meth:`JunctionCultures.picture_positions` does.

        :return: {agent: (x, y)}
        """
        return learner_position(self.core)

    @property
    def batched_game(self) -> CultureCore:
        """The core that holds all copies."""
        return self.core

    def _observe(self) -> TeamObs:
        return {LEARNER: self.core.observe()}
