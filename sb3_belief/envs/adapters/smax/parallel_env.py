"""SMAX as a PettingZoo environment."""

from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from sb3_belief.envs.adapters.smax.core import Battles
from sb3_belief.envs.adapters.smax.program import BattleConfig
from sb3_belief.envs.adapters.smax.rendering import draw, unit_positions
from sb3_belief.envs.base import BattleGame, ResetResult, StepResult, check_render_mode, require_render_mode

RENDER_MODES = ("rgb_array",)


class Smax(BattleGame[np.ndarray]):
    """
    Battle of a team of allies, which are the agents, against SMAX's scripted enemies.

    **Actions**, ``Discrete(5 + enemies)``: four directions, 4 stop, then attack enemy 0, 1, ... The mask in
    ``infos[agent]["action_mask"]`` says which actions are possible next. Any other is carried out as "stop". Dead agents may
    only stop. They stay in ``agents`` and are inactive until the battle ends.

    **Reward**: the team's reward, which all agents get, dead ones too. A death therefore does not end an agent's return (there
    is no ``life_end`` before the end), and a sacrifice is rewarded by what the others achieve with it.

    **End**: terminated when one side is dead, with ``is_success`` if only the enemies are. Truncated by the step limit.

    **Visibility**: j is visible to i if, after the step, both are alive and j is closer than the sight range of i's type.

    :param map_name: One of ``names()``
    :param observe_last_actions: Whether observations contain the last actions of the allies in view. Off by default, because a
        learner gets the actions of others through ``others_actions``. In the observation, a learner without a belief would
        have them too
    :param render_mode: None or ``"rgb_array"``
    :param options: Settings of SMAX to change, see :data:`~sb3_belief.envs.adapters.smax.program.OPTIONS`
    :raises ValueError: For an unknown map, option or render mode
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

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> ResetResult:
        """
        Start a battle.

        :param seed: Seed of the random generator. With None the generator continues
        :param options: Not used
        :return: Observations and infos, by agent
        """
        if seed is not None:
            self.battles.seed(0, seed)
        self.battles.reset()
        self.agents = list(self.possible_agents)
        self._visible = np.zeros_like(self._visible)
        masks = self.battles.masks[:, 0]
        return self._observe(), {agent: {"action_mask": masks[i]} for i, agent in enumerate(self.possible_agents)}

    def step(self, actions: dict[str, int]) -> StepResult:
        """
        Advance the battle by one step.

        :param actions: Action of every agent, including dead ones
        :return: Observations, rewards, terminations, truncations and infos, by agent
        :raises ValueError: If an agent's action is missing or outside its space, or if no episode is under way
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
        for i in np.flatnonzero(~result.alive[0]):
            infos[self.possible_agents[i]]["next_active"] = False
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

    @property
    def state_space(self) -> spaces.Box:
        """The space of :meth:`state`."""
        return spaces.Box(-np.inf, np.inf, (self.battles.state_width,), dtype=np.float32)

    def state(self) -> np.ndarray:
        """
        Return SMAX's world state: what is known of all units, allies and enemies.

        :return: float32 [width]
        """
        return self.battles.world_states()[0]

    def visibility(self) -> dict[str, np.ndarray]:
        """
        Return whose action of the last step each agent could observe.

        :return: {agent: bool [n_others]}, the others in the order of ``possible_agents``. All False after ``reset``
        """
        return dict(zip(self.possible_agents, self._visible, strict=True))

    def get_state(self) -> dict[str, Any]:
        """
        Return everything that determines the rest of this episode and the following ones.

        :return: Arrays and plain data
        """
        return {"battle": self.battles.get_states()[0], "visible": self._visible.copy(), "under_way": bool(self.agents)}

    def set_state(self, state: dict[str, Any]) -> None:
        """
        Restore a state.

        :param state: State that ``get_state`` returned in an environment of the same map
        :raises ValueError: If it is the state of another map
        """
        self.battles.set_states([state["battle"]])
        self._visible = np.array(state["visible"], dtype=bool)
        self.agents = list(self.possible_agents) if state["under_way"] else []

    @property
    def action_names(self) -> tuple[str, ...]:
        """The names of the actions of each agent."""
        return self.battles.action_names

    def picture_positions(self) -> dict[str, tuple[float, float]]:
        """
        Return where the living agents are in the picture.

        :return: {agent: (x, y)} as fractions of its width and height, from the upper left corner
        """
        return unit_positions(self.battles, 0)

    def render(self) -> np.ndarray | None:
        """
        Return a picture of the battlefield.

        :return: uint8 [height, width, 3]
        :raises ValueError: If the environment was made without a render mode
        """
        require_render_mode(self.render_mode, RENDER_MODES)
        return draw(self.battles, 0)

    def close(self) -> None:
        """Do nothing, since no window is open."""

    def _observe(self) -> dict[str, np.ndarray]:
        return dict(zip(self.possible_agents, self.battles.observations[:, 0], strict=True))


def observation_space(battles: Battles) -> spaces.Box:
    """
    Return a new observation space of one agent.

    :param battles: Copies of a battle
    :return: Unbounded box, float32 [width]
    """
    # Nearly all values are in [-1, 1], but a unit that is pushed over the border of the map has a position just outside
    return spaces.Box(-np.inf, np.inf, (battles.width,), dtype=np.float32)
