"""The vectorised environment that one agent's model learns in: its own view of the team's."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from sb3_belief.vec_env.agent_step import AgentStep

if TYPE_CHECKING:
    from sb3_belief.team.lockstep.scheduler import Scheduler


class AgentVecEnv(VecEnv):
    """
    An SB3 ``VecEnv`` with one agent's own spaces, that steps only together with the others' in ``Team.learn``.

    ``infos[e]`` holds ``others_actions`` float32 [W] (the others in order, the scripted ones last: one-hot for Discrete and
    MultiDiscrete, values for Box and MultiBinary; zero where not visible), ``others_visible`` bool [n_others], ``active``
    bool, at a done ``terminal_observation`` and ``TimeLimit.truncated``, and at the end of the team's episode ``episode``
    (with the agent's own return) and ``is_success``. ``get_attr("others_action_spaces")`` tells the others' spaces, and where
    the environment gives action masks ``env_method("action_masks")`` those of the agent.

    :param hub: steps the team
    :param agent: name of the agent
    """

    def __init__(self, scheduler: "Scheduler", agent: str):
        self.agent = agent
        self._scheduler = scheduler
        self._actions = np.zeros(0)
        self._others_action_spaces = {other: space for other, space in scheduler.action_spaces.items() if other != agent}
        self._others_action_spaces.update(scheduler.scripted_action_spaces)
        super().__init__(scheduler.num_envs, scheduler.observation_spaces[agent], scheduler.action_spaces[agent])

    def reset(self) -> np.ndarray:
        """
        :return: the agent's part of the joint reset at the beginning of ``Team.learn``
        :raises RuntimeError: outside of it, or when the episodes are under way
        """
        return self._scheduler.first_observation(self.agent)

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> AgentStep:
        """
        :return: the agent's observations, rewards, dones and infos, when all the others have acted too
        :raises RuntimeError: outside of ``Team.learn``
        """
        return self._scheduler.exchange(self.agent, self._actions)

    def step(self, actions: np.ndarray) -> AgentStep:
        """
        :param actions: array [num_envs, ...]
        :return: as ``step_wait``
        :raises RuntimeError: outside of ``Team.learn``
        """
        return self._scheduler.exchange(self.agent, actions)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        # The joint environment is seeded once, by the Team; each model would seed it again
        return [None] * self.num_envs

    def close(self) -> None:
        """The joint environment is closed by who made it."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        known: dict[str, Any] = {
            "render_mode": self._scheduler.render_mode,
            "others_action_spaces": dict(self._others_action_spaces),
        }
        masks = self._scheduler.masks
        if masks is not None and self.agent in masks:
            known["action_masks"] = masks[self.agent]
        if attr_name not in known:
            # Nothing else of the environment reaches an agent
            raise AttributeError(f"The environment of {self.agent!r} has the attributes {list(known)}, not {attr_name!r}.")
        return [known[attr_name] for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        raise AttributeError(f"{attr_name!r} cannot be set through {self.agent!r}: set it on the team's environment.")

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        masks = self._scheduler.masks
        if method_name != "action_masks" or masks is None or self.agent not in masks:
            raise AttributeError(
                f"{method_name!r} cannot be called through {self.agent!r}"
                + (": the environment gives no action masks." if method_name == "action_masks" else ".")
            )
        return [masks[self.agent][env_idx] for env_idx in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        # Episode returns are in the infos, as with a Monitor
        return [issubclass(wrapper_class, Monitor) for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[np.ndarray | None]:
        return self._scheduler.get_images()
