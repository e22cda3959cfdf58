"""Tiny environments of one agent among others that act at random."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class AmongOthers(gym.Env):
    """
    Environment of one agent among others that act at random and are visible at some steps.

    Unlike a correct environment it does not zero the actions of those others that are not visible. The model must ignore
    them by itself.

    :param others: Action spaces of the others by name. None for one of 3 and one of 4 discrete actions
    :param invisible_seed: Seed of the actions that are not visible. It must not make any difference to the agent
    :param inactive: The agent is out of play at every step whose number this divides. 0 for never
    :param episode_length: Steps until the time limit
    :param action_space: Action space of the agent. None for 3 discrete actions
    :param observation_space: Observation space of the agent. None for 5 numbers in [-1, 1]
    :param visible: Probability with which each of the others is visible at a step
    """

    def __init__(
        self,
        others: dict[str, spaces.Space] | None = None,
        invisible_seed: int = 0,
        inactive: int = 0,
        episode_length: int = 7,
        action_space: spaces.Space | None = None,
        observation_space: spaces.Space | None = None,
        visible: float = 0.6,
    ) -> None:
        self.others_action_spaces = {"b": spaces.Discrete(3), "c": spaces.Discrete(4)} if others is None else others
        self.observation_space = observation_space or spaces.Box(-1, 1, (5,), np.float32)
        self.action_space = action_space or spaces.Discrete(3)
        self.inactive, self.episode_length, self.visible = inactive, episode_length, visible
        self.invisible = np.random.default_rng(invisible_seed)

    def _info(self) -> dict[str, Any]:
        visible = self.np_random.random(len(self.others_action_spaces)) < self.visible
        parts = [np.zeros(0, dtype=np.float32)]
        for index, space in enumerate(self.others_action_spaces.values()):
            shown, hidden = flat_sample(space, self.np_random), flat_sample(space, self.invisible)
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

    def action_masks(self) -> np.ndarray:
        """
        Return the masks of the next action, bool ``[k]``.

        Every third choice is impossible, for MultiBinary a one in every third component. Which ones depends on the step. Only
        the subclass ``MaskedAmongOthers`` raises if an impossible action is taken.

        :return: Whether each choice is possible
        """
        space, possible = self.action_space, (np.arange(20) + self.steps) % 3 != 0
        if isinstance(space, spaces.Discrete):
            return possible[: space.n]
        if isinstance(space, spaces.MultiDiscrete):
            return np.concatenate([possible[:n] for n in space.nvec])
        assert isinstance(space, spaces.MultiBinary)
        return np.stack([np.ones(space.n, dtype=bool), possible[: space.n]], axis=1).flatten()


class MaskedAmongOthers(AmongOthers):
    """An ``AmongOthers`` that raises if an impossible action is taken."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        possible, start = self.action_masks(), 0
        for value, n in zip(np.asarray(action, dtype=int).flatten(), choices_of(self.action_space), strict=True):
            if not possible[start + value]:
                raise ValueError(f"{action} is impossible at step {self.steps}")
            start += n
        return super().step(action)


def choices_of(space: spaces.Space) -> list[int]:
    """Return the number of choices for each component of an action."""
    if isinstance(space, spaces.Discrete):
        return [int(space.n)]
    return [int(n) for n in space.nvec] if isinstance(space, spaces.MultiDiscrete) else [2] * spaces.flatdim(space)


def flat_sample(space: spaces.Space, rng: np.random.Generator) -> np.ndarray:
    """Draw an action of a space from a given generator and return it flattened."""
    if isinstance(space, spaces.Box):
        return rng.uniform(space.low, space.high).astype(np.float32).flatten()
    if isinstance(space, spaces.MultiBinary):
        return rng.integers(2, size=space.n).astype(np.float32)
    return np.concatenate([np.arange(n) == rng.integers(n) for n in choices_of(space)]).astype(np.float32)
