"""The Traffic Junction as a PettingZoo environment."""

from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from sb3_belief.envs.base import TeamGame, check_render_mode, require_render_mode
from sb3_belief.envs.traffic_junction.config import JunctionConfig
from sb3_belief.envs.traffic_junction.core import BRAKE, GAS, TrafficCore
from sb3_belief.envs.traffic_junction.observation import Observer
from sb3_belief.envs.traffic_junction.rendering import Renderer

RENDER_MODES = ("human", "rgb_array")


class TrafficJunction(TeamGame[np.ndarray, int]):
    """
    Traffic Junction (Sukhbaatar et al. 2016, https://arxiv.org/abs/1605.07736): cars cross a junction that they see only
    3x3 cells of. Each follows its route and decides at each step only whether to drive on (0, gas) or to wait (1, brake).
    An episode succeeds if no two cars are ever in the same cell when collisions are looked for.

    **Levels.** ``easy``: 7x7 cells, two one-way roads, 5 cars, 20 steps. ``medium``: 14x14 cells, one junction of two
    two-way roads, 4 entries x 3 routes, 10 cars, 40 steps. ``hard``: 18x18 cells, four junctions, 8 entries x 7 routes,
    20 cars, 80 steps. Traffic keeps to the right. At the step limit the episode is truncated; nothing terminates it
    before.

    **Agents** ``car_0 .. car_{N-1}`` are slots: each holds a car while one is on the road, then the next. All stay listed
    for the whole episode. A slot without a car sees zeros, may only brake and its action is ignored; its own reward is 0.

    **Reward.** ``own``: -5 for each other car in the same cell and -0.01 tau, tau being the steps since the car entered,
    for each car that was on the road when it acted and still is when collisions are looked for. ``team``: the mean of
    these over all slots, given to every agent, with a car or without. The same in both orders of events, which are
    described at :class:`~sb3_belief.envs.traffic_junction.core.TrafficCore`.

    **Infos.** ``action_mask`` bool [2] for the next action (also after ``reset``); after ``step`` ``active`` (a car was
    on the road in this slot when it acted) and ``life_end`` (that car reached its destination, so its own return ends:
    never with the team reward); on the last step ``is_success``.

    **Observation**, float32 with N slots and R routes (easy 5 and 2, medium 10 and 12, hard 20 and 56)::

        0            1 if a car is in the slot (else everything is 0)
        1            its last action (0 also when it has just entered)
        2 .. 1+R     its route, one-hot
        2+R          row / (size - 1)
        3+R          column / (size - 1)
        4+R          tau / step limit
        5+R ..       for each cell in view, row by row from the upper left one: how many other cars are in it,
                     their ids (one-hot, N), their routes (one-hot, R) [, how many of them braked at the last step]

    The width is ``5 + R + (2 vision + 1)**2 * (1 + N + R [+ 1])``: easy 79, medium 224, hard 754. A car is not among the
    cars that it sees; several cars in one cell set several ids and routes. The number in brackets is there with
    ``observe_last_actions`` only.

    :param level: ``"easy"``, ``"medium"`` or ``"hard"``
    :param order: order of events in a step, ``"commnet"`` (move, collisions, removal, arrivals: the paper's) or
        ``"ic3net"`` (move and removal, arrivals, collisions)
    :param reward: ``"own"`` or ``"team"``
    :param arrival_rate: probability in [0, 1] that a car wants to enter, per entry and step. None: 0.3 (easy), 0.2 (medium),
        0.05 (hard)
    :param reward_scale: factor on all rewards, > 0 (0.1 suits PPO)
    :param vision: a car sees, and sees the actions of, cars at most this many rows and columns away (1: 3x3 cells)
    :param observe_last_actions: put the last actions of the cars in view into the observation. Off by default: what
        teammates do reaches a learner through ``others_actions``, otherwise one without a belief gets it for nothing.
    :param render_mode: None, ``"rgb_array"`` or ``"human"``
    :raises ValueError: for a value outside of these
    """

    metadata: ClassVar[dict[str, Any]] = {
        "name": "traffic_junction_v0",
        "render_modes": list(RENDER_MODES),
        "is_parallelizable": True,
        "render_fps": 6,
    }

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
        self._sees_now = np.zeros((1, n_cars, n_cars), dtype=bool)
        self._saw = np.zeros((1, n_cars, n_cars), dtype=bool)

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, dict[str, Any]]]:
        """
        :param seed: restarts the random generator; None: it goes on
        :param options: not used
        :return: observations and infos, by agent; the road is empty
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

    def step(
        self, actions: dict[str, int]
    ) -> tuple[dict[str, np.ndarray], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """
        :param actions: 0 (gas) or 1 (brake) for every agent
        :return: observations, rewards, terminations (all False), truncations (all True at the step limit) and infos, by agent
        :raises ValueError: if an agent's action is missing or neither 0 nor 1, or if no episode is under way
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
        Whose action of the last step an agent could observe: both cars were on the road and at most ``vision`` rows and
        columns apart when the actions were chosen.

        :return: {agent: bool [n_others]}, the others in the order of ``possible_agents``; all False after ``reset``
        """
        visible = self._observer.of_others(self._saw)[0]
        return dict(zip(self.possible_agents, visible, strict=True))

    def team_reward(self, rewards: dict[str, float]) -> float:
        """
        :param rewards: what ``step`` returned
        :return: their mean over all slots
        """
        return float(np.mean([rewards[agent] for agent in self.possible_agents]))

    def set_arrival_rate(self, arrival_rate: float) -> None:
        """
        Change the traffic, for instance from 0.05 to 0.2 in a curriculum.

        :param arrival_rate: from the next step on, in [0, 1]
        :raises ValueError: outside of it
        """
        self.core.set_arrival_rate(arrival_rate)

    def get_state(self) -> dict[str, Any]:
        """
        :return: all that decides how the episode and those after it go on, as arrays and plain data
        """
        return {"core": self.core.get_state(0), "saw": self._saw[0].copy(), "under_way": bool(self.agents)}

    def set_state(self, state: dict[str, Any]) -> None:
        """
        Go on where ``get_state`` was called; given the same actions, everything that follows is the same bit for bit.

        :param state: what ``get_state`` returned in an environment of the same level
        :raises ValueError: if it was another level
        """
        self.core.set_state(0, state["core"])
        self._observe()
        self._saw = np.array(state["saw"], dtype=bool)[None]
        self.agents = list(self.possible_agents) if state["under_way"] else []

    def render(self) -> np.ndarray | None:
        """
        :return: the picture, uint8 [height, width, 3], if the render mode is "rgb_array"; None if it is shown in a window
        :raises ValueError: if the environment was made without a render mode
        :raises ImportError: if pygame is not installed
        """
        mode = require_render_mode(self.render_mode, RENDER_MODES)
        if self._renderer is None:
            self._renderer = Renderer(self.core.layout, self.core.max_steps)
        if mode == "human":
            self._renderer.show(self.core, 0, fps=self.metadata["render_fps"])
            return None
        return self._renderer.image(self.core, 0)

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
            raise ValueError(f"No action for {agent!r}: every agent needs one at each step, also a slot without a car.")
        action = actions[agent]
        if action not in (GAS, BRAKE):
            raise ValueError(f"The action of {agent!r} is {action!r}; allowed are {GAS} (gas) and {BRAKE} (brake).")
        return int(action)


def agent_names(config: JunctionConfig) -> list[str]:
    """
    :param config: the rules
    :return: names of the slots
    """
    return [f"car_{i}" for i in range(config.level_spec.n_cars)]


def action_masks(core: TrafficCore) -> np.ndarray:
    """
    :param core: the copies
    :return: which actions are possible now, bool [n_copies, n_cars, 2]: a slot without a car may only brake
    """
    return np.stack([core.on_road, np.ones_like(core.on_road)], axis=-1)
