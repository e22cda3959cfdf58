"""The Traffic Junction as a PettingZoo environment."""

from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from sb3_belief.envs.base import ResetResult, StepResult, TeamGame, check_render_mode, require_render_mode
from sb3_belief.envs.traffic_junction.config import JunctionConfig
from sb3_belief.envs.traffic_junction.core import BRAKE, GAS, TrafficCore
from sb3_belief.envs.traffic_junction.observation import Observer
from sb3_belief.envs.traffic_junction.rendering import Renderer, positions_in_picture

RENDER_MODES = ("human", "rgb_array")
ACTION_NAMES = ("gas", "brake")


class TrafficJunction(TeamGame[np.ndarray, int]):
    """
    Traffic Junction (Sukhbaatar et al. 2016, https://arxiv.org/abs/1605.07736): cars that see only the 3x3 cells around them
    cross a junction.

    Each car follows a fixed route and decides at each step whether to drive on (0, gas) or to wait (1, brake). An episode
    succeeds if no two cars are in the same cell whenever collisions are counted.

    **Levels.** ``easy``: 7x7 cells, two one-way roads, 5 cars, 20 steps. ``medium``: 14x14 cells, one junction of two
    two-way roads, 4 entries x 3 routes, 10 cars, 40 steps. ``hard``: 18x18 cells, four junctions, 8 entries x 7 routes,
    20 cars, 80 steps. Traffic keeps to the right. An episode is truncated at the step limit and never terminates.

    **Agents** ``car_0 .. car_{N-1}`` are slots. Each slot holds at most one car at a time, and a car that has arrived is
    followed by another one. All agents stay in ``agents`` for the whole episode. A slot without a car observes zeros and may
    only brake. Its action is ignored and its own reward is 0.

    **Reward.** ``own``: a car gets -5 for each other car in the same cell and -0.01 tau, where tau is the number of steps
    since it entered, if it was on the road when it acted and still is when collisions are counted. ``team``: every agent,
    with or without a car, gets the mean of these rewards over all slots. Both hold for both orders of events, which are
    described at :class:`~sb3_belief.envs.traffic_junction.core.TrafficCore`.

    **Infos.** ``action_mask``, bool [2], is for the next action and also given by ``reset``. After ``step``, ``active`` says
    whether a car was on the road in this slot when the action was chosen, and ``life_end`` whether that car reached its
    destination, so that its own return ends (always False with the team reward). The last step adds ``is_success``.

    **Observation**, float32 with N slots and R routes (easy 5 and 2, medium 10 and 12, hard 20 and 56)::

        0            1 if a car is in the slot (otherwise everything is 0)
        1            its last action (0 also when it has just entered)
        2 .. 1+R     its route, one-hot
        2+R          row / (size - 1)
        3+R          column / (size - 1)
        4+R          tau / step limit
        5+R ..       for each cell in view, row by row from the upper left one: the number of other cars in it,
                     their ids (one-hot, N), their routes (one-hot, R) [, how many of them braked at the last step]

    The width is ``5 + R + (2 vision + 1)**2 * (1 + N + R [+ 1])``: easy 79, medium 224, hard 754. A car is not among the
    cars that it sees. Several cars in one cell set several ids and routes. The number in brackets exists only with
    ``observe_last_actions``.

    :param level: ``"easy"``, ``"medium"`` or ``"hard"``
    :param order: Order of events in a step: ``"commnet"`` (move, collisions, removal, arrivals, as in the paper) or
        ``"ic3net"`` (move and removal, arrivals, collisions)
    :param reward: ``"own"`` or ``"team"``
    :param arrival_rate: Probability in [0, 1] that a car wants to enter, per entry and step. None for the level's default:
        0.3 (easy), 0.2 (medium), 0.05 (hard)
    :param reward_scale: Factor on all rewards, > 0 (0.1 suits PPO)
    :param vision: Largest distance in rows and in columns at which a car sees other cars and their actions, in cells, >= 0
        (1 shows 3x3 cells)
    :param observe_last_actions: Whether observations contain the last actions of the cars in view. Off by default, because a
        learner gets the actions of others through ``others_actions``. In the observation, a learner without a belief would
        have them too
    :param render_mode: None, ``"rgb_array"`` or ``"human"``
    :raises ValueError: For any other value
    """

    metadata: ClassVar[dict[str, Any]] = {
        "name": "traffic_junction_v0",
        "render_modes": list(RENDER_MODES),
        "is_parallelizable": True,
        "render_fps": 6,
    }
    action_names = ACTION_NAMES

    def __init__(
        self,
        level: str = "medium",
        order: str = "commnet",
        reward: str = "own",
        arrival_rate: float | None = None,
        reward_scale: float = 1.0,
        vision: int = 1,
        observe_last_actions: bool = False,
        render_mode: str | None = None,
    ):
        self.config = JunctionConfig(level, order, reward, arrival_rate, reward_scale, vision, observe_last_actions)
        self.render_mode = check_render_mode(render_mode, RENDER_MODES)
        self.core = TrafficCore(1, self.config)
        self._observer = Observer(self.core)
        self._renderer: Renderer | None = None
        self.possible_agents = agent_names(self.config)
        self.agents: list[str] = []
        layout = self._observer.layout
        self.observation_spaces: dict[str, spaces.Space] = {agent: layout.space() for agent in self.possible_agents}
        self.action_spaces: dict[str, spaces.Space] = {agent: spaces.Discrete(2) for agent in self.possible_agents}
        n_cars = len(self.possible_agents)
        # Which car sees which in the current state, and in the state in which the last actions were chosen
        self._sees_now = np.zeros((1, n_cars, n_cars), dtype=bool)
        self._saw = np.zeros((1, n_cars, n_cars), dtype=bool)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> ResetResult:
        """
        Start an episode on an empty road.

        :param seed: Seed of the random generator. With None the generator continues
        :param options: Not used
        :return: Observations and infos, by agent
        """
        if seed is not None:
            self.core.seed(0, seed)
        self.core.reset()
        self.agents = list(self.possible_agents)
        obs = self._observe()
        self._saw = np.zeros_like(self._sees_now)
        masks = action_masks(self.core)[0]
        if self.render_mode == "human":
            self.render()
        return obs, {agent: {"action_mask": masks[i]} for i, agent in enumerate(self.possible_agents)}

    def step(self, actions: dict[str, int]) -> StepResult:
        """
        Advance the episode by one step.

        :param actions: 0 (gas) or 1 (brake) for every agent
        :return: Observations, rewards, terminations (all False), truncations (all True at the step limit) and infos, by agent
        :raises ValueError: If an agent's action is missing or neither 0 nor 1, or if no episode is under way
        """
        self._require_episode()
        joint = np.array([[self._action_of(agent, actions) for agent in self.possible_agents]])
        self._saw = self._sees_now
        result = self.core.step(joint)
        obs = self._observe()
        done = bool(result.dones[0])
        life_end = result.left[0] if self.config.reward == "own" else np.zeros_like(result.left[0])
        masks = action_masks(self.core)[0]
        infos: dict[str, dict[str, Any]] = {
            agent: {"active": bool(result.acted[0, i]), "life_end": bool(life_end[i]), "action_mask": masks[i]}
            for i, agent in enumerate(self.possible_agents)
        }
        if done:
            self.agents = []
            for info in infos.values():
                info["is_success"] = bool(self.core.n_collisions[0] == 0)
        if self.render_mode == "human":
            self.render()
        rewards = dict(zip(self.possible_agents, result.rewards[0].tolist(), strict=True))
        return obs, rewards, dict.fromkeys(self.possible_agents, False), dict.fromkeys(self.possible_agents, done), infos

    def visibility(self) -> dict[str, np.ndarray]:
        """
        Return whose action of the last step each agent could observe.

        An action is visible if both cars were on the road and at most ``vision`` rows and columns apart when the actions were
        chosen.

        :return: {agent: bool [n_others]}, the others in the order of ``possible_agents``. All False after ``reset``
        """
        visible = self._observer.of_others(self._saw)[0]
        return dict(zip(self.possible_agents, visible, strict=True))

    def team_reward(self, rewards: dict[str, float]) -> float:
        """
        Return the mean of the agents' rewards.

        :param rewards: Rewards by agent, as ``step`` returned them
        :return: Their mean over all slots
        """
        return float(np.mean([rewards[agent] for agent in self.possible_agents]))

    def set_arrival_rate(self, arrival_rate: float) -> None:
        """
        Set the arrival rate from the next step on, for instance to raise it from 0.05 to 0.2 in a curriculum.

        :param arrival_rate: Probability in [0, 1] that a car wants to enter, per entry and step
        :raises ValueError: If it is not a number in [0, 1]
        """
        self.core.set_arrival_rate(arrival_rate)

    def get_state(self) -> dict[str, Any]:
        """
        Return everything that determines the rest of this episode and the following ones.

        :return: Arrays and plain data
        """
        return {"core": self.core.get_state(0), "saw": self._saw[0].copy(), "under_way": bool(self.agents)}

    def set_state(self, state: dict[str, Any]) -> None:
        """
        Restore a state. With the same actions, everything that follows is then the same bit for bit.

        :param state: State that ``get_state`` returned in an environment of the same level
        :raises ValueError: If it is the state of another level
        """
        self.core.set_state(0, state["core"])
        # Sets _sees_now, which is not part of the state
        self._observe()
        self._saw = np.array(state["saw"], dtype=bool)[None]
        self.agents = list(self.possible_agents) if state["under_way"] else []

    def render(self) -> np.ndarray | None:
        """
        Return a picture of the junction, or show it in a window.

        :return: uint8 [height, width, 3] with the render mode ``"rgb_array"``, None with ``"human"``
        :raises ValueError: If the environment was made without a render mode
        :raises ImportError: If pygame is not installed
        """
        mode = require_render_mode(self.render_mode, RENDER_MODES)
        if self._renderer is None:
            self._renderer = Renderer(self.core.layout, self.core.max_steps)
        if mode == "human":
            self._renderer.show(self.core, 0, fps=self.metadata["render_fps"])
            return None
        return self._renderer.image(self.core, 0)

    def picture_positions(self) -> dict[str, tuple[float, float]]:
        """
        Return where the cars are in the picture.

        :return: {agent: (x, y)} of the slots with a car, as fractions of its width and height, from the upper left corner
        """
        return positions_in_picture(self.core, 0, self.possible_agents)

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _observe(self) -> dict[str, np.ndarray]:
        obs, self._sees_now = self._observer.observe()
        return dict(zip(self.possible_agents, obs[:, 0], strict=True))

    def _action_of(self, agent: str, actions: dict[str, int]) -> int:
        if agent not in actions:
            raise ValueError(f"No action for {agent!r}: every agent needs one at each step, including a slot without a car.")
        action = actions[agent]
        if action not in (GAS, BRAKE):
            raise ValueError(f"The action of {agent!r} is {action!r}; allowed are {GAS} (gas) and {BRAKE} (brake).")
        return int(action)


def agent_names(config: JunctionConfig) -> list[str]:
    """
    Return the names of the slots.

    :param config: The rules
    :return: ``car_0``, ``car_1``, ...
    """
    return [f"car_{i}" for i in range(config.level_spec.n_cars)]


def action_masks(core: TrafficCore) -> np.ndarray:
    """
    Return which actions are possible now.

    :param core: The copies
    :return: bool [n_copies, n_cars, 2]. A slot without a car may only brake
    """
    return np.stack([core.on_road, np.ones_like(core.on_road)], axis=-1)
