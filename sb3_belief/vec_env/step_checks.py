"""Checks of the joint steps of all copies at once."""

from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

import numpy as np
from gymnasium import spaces

from sb3_belief.common.action_masks import mask_parts
from sb3_belief.vec_env.observation_forms import parts_of
from sb3_belief.vec_env.validation import n_choices, not_a_choice, not_finite, place


class StepChecks:
    """
    Checks of the joint steps of all copies at once.

    They first look for a sign that anything is wrong, which costs next to nothing, and only then for what it is.

    :param agents: Names of the agents
    :param observation_spaces: Observation space of each agent
    :param action_spaces: Action space of each agent
    """

    def __init__(
        self,
        agents: Sequence[str],
        observation_spaces: Mapping[str, spaces.Space],
        action_spaces: Mapping[str, spaces.Space],
    ):
        self._agents, self._action_spaces = list(agents), action_spaces
        self._floats = [
            (agent, key)
            for agent in agents
            for key, part in parts_of(observation_spaces[agent]).items()
            if np.issubdtype(part.dtype, np.floating)
        ]
        self._choices = [
            (agent, key, part, n_choices(part))
            for agent in agents
            for key, part in parts_of(observation_spaces[agent]).items()
            if n_choices(part) is not None
        ]
        self._bounds = {agent: _bounds(action_spaces[agent]) for agent in agents}
        parts = [(i, size) for i, agent in enumerate(agents) for size in mask_parts(action_spaces[agent])]
        # Whose each dimension of the masks is, and where it begins
        self._mask_owners = [i for i, _ in parts]
        self._mask_starts = np.cumsum([0, *(size for _, size in parts[:-1])])
        #: Agents whose present mask allows no action, {(copy, number of the agent): step}
        self.unable: dict[tuple[int, int], int] = {}

    def check_discrete(self, agent: str, chosen: np.ndarray, steps: np.ndarray) -> list[int]:
        """
        Check the actions of an agent with a ``Discrete`` action space.

        :param agent: Name of the agent
        :param chosen: Its actions, ``[num_envs]``
        :param steps: How many steps each copy's episode has had, int ``[num_envs]``
        :return: The actions as plain integers
        :raises ValueError: If one is not in its space
        """
        numbers = chosen.tolist()
        if chosen.dtype.kind not in "iub" or min(numbers) < 0 or max(numbers) > self._bounds[agent][1]:
            self._refuse_action(agent, chosen, steps)
        return numbers

    def check_vectors(self, agent: str, chosen: np.ndarray, steps: np.ndarray) -> np.ndarray:
        """
        Check the actions of an agent with another action space.

        :param agent: Name of the agent
        :param chosen: Its actions, ``[num_envs, ...]``
        :param steps: How many steps each copy's episode has had, int ``[num_envs]``
        :return: The actions
        :raises ValueError: If one is not in its space
        """
        low, high = self._bounds[agent]
        if not ((chosen >= low) & (chosen <= high)).all():
            self._refuse_action(agent, chosen, steps)
        return chosen

    def _refuse_action(self, agent: str, chosen: np.ndarray, steps: np.ndarray) -> NoReturn:
        low, high = self._bounds[agent]
        fits = ((chosen >= low) & (chosen <= high)).reshape(len(chosen), -1).all(axis=1)
        # Where all values fit, it is their dtype that does not, and copy 0 serves as the example
        copy = int(np.argmin(fits))
        raise ValueError(
            f"The action of {agent!r} {place(copy, int(steps[copy]) + 1)} is {chosen[copy].tolist()!r} (type {chosen.dtype}),"
            f" which is not in its action space {self._action_spaces[agent]}. An SB3 model's own actions are; clip or convert"
            " others."
        )

    def check_finite(self, obs: Mapping[str, Any], rewards: np.ndarray, steps: np.ndarray) -> None:
        """
        Check that observations and rewards are finite, and discrete observations in their spaces.

        :param obs: Observations by agent, ``[num_envs, ...]``
        :param rewards: Rewards of the agents, float32 ``[num_envs, n]``
        :param steps: How many steps each copy's episode has had, int ``[num_envs]``
        :raises ValueError: If a number is not finite, or an observation not in its space
        """
        for agent, key, space, n in self._choices:
            values = obs[agent] if key is None else obs[agent][key]
            fits = (values >= 0) & (values < n)
            if not fits.all():
                copy = int(np.argmin(fits.reshape(len(steps), -1).all(axis=1)))
                where = place(copy, int(steps[copy]) + 1)
                raise not_a_choice(_name(agent, key), values[copy], agent, space, where)
        for agent, key in self._floats:
            values = obs[agent] if key is None else obs[agent][key]
            if not _all_finite(values):
                copy = int(np.argmin(np.isfinite(values).reshape(len(steps), -1).all(axis=1)))
                raise not_finite(_name(agent, key), values[copy], place(copy, int(steps[copy]) + 1))
        if not _all_finite(rewards):
            copy, i = (int(k) for k in np.argwhere(~np.isfinite(rewards))[0])
            raise not_finite(f"reward of {self._agents[i]!r}", rewards[copy, i], place(copy, int(steps[copy]) + 1))

    def check_masks(self, masks: np.ndarray, steps: np.ndarray) -> None:
        """
        Find masks that allow no action, and let these allow the first one, since a model must choose something.

        :param masks: Masks of all agents side by side, bool ``[num_envs, width of all]``, changed in place
        :param steps: How many steps each copy's episode has had, int ``[num_envs]``
        """
        self.unable = {}
        if not self._mask_owners:
            return
        possible = np.logical_or.reduceat(masks, self._mask_starts, axis=1)
        if not possible.all():
            for copy, k in np.argwhere(~possible).tolist():
                masks[copy, self._mask_starts[k]] = True
                self.unable[copy, self._mask_owners[k]] = int(steps[copy])

    def possible(self, masks: np.ndarray) -> np.ndarray:
        """
        Return the masks after the last step of an episode, in which those that allow no action allow the first one.

        Nobody acts on them, so none is an error.

        :param masks: Masks of all agents side by side, bool ``[width of all]``
        :return: The same, or a copy
        """
        if not self._mask_owners:
            return masks
        possible = np.logical_or.reduceat(masks, self._mask_starts)
        if not possible.all():
            masks = masks.copy()
            masks[self._mask_starts[~possible]] = True
        return masks

    def check_unable(self, infos: list[dict[str, Any]]) -> None:
        """
        Check that agents whose masks allowed no action were out of play in the step that followed.

        Only now is it known: an agent that is not on turn, for instance, is.

        :param infos: Of that step
        :raises ValueError: If one was in play
        """
        for (copy, i), step in self.unable.items():
            if "active" in infos[copy] and infos[copy]["active"][i]:
                raise self.refuse_unable((copy, i), step)

    def refuse_unable(self, which: tuple[int, int], step: int) -> ValueError:
        """
        Return the error for an agent whose mask allows no action although it is in play.

        :param which: Copy and number of the agent
        :param step: Of its episode, in which the mask was given
        """
        agent = self._agents[which[1]]
        return ValueError(
            f"The action mask of {agent!r} {place(which[0], step)} allows no action: a model must always choose one, so allow"
            " one that does nothing. If it could not act in the next step, as one that is not on turn, let the environment"
            f" say infos[{agent!r}]['active'] = False there. A turn-based AEC game is converted by"
            " sb3_belief.envs.to_parallel(env, turn_based=True)."
        )


def _name(agent: str, key: str | None) -> str:
    return f"observation of {agent!r}" if key is None else f"entry {key!r} of the observation of {agent!r}"


def _all_finite(values: np.ndarray) -> bool:
    # The fastest look at all numbers: zero times any number is zero, but not zero times NaN or infinity
    flat = values.reshape(-1)
    with np.errstate(invalid="ignore"):
        return flat.dot(np.zeros(flat.size, dtype=flat.dtype)) == 0.0


def _bounds(space: spaces.Space) -> tuple[Any, Any]:
    """Return the bounds of actions; for a ``Box`` with a margin, because rescaling rounds."""
    if isinstance(space, spaces.Discrete):
        return 0, int(space.n) - 1
    if isinstance(space, spaces.MultiDiscrete):
        return np.zeros_like(space.nvec), space.nvec - 1
    if isinstance(space, spaces.Box):
        low, high = space.low.astype(np.float64), space.high.astype(np.float64)
        margin = np.where(np.isfinite(low) & np.isfinite(high), 1e-4 * (high - low), 0.0)
        return low - margin, high + margin
    return 0, 1
