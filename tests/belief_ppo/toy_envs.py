"""Environments of one agent among scripted others, small enough to know every number."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class AmongOthers(gym.Env):
    """
    One agent among others who act at random and are visible now and then.

    :param others: Their action spaces
    :param invisible_seed: Seed of the actions that the agent does not see; must change nothing for it
    :param inactive: Every how many steps the agent is out of play, 0 for never
    :param episode_length: Steps until the time limit
    """

    def __init__(
        self,
        others: dict[str, spaces.Space] | None = None,
        invisible_seed: int = 0,
        inactive: int = 0,
        episode_length: int = 7,
        action_space: spaces.Space | None = None,
        observation_space: spaces.Space | None = None,
    ) -> None:
        self.others_action_spaces = {"b": spaces.Discrete(3), "c": spaces.Discrete(4)} if others is None else others
        self.observation_space = observation_space or spaces.Box(-1, 1, (5,), np.float32)
        self.action_space = action_space or spaces.Discrete(3)
        self.inactive, self.episode_length = inactive, episode_length
        self.invisible = np.random.default_rng(invisible_seed)

    def _info(self) -> dict[str, Any]:
        visible = self.np_random.random(len(self.others_action_spaces)) < 0.6
        parts = []
        for index, space in enumerate(self.others_action_spaces.values()):
            shown = np.asarray(spaces.flatten(space, space_sample(space, self.np_random)), dtype=np.float32)
            hidden = np.asarray(spaces.flatten(space, space_sample(space, self.invisible)), dtype=np.float32)
            parts.append(shown if visible[index] else hidden)
        active = not (self.inactive and self.steps % self.inactive == 0)
        return {"others_actions": np.concatenate(parts), "others_visible": visible, "active": active}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.steps = 0
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        reward = float(self.np_random.random() + np.sum(action) / 10)
        return self.observation_space.sample(), reward, False, self.steps >= self.episode_length, self._info()


def space_sample(space: spaces.Space, rng: np.random.Generator) -> Any:
    """A sample of a space from a generator at hand."""
    space.seed(int(rng.integers(2**31)))
    return space.sample()
