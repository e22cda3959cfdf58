"""Base class of what is put around a team's vectorised environment and is itself one."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from sb3_belief.vec_env.team_vec_env import TeamObs, TeamStep, TeamVecEnv


class TeamVecEnvWrapper(TeamVecEnv):
    """
    A ``TeamVecEnv`` around another one, whose copies it resets and steps; it says what the one within says.

    An SB3 ``VecEnvWrapper`` would do for one that leaves the spaces alone. A team reads its environment's agents and spaces
    from the ``TeamVecEnv`` itself, so what changes these has to be one.

    :param venv: The environment within
    :param observation_spaces: Observation space of each agent that is one to the outside, in place of that of ``venv``
    :param scripted_action_spaces: Action spaces of the others who act within. None for those of ``venv``
    :param action_spaces: Action space of each agent that is one to the outside. None for those of ``venv``
    """

    def __init__(
        self,
        venv: TeamVecEnv,
        observation_spaces: Mapping[str, spaces.Space],
        scripted_action_spaces: Mapping[str, spaces.Space] | None = None,
        action_spaces: Mapping[str, spaces.Space] | None = None,
    ):
        #: The environment within
        self.venv = venv
        acted: Any = venv.action_space
        super().__init__(
            venv.num_envs,
            list(observation_spaces),
            observation_spaces,
            {agent: acted[agent] for agent in observation_spaces} if action_spaces is None else action_spaces,
            render_mode=venv.render_mode,
            scripted_action_spaces=venv.scripted_action_spaces if scripted_action_spaces is None else scripted_action_spaces,
        )
        # What was asked of the environment within holds for this one
        self.reports_success, self._seeds = venv.reports_success, list(venv._seeds)
        self.monitor_dir, venv.monitor_dir = venv.monitor_dir, None

    @property
    def n_restarts(self) -> int:
        """How often copies have been made anew after a fault."""
        return getattr(self.venv, "n_restarts", 0)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        self._seeds = list(self.venv.seed(seed))
        return self._seeds

    def set_options(self, options: list[dict] | dict | None = None) -> None:
        self.venv.set_options(options)

    def begin_rollout(self) -> None:
        self.venv.begin_rollout()

    @property
    def state_source(self) -> str:
        """Where the states of the environment within come from."""
        return self.venv.state_source

    @property
    def state_space(self) -> spaces.Box:
        """The space of the states of the environment within."""
        return self.venv.state_space

    def states(self) -> np.ndarray:
        return self.venv.states()

    def action_masks(self) -> dict[str, np.ndarray] | None:
        masks = self.venv.action_masks()
        return None if masks is None else {agent: masks[agent] for agent in self.possible_agents if agent in masks}

    def close(self) -> None:
        super().close()
        self.venv.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        return self.venv.get_images()

    def has_attr(self, attr_name: str) -> bool:
        return self.venv.has_attr(attr_name)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        return self.venv.get_attr(attr_name, indices)

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        self.venv.set_attr(attr_name, value, indices)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        return self.venv.env_method(method_name, *method_args, indices=indices, **method_kwargs)

    def _reset_joint(self) -> TeamObs:
        return self.venv.reset()

    def _step_joint(self, actions: TeamObs) -> TeamStep:
        # The one within counts its steps and episodes, too: its error messages say where something went wrong
        return self.venv.step(actions)

    def _copies_state(self) -> dict[str, Any]:
        return self.venv.exact_state()

    def _set_copies_state(self, state: dict[str, Any]) -> None:
        self.venv.set_exact_state(state)
