"""Many copies of the aisles that are stepped at once."""

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from sb3_belief.envs.aisle_sides.config import MIDDLE, RIGHT, AisleConfig, convention_names
from sb3_belief.envs.aisle_sides.core import AisleCore
from sb3_belief.envs.aisle_sides.parallel_env import ACTION_NAMES, aisle_observation_space, robot_names, visible_others
from sb3_belief.envs.aisle_sides.rendering import draw_aisles, robot_positions
from sb3_belief.envs.base import check_render_mode
from sb3_belief.envs.batched_vec_env import BatchedVecEnv
from sb3_belief.vec_env.team_vec_env import TeamObs, TeamStep


class AisleSidesVecEnv(BatchedVecEnv):
    """
    Vectorised environment of ``num_envs`` copies of :class:`AisleSides` in one numpy core.

    ``seed(s)`` seeds copy i with s + i. That copy then behaves the same, bit for bit, as one :class:`AisleSides` that is reset
    with the seed s + i at first and without a seed afterwards. ``get_attr("partner")`` returns the name of each copy's present
    convention, and ``info["partner"]`` that of the convention that was valid in the step.

    :param num_envs: Number of environment copies, at least 1
    :param render_mode: None or ``"rgb_array"``
    :param env_kwargs: The other arguments of :class:`AisleSides`
    :raises ValueError: For a value that is not allowed
    """

    action_names = ACTION_NAMES

    def __init__(self, num_envs: int, render_mode: str | None = None, **env_kwargs: Any):
        if num_envs < 1:
            raise ValueError(f"num_envs={num_envs} must be at least 1.")
        self.config = AisleConfig(**env_kwargs)
        self.core = AisleCore(num_envs, self.config)
        agents, others = robot_names(self.config)
        super().__init__(
            num_envs,
            agents,
            {agent: aisle_observation_space(self.config) for agent in agents},
            {agent: spaces.Discrete(len(ACTION_NAMES)) for agent in agents},
            render_mode=check_render_mode(render_mode, ("rgb_array",)),
            scripted_action_spaces={other: spaces.Discrete(len(ACTION_NAMES)) for other in others},
        )
        self._names = convention_names(self.config.kinds)
        self._one_hot = np.eye(len(ACTION_NAMES), dtype=np.float32)
        # All infos share these arrays, which are therefore read-only
        self._always = {"active": np.ones(len(agents), dtype=bool), "life_end": np.zeros(len(agents), dtype=bool)}
        for shared in self._always.values():
            shared.flags.writeable = False

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """
        Return an attribute of each copy.

        :param attr_name: Name of the attribute. ``"partner"`` gives the name of each copy's present convention
        :param indices: Indices of the copies. None for all
        :return: One value for each of these copies
        """
        if attr_name == "partner":
            return [self._names[self.core.types.current[copy]] for copy in self._get_indices(indices)]
        return super().get_attr(attr_name, indices)

    def _step_joint(self, actions: TeamObs) -> TeamStep:
        joint = np.stack([actions[agent] for agent in self.possible_agents], axis=1)
        if joint.dtype.kind not in "iu" or joint.min() < MIDDLE or joint.max() > RIGHT:
            raise ValueError(f"Actions must be 0 (middle), 1 (left) or 2 (right), got {np.unique(joint).tolist()}.")
        partners = self.get_attr("partner")
        rewards, dones = self.core.step(joint)
        visible = visible_others(self.core)
        scripted = self._one_hot[self.core.other_action].reshape(self.num_envs, -1)
        truncated = np.repeat(dones[:, None], len(self.possible_agents), axis=1)
        infos: list[dict[str, Any]] = [
            {"agent_rewards": own, "visible": saw, "scripted_actions": did, "truncated": cut, "partner": name, **self._always}
            for own, saw, did, cut, name in zip(rewards, visible, scripted, truncated, partners, strict=True)
        ]
        obs = self._observe()
        ended = np.flatnonzero(dones)
        if len(ended):
            for copy in ended:
                infos[copy]["TimeLimit.truncated"] = True
                infos[copy]["terminal_observation"] = {agent: values[copy] for agent, values in obs.items()}
            self.core.reset(ended)
            obs = self._observe()
        return obs, rewards.mean(axis=1), dones, infos

    def get_images(self) -> list[np.ndarray | None]:
        """
        Return a picture of each copy.

        :return: One array per copy, uint8 [height, width, 3]
        """
        return [draw_aisles(self.core, copy) for copy in range(self.num_envs)]

    def picture_positions(self) -> dict[str, tuple[float, float]]:
        """
        Return where the learners are in the picture of the first copy, as :meth:`AisleSides.picture_positions` does.

        :return: {agent: (x, y)}
        """
        return robot_positions(self.core, 0, self.possible_agents)

    @property
    def batched_game(self) -> AisleCore:
        """The core that holds all copies."""
        return self.core

    def _observe(self) -> TeamObs:
        return dict(zip(self.possible_agents, self.core.observe(), strict=True))
