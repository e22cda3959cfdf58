"""The junction with cultures as a PettingZoo environment."""

from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from sb3_belief.envs.base import ResetResult, StepResult, TeamGame, check_render_mode, require_render_mode
from sb3_belief.envs.junction_cultures.config import CultureConfig
from sb3_belief.envs.junction_cultures.core import CultureCore
from sb3_belief.envs.traffic_junction.core import BRAKE, GAS
from sb3_belief.envs.traffic_junction.observation import ObservationLayout
from sb3_belief.envs.traffic_junction.parallel_env import ACTION_NAMES, action_masks, agent_names
from sb3_belief.envs.traffic_junction.rendering import Renderer, positions_in_picture

LEARNER = "car_0"


class JunctionCultures(TeamGame[np.ndarray, int]):
    """
    Traffic Junction in which one car learns, and all others follow the custom of the place: who goes first at the junction.

    Roads, routes, arrivals, observations and the reward are those of :class:`~sb3_belief.envs.TrafficJunction` with
    ``order="commnet"`` and ``reward="own"``. The other cars are scripted: one brakes if a car that it sees stands in its next
    cell, or has the same next cell and goes first, since it comes from an entry that goes before its own; between entries of
    the same rank the lower number of the slot goes first. The ranks of the entries are the culture.

    The task is a *negative control*. The culture decides what is best, and no observation shows it; but whoever waits and
    looks gets nearly as far as whoever knows, so a belief has little to win.

    **Cultures.** ``cultures="axes"``: two, ``NS-EW``, in which those from north and south go first, and ``EW-NS``.
    ``cultures="orders"``: one for each order of the entries (``N-E-S-W``), 24 on the level ``medium``, of which eight are held
    out. ``partner`` is the name of the present one.

    **Agents.** ``car_0`` is the only agent. The scripted others are ``car_1`` and so on. As in the Traffic Junction, ``car_0``
    is a slot; without a car it observes zeros, is not ``active`` and may only brake, and its ``life_end`` is the arrival of
    one. Returns are compared per life, since who waits lives longer.

    :param level: ``"easy"`` (5 cars) or ``"medium"`` (10 cars)
    :param cultures: ``"axes"`` or ``"orders"``
    :param arrival_rate: Probability in [0, 1] that a car wants to enter, per entry and step. None for the level's default
    :param reward_scale: Factor on all rewards, > 0 (0.1 suits PPO)
    :param vision: Largest distance in rows and in columns at which a car sees other cars and their actions, in cells, >= 0
    :param redraw_every: Number of rollouts or episodes for which a culture is valid, >= 1. None for one that never changes
    :param redraw_unit: ``"rollouts"`` or ``"episodes"``
    :param per_copy: Whether each copy draws a culture by itself; False for the same in all copies
    :param rollout_steps: Steps of one copy in a rollout, >= 1: the learner's ``n_steps``. It counts with rollouts only
    :param partner_seed: Seed of the sequence of cultures, >= 0. With ``per_copy`` the seed of ``reset`` is part of it
    :param held_out: Whether to draw from the cultures that are held out of training, instead of from the others
    :param reveal_partner: Whether observations end with the present culture, one-hot, as an upper bound of what can be known
    :param render_mode: None or ``"rgb_array"``
    :raises ValueError: For any other value, for episodes without ``per_copy``, and for ``held_out`` where there are none
    """

    metadata: ClassVar[dict[str, Any]] = {
        "name": "junction_cultures_v0",
        "render_modes": ["rgb_array"],
        "is_parallelizable": True,
    }
    action_names = ACTION_NAMES

    def __init__(
        self,
        level: str = "medium",
        cultures: str = "axes",
        arrival_rate: float | None = None,
        reward_scale: float = 1.0,
        vision: int = 1,
        redraw_every: int | None = 5,
        redraw_unit: str = "rollouts",
        per_copy: bool = False,
        rollout_steps: int = 40,
        partner_seed: int = 0,
        held_out: bool = False,
        reveal_partner: bool = False,
        render_mode: str | None = None,
    ):
        self.render_mode = check_render_mode(render_mode, ("rgb_array",))
        self.config = CultureConfig(
            redraw_every=redraw_every,
            redraw_unit=redraw_unit,
            per_copy=per_copy,
            rollout_steps=rollout_steps,
            partner_seed=partner_seed,
            held_out=held_out,
            reveal_partner=reveal_partner,
            level=level,
            cultures=cultures,
            arrival_rate=arrival_rate,
            reward_scale=reward_scale,
            vision=vision,
        )
        self.core = CultureCore(1, self.config)
        self._cars = agent_names(self.config.junction)
        self.possible_agents = [LEARNER]
        self.agents: list[str] = []
        self.observation_spaces: dict[str, spaces.Space] = {LEARNER: learner_space(self.config)}
        self.action_spaces: dict[str, spaces.Space] = {LEARNER: spaces.Discrete(2)}
        self.scripted_action_spaces: dict[str, spaces.Space] = {car: spaces.Discrete(2) for car in self._cars[1:]}
        self._renderer: Renderer | None = None

    @property
    def partner(self) -> str:
        """The name of the culture that is valid in the next step."""
        return self.config.names[self.core.types.current[0]]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> ResetResult:
        """
        Start an episode on an empty road.

        :param seed: Seed of the traffic. The sequence of cultures starts anew, too. With None both continue
        :param options: Not used
        :return: Observation and info, by agent
        """
        if seed is not None:
            self.core.seed(0, seed)
        self.core.reset()
        self.agents = [LEARNER]
        return {LEARNER: self.core.observe()[0]}, {LEARNER: {"action_mask": self._mask()}}

    def step(self, actions: dict[str, int]) -> StepResult:
        """
        Advance the episode by one step.

        :param actions: 0 (gas) or 1 (brake) for the learner
        :return: Observation, reward, termination (False), truncation (True at the step limit) and info, by agent. The infos
            also hold ``partner``, the name of the culture that was valid, for the team's info
        :raises ValueError: If the learner's action is missing or neither 0 nor 1, or if no episode is under way
        """
        self._require_episode()
        if LEARNER not in actions or actions[LEARNER] not in (GAS, BRAKE):
            raise ValueError(f"Got the actions {actions}; needed is that of {LEARNER!r}, {GAS} (gas) or {BRAKE} (brake).")
        partner = self.partner
        result = self.core.step(np.array([int(actions[LEARNER])]))
        done = bool(result.dones[0])
        info: dict[str, Any] = {"active": bool(result.acted[0, 0]), "life_end": bool(result.left[0, 0])}
        obs = {LEARNER: self.core.observe()[0]}
        info["action_mask"] = self._mask()
        if done:
            self.agents = []
            info["is_success"] = bool(self.core.traffic.n_collisions[0] == 0)
        infos: Any = {LEARNER: info, "partner": partner}
        return obs, {LEARNER: float(result.rewards[0, 0])}, {LEARNER: False}, {LEARNER: done}, infos

    def scripted_actions(self) -> dict[str, int]:
        """
        Return what the scripted cars did in the last step.

        :return: 0 (gas) or 1 (brake, also of a slot without a car), by car
        """
        return dict(zip(self._cars[1:], self.core.actions[0, 1:].tolist(), strict=True))

    def visibility(self) -> dict[str, np.ndarray]:
        """
        Return whose action of the last step the learner could observe, see :meth:`TrafficJunction.visibility`.

        :return: {agent: bool [n_others]}
        """
        return {LEARNER: self.core.saw[0].copy()}

    def render(self) -> np.ndarray:
        """
        Return a picture of the junction.

        :return: uint8 [height, width, 3]
        :raises ValueError: If the environment was made without a render mode
        :raises ImportError: If pygame is not installed
        """
        require_render_mode(self.render_mode, ("rgb_array",))
        if self._renderer is None:
            self._renderer = Renderer(self.core.traffic.layout, self.core.traffic.max_steps)
        return self._renderer.image(self.core.traffic, 0)

    def picture_positions(self) -> dict[str, tuple[float, float]]:
        """
        Return where the learner is in the picture.

        :return: {agent: (x, y)} while it is on the road, as fractions of its width and height, from the upper left corner
        """
        return learner_position(self.core)

    def get_state(self) -> dict[str, Any]:
        """
        Return everything that determines the rest of this episode and the following ones.

        :return: Arrays and plain data
        """
        return {"core": self.core.get_state(0), "under_way": bool(self.agents)}

    def set_state(self, state: dict[str, Any]) -> None:
        """
        Restore a state. With the same actions, everything that follows is then the same bit for bit.

        :param state: State that ``get_state`` returned in an environment with the same arguments
        :raises ValueError: If the arguments differ
        """
        self.core.set_state(0, state["core"])
        self.agents = [LEARNER] if state["under_way"] else []

    def _mask(self) -> np.ndarray:
        return action_masks(self.core.traffic)[0, 0]


def learner_space(config: CultureConfig) -> spaces.Box:
    """
    Return a new observation space.

    :param config: The rules
    :return: Box of the Traffic Junction's observation, with the culture behind it if it is revealed
    """
    space = ObservationLayout.of(config.junction).space()
    told = np.ones(len(config.priorities) if config.reveal_partner else 0, dtype=np.float32)
    return spaces.Box(0.0, np.concatenate([space.high, told]), dtype=np.float32)


def learner_position(core: CultureCore) -> dict[str, tuple[float, float]]:
    """
    Return where the learner of the first copy is in its picture.

    :param core: The copies
    :return: {agent: (x, y)}, empty without a car in its slot
    """
    positions = positions_in_picture(core.traffic, 0, agent_names(core.config.junction))
    return {LEARNER: positions[LEARNER]} if LEARNER in positions else {}
