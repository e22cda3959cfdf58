"""
A team whose agents are trained by one model.

A centralised learner is an SB3 model in a vectorised environment that shows the whole team as one. With that environment seen
as a team of one agent, everything that takes a ``Team`` takes the learner: progress bar, logs, callbacks, evaluation, files,
exact resumption, ``enjoy``, studies and reports.
"""

from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from sb3_belief.vec_env.own_infos import RESERVED
from sb3_belief.vec_env.team_vec_env import TeamObs, TeamStep, TeamVecEnv
from sb3_belief.vec_env.team_wrapper import TeamVecEnvWrapper

#: Name of the one agent, which acts for all
LEARNER = "team"
_OWN_ATTRIBUTES = frozenset(("action_masks", "possible_agents", "scripted_action_spaces"))
# For the team's log, and for no learner
_OF_TEAM = frozenset(("partner",))


class OneLearnerVecEnv(TeamVecEnvWrapper):
    """
    A ``TeamVecEnv`` with the single agent ``"team"``, who acts for all agents of another one.

    Its observations, actions, rewards and infos are those of ``joint``, a vectorised environment with one row for each copy,
    which steps ``venv``: SB3's conventions hold for it (``terminal_observation``, ``TimeLimit.truncated``; a copy is reset
    when it is done). It may also have ``action_masks() -> bool [n_envs, k]``, for a model that takes masks. It keeps nothing
    that decides how it goes on, so that the state of ``venv`` is all that a checkpoint needs.

    :param venv: The environment of the agents
    :param joint: What shows it as one
    """

    def __init__(self, venv: TeamVecEnv, joint: VecEnv):
        super().__init__(
            venv, {LEARNER: joint.observation_space}, scripted_action_spaces={}, action_spaces={LEARNER: joint.action_space}
        )
        #: What the learner sees
        self.joint: Any = joint

    def _reset_joint(self) -> TeamObs:
        return {LEARNER: self.joint.reset()}

    def _step_joint(self, actions: TeamObs) -> TeamStep:
        obs, rewards, dones, infos = self.joint.step(actions[LEARNER])
        rewards = np.asarray(rewards, dtype=np.float32)
        ours = [self._info(info, reward, bool(done)) for info, reward, done in zip(infos, rewards, dones, strict=True)]
        return {LEARNER: obs}, rewards, np.asarray(dones, dtype=bool), ours

    @staticmethod
    def _info(info: dict[str, Any], reward: np.floating, done: bool) -> dict[str, Any]:
        """Return a copy's info as a ``TeamVecEnv`` has it."""
        cut = done and bool(info.get("TimeLimit.truncated", False))
        said = {key: value for key, value in info.items() if key not in RESERVED}
        result = {
            **said,
            "agent_rewards": np.array([reward], dtype=np.float32),
            "visible": np.zeros((1, 0), dtype=bool),
            "active": np.ones(1, dtype=bool),
            "life_end": np.array([done and not cut]),
            "truncated": np.array([cut]),
        }
        if own := {key: value for key, value in said.items() if key not in _OF_TEAM}:
            result["agent_infos"] = {LEARNER: own}
        if done:
            result |= {"terminal_observation": {LEARNER: info["terminal_observation"]}, "TimeLimit.truncated": cut}
            if "is_success" in info:
                result["is_success"] = info["is_success"]
        return result

    def action_masks(self) -> dict[str, np.ndarray] | None:
        masks = self.joint.action_masks() if hasattr(self.joint, "action_masks") else None
        return None if masks is None else {LEARNER: masks}

    def has_attr(self, attr_name: str) -> bool:
        return attr_name in _OWN_ATTRIBUTES or super().has_attr(attr_name)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        if attr_name in _OWN_ATTRIBUTES:
            return TeamVecEnv.get_attr(self, attr_name, indices)
        return super().get_attr(attr_name, indices)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        if method_name == "action_masks":
            return TeamVecEnv.env_method(self, method_name, indices=indices)
        return super().env_method(method_name, *method_args, indices=indices, **method_kwargs)
