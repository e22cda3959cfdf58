"""The last step in the observations of a single learner among fixed partners."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_belief.vec_env.observation_forms import map_parts
from sb3_belief.vec_env.observe_last import LastStepForm


class ObserveLast(gym.Wrapper):
    """
    Environment of a single learner that also observes its last step, as with ``make_team_env(observe_last=True)``.

    It is made of what ``info`` holds (``others_actions``, ``others_visible``, ``active``), its action and its reward, and is
    zero after each ``reset()``. For SB3: ``make_vec_env(AgentEnv, wrapper_class=ObserveLast, env_kwargs=...)``.

    :param env: An ``AgentEnv``, or wrappers around one that leave its observations and infos alone
    :param observe_last: Whether the observation holds the last step; False with ``partner_starts`` for the flag alone
    :param partner_starts: Whether the observation has an entry ``memory_start``, 1 where another partner has come since the
        last step, and the last step is kept from one episode to the next for as long as the partner stays
    :raises TypeError: If the environment does not say who the others are
    :raises ValueError: If the observation has an entry of that name already, or if the environment does not say which partner
        is there
    """

    def __init__(self, env: gym.Env, observe_last: bool = True, partner_starts: bool = False):
        super().__init__(env)
        others = getattr(env.unwrapped, "others_action_spaces", None)
        agent = getattr(env.unwrapped, "agent", None)
        if others is None or agent is None:
            raise TypeError(
                f"ObserveLast needs an AgentEnv, whose infos hold the others' actions, got {type(env.unwrapped).__name__}; for"
                " a team there is make_team_env(observe_last=True)."
            )
        self._form = LastStepForm(
            agent, env.observation_space, env.action_space, others, last=observe_last, starts=partner_starts
        )
        self.observation_space = self._form.space
        self._last = np.zeros((1, self._form.width), dtype=np.float32)
        self._partner_starts, self._partner = partner_starts, ""
        if partner_starts and self._asked_partner() is None:
            raise ValueError(
                "partner_starts needs an environment that says which partner is there, by an attribute 'partner'; this one has"
                " none. Leave it out."
            )

    @property
    def action_masks(self) -> Callable[[], np.ndarray]:
        """
        The method ``action_masks()`` of the environment.

        :raises AttributeError: If there are no masks
        """
        return self.env.get_wrapper_attr("action_masks")

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """
        Begin an episode of the learner.

        :param seed: As for ``AgentEnv``; with one the memory starts anew
        :param options: As for ``AgentEnv``
        :return: The learner's observation and the info
        """
        obs, info = self.env.reset(seed=seed, options=options)
        starts = self._another_partner() or seed is not None
        if starts or not self._partner_starts:
            self._last[:] = 0.0
        return self._joined(obs, starts), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """
        Step the team.

        :param action: The learner's action
        :return: As of ``AgentEnv``; the last observation of an episode holds the step with which it ends
        """
        obs, reward, terminated, truncated, info = self.env.step(action)
        given = (info["others_actions"], info["others_visible"], info["active"], action, np.float32(reward))
        self._last = self._form.last_step(*(np.asarray(part)[None] for part in given))
        # After an end the next partner may have been drawn already: reset() tells
        starts = not (terminated or truncated) and self._another_partner()
        if starts:
            self._last[:] = 0.0
        return self._joined(obs, starts), reward, terminated, truncated, info

    def _joined(self, obs: Any, starts: bool) -> Any:
        rows = map_parts(lambda part: np.asarray(part)[None], obs)
        return map_parts(lambda part: part[0], self._form.join(rows, self._last, np.array([starts])))

    def _asked_partner(self) -> Any:
        env: Any = self.env.unwrapped
        return getattr(env, "partner", None) or getattr(getattr(env, "parallel_env", None), "partner", None)

    def _another_partner(self) -> bool:
        """Return whether there is another partner than when this was asked last."""
        if not self._partner_starts:
            return False
        before, self._partner = self._partner, str(self._asked_partner())
        return before != self._partner
