"""SMAX as a PettingZoo environment."""

from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from sb3_belief.envs.adapters.smax.core import Battles
from sb3_belief.envs.adapters.smax.program import BattleConfig
from sb3_belief.envs.adapters.smax.rendering import draw
from sb3_belief.envs.base import BattleGame, check_render_mode, require_render_mode

RENDER_MODES = ("rgb_array",)


class Smax(BattleGame[np.ndarray]):
    """
    One battle of allies, the agents, against SMAX's scripted enemies.

    **Actions**, ``Discrete(5 + enemies)``: four directions, 4 stop, then attack enemy 0, 1, ... The mask in
    ``infos[agent]["action_mask"]`` says what is possible next; what it forbids is carried out as "stop". The dead may only
    stop and stay among ``agents``, inactive, until the battle ends.

    **Reward**: the team's, the same for all, also for the dead. So a death ends nobody's return (no ``life_end`` before the
    end), and an agent's sacrifice is rewarded by what the others make of it.

    **End**: terminated when one side is dead, ``is_success`` if that is the enemies alone; truncated by the step limit.

    **Visibility**: j is visible to i if, after the step, both are alive and j is nearer than the sight range of i's type.

    :param map_name: one of ``names()``
    :param observe_last_actions: leave the last actions of allies in view in the observation. Off by default: what
        teammates do reaches a learner through ``others_actions``, otherwise one without a belief gets it for nothing.
    :param render_mode: None or ``"rgb_array"``
    :param options: what to change of SMAX, see :data:`~sb3_belief.envs.adapters.smax.program.OPTIONS`
    :raises ValueError: for an unknown map, option or render mode
    """

    metadata: ClassVar[dict[str, Any]] = {
        "name": "smax",
        "render_modes": list(RENDER_MODES),
        "is_parallelizable": True,
        "render_fps": 6,
    }

    def __init__(self, map_name: str, observe_last_actions: bool = False, render_mode: str | None = None, **options: Any):
        self.render_mode = check_render_mode(render_mode, RENDER_MODES)
        self.battles = Battles(1, BattleConfig.of(map_name, observe_last_actions, options))
        self.possible_agents = list(self.battles.agents)
        self.agents: list[str] = []
        self.observation_spaces: dict[str, spaces.Space] = {
            agent: observation_space(self.battles) for agent in self.possible_agents
        }
        self.action_spaces: dict[str, spaces.Space] = {
            agent: spaces.Discrete(self.battles.n_actions) for agent in self.possible_agents
        }
        self._visible = np.zeros((len(self.possible_agents), len(self.possible_agents) - 1), dtype=bool)

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, dict[str, Any]]]:
        """
        :param seed: restarts the random generator; None: it goes on
        :param options: not used
        :return: observations and infos, by agent
        """
        if seed is not None:
            self.battles.seed(0, seed)
        self.battles.reset()
        self.agents = list(self.possible_agents)
        self._visible = np.zeros_like(self._visible)
        masks = self.battles.masks[:, 0]
        return self._observe(), {agent: {"action_mask": masks[i]} for i, agent in enumerate(self.possible_agents)}

    def step(
        self, actions: dict[str, int]
    ) -> tuple[dict[str, np.ndarray], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """
        :param actions: one for every agent, also for the dead
        :return: observations, rewards, terminations, truncations and infos, by agent
        :raises ValueError: if an agent's action is missing or outside its space, or if no episode is under way
        """
        self._require_episode()
        result = self.battles.step(np.array([[self._checked_action(agent, actions) for agent in self.possible_agents]]))
        self._visible = result.visible[0]
        ended, cut = bool(result.ended[0]), bool(result.cut[0])
        masks = self.battles.masks[:, 0]
        infos: dict[str, dict[str, Any]] = {
            agent: {"active": bool(result.active[0, i]), "action_mask": masks[i]}
            for i, agent in enumerate(self.possible_agents)
        }
        if ended:
            self.agents = []
            for info in infos.values():
                info["is_success"] = bool(result.won[0])
        return (
            self._observe(),
            dict.fromkeys(self.possible_agents, float(result.rewards[0])),
            dict.fromkeys(self.possible_agents, ended and not cut),
            dict.fromkeys(self.possible_agents, cut),
            infos,
        )

    def visibility(self) -> dict[str, np.ndarray]:
        """
        :return: whose action of the last step each agent could observe, {agent: bool [n_others]}, the others in the order of
            ``possible_agents``; all False after ``reset``
        """
        return dict(zip(self.possible_agents, self._visible, strict=True))

    def get_state(self) -> dict[str, Any]:
        """
        :return: all that decides how the episode and those after it go on, as arrays and plain data
        """
        return {"battle": self.battles.get_states()[0], "visible": self._visible.copy(), "under_way": bool(self.agents)}

    def set_state(self, state: dict[str, Any]) -> None:
        """
        Go on where ``get_state`` was called.

        :param state: what ``get_state`` returned in an environment of the same map
        :raises ValueError: if it was another map
        """
        self.battles.set_states([state["battle"]])
        self._visible = np.array(state["visible"], dtype=bool)
        self.agents = list(self.possible_agents) if state["under_way"] else []

    def render(self) -> np.ndarray | None:
        """
        :return: a picture of the battlefield, uint8 [height, width, 3]
        :raises ValueError: if the environment was made without a render mode
        """
        require_render_mode(self.render_mode, RENDER_MODES)
        return draw(self.battles, 0)

    def close(self) -> None:
        """Nothing is open."""

    def _observe(self) -> dict[str, np.ndarray]:
        return dict(zip(self.possible_agents, self.battles.observations[:, 0], strict=True))


def observation_space(battles: Battles) -> spaces.Box:
    """
    :param battles: copies of a battle
    :return: the space of each agent's observation
    """
    # Nearly all values are in [-1, 1]; who is pushed over the border of the map has a position just outside
    return spaces.Box(-np.inf, np.inf, (battles.width,), dtype=np.float32)
