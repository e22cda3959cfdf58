"""Many copies of the switching convention that are stepped at once."""

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from sb3_belief.envs.base import check_render_mode
from sb3_belief.envs.batched_vec_env import BatchedVecEnv
from sb3_belief.envs.switching_convention.game import ConventionConfig, ConventionGame
from sb3_belief.envs.switching_convention.parallel_env import FOLLOWER, LEADER
from sb3_belief.envs.switching_convention.rendering import draw_convention
from sb3_belief.vec_env.team_vec_env import TeamObs, TeamStep


class SwitchingConventionVecEnv(BatchedVecEnv):
    """
    Vectorised environment of ``num_envs`` copies of :class:`SwitchingConvention` in one numpy game, all with the same leader.

    ``seed(s)`` seeds copy i with s + i, where s is not the argument ``seed`` of the conventions. That copy then behaves the
    same, bit for bit, as one :class:`SwitchingConvention` that is reset with the seed s + i at first and without a seed
    afterwards. ``get_attr("convention")`` returns the current convention of each copy.

    :param num_envs: Number of environment copies, at least 1
    :param render_mode: None or ``"rgb_array"``
    :param env_kwargs: The other arguments of :class:`SwitchingConvention`
    :raises ValueError: For a value that is not allowed
    """

    def __init__(self, num_envs: int, render_mode: str | None = None, **env_kwargs: Any):
        if num_envs < 1:
            raise ValueError(f"num_envs={num_envs} must be at least 1.")
        self.config = ConventionConfig(**env_kwargs)
        self.game = ConventionGame(num_envs, self.config)
        numbers = {FOLLOWER: spaces.Discrete(self.config.m)}
        scripted: dict[str, spaces.Space] = {LEADER: spaces.Discrete(self.config.m)}
        super().__init__(
            num_envs,
            [FOLLOWER],
            numbers,
            numbers,
            render_mode=check_render_mode(render_mode, ("rgb_array",)),
            scripted_action_spaces=scripted,
        )
        self._one_hot = np.eye(self.config.m, dtype=np.float32)
        # All infos share these arrays, which are therefore read-only
        self._always = {
            "visible": np.array([[self.config.leader_visible]]),
            "active": np.ones(1, dtype=bool),
            "truncated": np.zeros(1, dtype=bool),
        }
        self._ends = np.zeros(1, dtype=bool), np.ones(1, dtype=bool)
        for shared in (*self._always.values(), *self._ends):
            shared.flags.writeable = False

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """
        Return an attribute of each copy.

        :param attr_name: Name of the attribute. ``"convention"`` gives each copy's current convention, int64 [m]
        :param indices: Indices of the copies. None for all
        :return: One value for each of these copies
        """
        if attr_name == "convention":
            return [self.game.conventions[copy].copy() for copy in self._get_indices(indices)]
        return super().get_attr(attr_name, indices)

    def _step_joint(self, actions: TeamObs) -> TeamStep:
        chosen = actions[FOLLOWER]
        if chosen.dtype.kind not in "iu" or chosen.min() < 0 or chosen.max() >= self.config.m:
            raise ValueError(f"Actions must be integers from 0 to {self.config.m - 1}, got {np.unique(chosen).tolist()}.")
        rewards, dones = self.game.step(chosen)
        infos: list[dict[str, Any]] = [
            {"agent_rewards": reward, "life_end": self._ends[done], "scripted_actions": scripted, **self._always}
            for reward, done, scripted in zip(rewards[:, None], dones.tolist(), self._one_hot[self.game.leader], strict=True)
        ]
        obs = self._observe()
        ended = np.flatnonzero(dones)
        if len(ended):
            for copy in ended:
                infos[copy]["TimeLimit.truncated"] = False
                infos[copy]["terminal_observation"] = {FOLLOWER: obs[FOLLOWER][copy]}
            self.game.reset(ended)
            obs = self._observe()
        # The follower is the only agent, so its reward is also the team's. A copy, so that the infos have arrays of their own
        return obs, rewards.copy(), dones, infos

    def get_images(self) -> list[np.ndarray | None]:
        """
        Return a picture of each copy.

        :return: One array per copy, uint8 [height, width, 3]
        """
        return [draw_convention(self.game, copy) for copy in range(self.num_envs)]

    @property
    def batched_game(self) -> ConventionGame:
        """The game that holds all copies."""
        return self.game

    def _observe(self) -> TeamObs:
        return {FOLLOWER: self.game.cue}
