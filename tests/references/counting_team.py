"""A game of which every number can be told beforehand, with agents that differ in what they see and can do."""

from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from sb3_belief.references.joint_vec_env import JointVecEnv
from sb3_belief.team import make_team_env


class CountingTeam(ParallelEnv):
    """
    Counts its steps ``t``. Agent "a" sees ``(t, length)``, agent "b" ``t mod 3``; the state is ``(t, 10 t)``.

    Action 1 of "a" is legal at even ``t``, action 2 of "b" in the observation in which an episode ends. The reward of "a" is
    its own action, that of "b" is 2. From the observation at ``t = dies`` on "b" is out of play.

    :param length: Steps of an episode
    :param truncates: Whether a limit cuts it off there
    :param masks: Whether the infos hold masks
    :param dies: When "b" dies; None for never
    """

    metadata: ClassVar[dict[str, Any]] = {"name": "counting_team_v0", "render_modes": []}

    def __init__(self, length: int = 3, truncates: bool = False, masks: bool = True, dies: int | None = None):
        self.length, self.truncates, self.masks, self.dies = length, truncates, masks, dies
        self.possible_agents = ["a", "b"]
        self.agents: list[str] = []
        self.render_mode = None
        self._observation_spaces = {"a": spaces.Box(0, 100, (2,), np.float32), "b": spaces.Discrete(3)}
        self._action_spaces: dict[str, Any] = {"a": spaces.Discrete(2), "b": spaces.Discrete(3)}

    def observation_space(self, agent):
        return self._observation_spaces[agent]

    def action_space(self, agent):
        return self._action_spaces[agent]

    @property
    def state_space(self):
        return spaces.Box(0, 1000, (2,), np.float32)

    def state(self):
        return np.array([self.t, 10 * self.t], dtype=np.float32)

    def reset(self, seed=None, options=None):
        self.t, self.agents = 0, list(self.possible_agents)
        return self._observe(), self._infos()

    def step(self, actions):
        self.t += 1
        done = self.t == self.length
        if done:
            self.agents = []
        rewards = {"a": float(actions["a"]), "b": 2.0}
        ends = {agent: done and not self.truncates for agent in rewards}, {agent: done and self.truncates for agent in rewards}
        infos = self._infos()
        if self.dies is not None and self.t >= self.dies:
            infos["b"] |= {"life_end": self.t == self.dies, "active": self.t == self.dies, "next_active": False}
        return self._observe(), rewards, *ends, infos

    def _observe(self):
        return {"a": np.array([self.t, self.length], dtype=np.float32), "b": self.t % 3}

    def _infos(self):
        if not self.masks:
            return {agent: {} for agent in self.possible_agents}
        masks = {"a": [True, self.t % 2 == 0], "b": [True, True, self.t == self.length]}
        return {agent: {"action_mask": np.array(mask)} for agent, mask in masks.items()}


class UnequalTeam(CountingTeam):
    """
    A ``CountingTeam`` whose episodes have 3, 4, 5 steps in turn, and after whose last step action 0 is not legal.

    :param nothing: Whether no action at all is legal then
    """

    def __init__(self, nothing: bool = False, **kwargs: Any):
        super().__init__(**kwargs)
        self.nothing, self._episode = nothing, 0

    def reset(self, seed=None, options=None):
        self.length, self._episode = 3 + self._episode % 3, self._episode + 1
        return super().reset(seed, options)

    def _infos(self):
        infos = super()._infos()
        if self.t == self.length:
            for agent, n_actions in (("a", 2), ("b", 3)):
                infos[agent]["action_mask"] = (np.arange(n_actions) == 1) & (not self.nothing)
        return infos


def recorded_logs(model: Any) -> list[dict[str, float]]:
    """Return a list that is filled with what each further update of a factorised learner logs."""
    logs: list[dict[str, float]] = []
    update = model._update

    def record(batch: Any) -> dict[str, float]:
        logs.append(update(batch))
        return logs[-1]

    model._update = record
    return logs


def joint_env(n_envs: int = 1, **kwargs: Any) -> JointVecEnv:
    """Return the game as one environment."""
    return JointVecEnv(make_team_env(lambda: CountingTeam(**kwargs), n_envs=n_envs))
