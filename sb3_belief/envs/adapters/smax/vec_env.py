"""Many copies of an SMAX battle that are stepped at once."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_belief.envs.adapters.smax.core import Battles
from sb3_belief.envs.adapters.smax.parallel_env import RENDER_MODES, observation_space
from sb3_belief.envs.adapters.smax.program import BattleConfig
from sb3_belief.envs.adapters.smax.rendering import draw, unit_positions
from sb3_belief.envs.base import check_render_mode
from sb3_belief.vec_env.states import ENVIRONMENT, unbounded
from sb3_belief.vec_env.team_vec_env import TeamObs, TeamStep, TeamVecEnv


class SmaxVecEnv(TeamVecEnv):
    """
    Vectorised environment of ``num_envs`` copies of :class:`~sb3_belief.envs.adapters.smax.parallel_env.Smax` in one compiled
    step.

    Each copy has a random generator of its own. ``seed(s)`` seeds copy i with s + i. That copy then behaves the same as one
    ``Smax`` that is reset with the seed s + i at first and without a seed afterwards.

    :param num_envs: Number of environment copies, at least 1
    :param map_name: Name of a map
    :param observe_last_actions: Whether observations contain the last actions of the allies in view
    :param render_mode: None or ``"rgb_array"``
    :param options: Settings of SMAX to change
    :raises ValueError: For a value that is not allowed
    """

    def __init__(
        self,
        num_envs: int,
        map_name: str,
        observe_last_actions: bool = False,
        render_mode: str | None = None,
        **options: Any,
    ):
        if num_envs < 1:
            raise ValueError(f"num_envs={num_envs} must be at least 1.")
        self.battles = Battles(num_envs, BattleConfig.of(map_name, observe_last_actions, options))
        agents = self.battles.agents
        super().__init__(
            num_envs,
            agents,
            {agent: observation_space(self.battles) for agent in agents},
            {agent: spaces.Discrete(self.battles.n_actions) for agent in agents},
            render_mode=check_render_mode(render_mode, RENDER_MODES),
        )
        # All infos share these arrays, which are therefore read-only
        self._no_flags, self._all_flags = np.zeros(len(agents), dtype=bool), np.ones(len(agents), dtype=bool)
        for shared in (self._no_flags, self._all_flags):
            shared.flags.writeable = False

    def _reset_joint(self) -> TeamObs:
        for copy, seed in enumerate(self._seeds):
            if seed is not None:
                self.battles.seed(copy, seed)
        self.battles.reset()
        return self._observe()

    def _step_joint(self, actions: TeamObs) -> TeamStep:
        joint = np.stack([actions[agent] for agent in self.possible_agents], axis=1)
        if joint.dtype.kind not in "iu" or joint.min() < 0 or joint.max() >= self.battles.n_actions:
            raise ValueError(self._wrong_action(joint))
        result = self.battles.step(joint)
        team_rewards = result.rewards
        rewards = np.repeat(team_rewards[:, None], len(self.possible_agents), axis=1)
        infos: list[dict[str, Any]] = [
            {
                "agent_rewards": reward,
                "visible": visible,
                "active": active,
                # The reward is the team's, so a death ends no agent's return and the end of the battle ends all of them
                "life_end": self._all_flags if ended and not cut else self._no_flags,
                "truncated": self._all_flags if cut else self._no_flags,
            }
            for reward, visible, active, ended, cut in zip(
                rewards, result.visible, result.active, result.ended.tolist(), result.cut.tolist(), strict=True
            )
        ]
        for copy in np.flatnonzero(~result.alive.all(axis=1)):
            dead = zip(self.possible_agents, result.alive[copy].tolist(), strict=True)
            infos[copy]["agent_infos"] = {agent: {"next_active": False} for agent, alive in dead if not alive}
        obs = self._observe()
        ended = np.flatnonzero(result.ended)
        if len(ended):
            masks = self.action_masks()
            states = self.battles.world_states() if self._asked_for_states else None
            for copy in ended:
                if states is not None:
                    infos[copy]["terminal_state"] = states[copy]
                infos[copy]["terminal_action_masks"] = {agent: rows[copy] for agent, rows in masks.items()}
                infos[copy]["is_success"] = bool(result.won[copy])
                infos[copy]["TimeLimit.truncated"] = bool(result.cut[copy])
                infos[copy]["terminal_observation"] = {agent: values[copy] for agent, values in obs.items()}
            self.battles.reset(ended)
            obs = self._observe()
        return obs, team_rewards, result.ended, infos

    def _observe(self) -> TeamObs:
        return dict(zip(self.possible_agents, self.battles.observations, strict=True))

    def _wrong_action(self, joint: np.ndarray) -> str:
        allowed = f"allowed are the integers from 0 to {self.battles.n_actions - 1}"
        if joint.dtype.kind not in "iu":
            return f"The actions are of type {joint.dtype}; {allowed}."
        copy, i = np.argwhere((joint < 0) | (joint >= self.battles.n_actions))[0]
        return f"The action of {self.possible_agents[i]!r} in copy {copy} is {joint[copy, i]}; {allowed}."

    def action_masks(self) -> dict[str, np.ndarray]:
        """
        Return which actions are possible now.

        :return: {agent: bool [num_envs, k]}. Dead agents may only stop
        """
        return dict(zip(self.possible_agents, self.battles.masks, strict=True))

    @property
    def state_source(self) -> str:
        """``"env"``: states are SMAX's own."""
        return ENVIRONMENT

    @property
    def state_space(self) -> spaces.Box:
        """The space of a state."""
        return unbounded(self.battles.state_width)

    def states(self) -> np.ndarray:
        """
        Return SMAX's world states, as :meth:`Smax.state` does.

        :return: float32 [num_envs, width]
        """
        self._last_observations()
        self._asked_for_states = True
        return self.battles.world_states()

    def _tell_terminal_states(self, dones: np.ndarray, infos: list[dict[str, Any]]) -> None:
        """Do nothing: a step does it, before it begins the next battle."""

    def get_state(self) -> list[dict[str, Any]]:
        """
        Return everything that determines the following steps of each copy.

        :return: One state for each copy
        """
        return self.battles.get_states()

    def set_state(self, states: Sequence[dict[str, Any]]) -> TeamObs:
        """
        Restore the states of all copies. The monitored returns and lengths of the running episodes start from zero.

        :param states: States that ``get_state`` returned for as many copies of the same map
        :return: The current observations, {agent: array [num_envs, width]}
        :raises ValueError: If the number of copies or the map differs
        """
        self.battles.set_states(states)
        self._zero_episode_sums()
        return self._observe()

    @property
    def action_names(self) -> tuple[str, ...]:
        """The names of the actions of each agent."""
        return self.battles.action_names

    def picture_positions(self) -> dict[str, tuple[float, float]]:
        """
        Return where the living agents are in the picture of the first copy.

        :return: {agent: (x, y)} as fractions of its width and height, from the upper left corner
        """
        return unit_positions(self.battles, 0)

    def get_images(self) -> list[np.ndarray | None]:
        """
        Return a picture of each copy.

        :return: One array per copy, uint8 [height, width, 3]
        """
        return [draw(self.battles, copy) for copy in range(self.num_envs)]
