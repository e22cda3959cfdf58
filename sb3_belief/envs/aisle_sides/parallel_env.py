"""The aisles as a PettingZoo environment."""

from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from sb3_belief.envs.aisle_sides.config import MIDDLE, RIGHT, AisleConfig, convention_names
from sb3_belief.envs.aisle_sides.core import AisleCore, observation_width
from sb3_belief.envs.aisle_sides.rendering import draw_aisles, robot_positions
from sb3_belief.envs.base import ResetResult, StepResult, TeamGame, check_render_mode, require_render_mode

ACTION_NAMES = ("middle", "left", "right")


class AisleSides(TeamGame[np.ndarray, int]):
    """
    Robots of a warehouse that meet others head-on in its aisles, whose custom is to keep left, or right, or to a side by kind.

    Each learner drives through an aisle of its own from one end to the other, again and again. Robots that are not of its
    fleet, one at a time, come towards it. When the two are in front of each other (one or two cells apart) neither can drive
    on before both have stepped aside, which they do at the same moment: the other one starts when the learner does. Are both
    on their left, or both on their right, they pass. Otherwise they jam, and lose ``jam_steps`` steps before the other one
    makes way. To which side the others keep is a convention of the site, hidden and drawn anew from time to time. Waiting
    tells nothing about it, since a robot that waits is waited for, and neither does the observation. It shows only in what
    the others do in a meeting, which an agent that is near gets afterwards in ``others_actions``.

    **Conventions.** With one kind of robots there are two, ``left`` and ``right``. With k visible kinds, each of which keeps
    to a side of its own, there are 2 to the power of k, named by a letter a kind (``LRRL``). From three kinds on a quarter of
    them is held out, which ``held_out=True`` draws from instead. ``partner`` is the name of the present one.

    **Agents** ``robot_0 ..`` are the learners; the scripted ``other_i`` stands for whoever comes towards ``robot_i``. Racks
    hide the other aisles, so that learners do not see each other.

    **Actions**: 0 (middle), 1 (left), 2 (right), as the robot itself sees it. They matter only in front of another robot,
    where a robot in the middle waits. Elsewhere a robot drives one cell per step, and in a jam nobody moves.

    **Reward.** ``1 / length`` for each cell, so that the return of an episode is the number of aisles that were driven
    through. The team's is the mean over the learners. An episode is truncated at the step limit and never terminates.

    **Observation**, float32::

        0               position in the aisle, from 0 (first cell) to 1 (last cell)
        1               steps until a jam dissolves / jam_steps, 0 without a jam
        2 ..            distance of the robot in sight in cells, one-hot (sight)
        2 + sight ..    its kind, one-hot (kinds)
        ...             with reveal_partner: the side to which it keeps, left or right, one-hot (2)

    :param kinds: Number of visible kinds of robots, from 1 to 6
    :param n_robots: Number of learners, each in an aisle of its own, >= 1
    :param length: Cells of an aisle, larger than ``sight + 1``
    :param sight: Largest distance at which a robot sees another one and what it does, in cells, >= 2
    :param traffic: Probability in (0, 1] that another robot enters an aisle that has none, per step. It enters at the far end,
        while the learner is too far away to see it
    :param jam_steps: Steps that a wrong guess costs both robots, >= 1
    :param max_steps: Length of an episode in steps, >= 1
    :param others_visible: Whether a robot observes what the one in sight does. False as a control, in which a belief has
        nothing to learn from
    :param redraw_every: Number of rollouts or episodes for which a convention is valid, >= 1. None for one that never changes
    :param redraw_unit: ``"rollouts"`` or ``"episodes"``
    :param per_copy: Whether each copy draws a convention by itself; False for the same in all copies
    :param rollout_steps: Steps of one copy in a rollout, >= 1: the learner's ``n_steps``. It counts with rollouts only
    :param partner_seed: Seed of the sequence of conventions, >= 0. With ``per_copy`` the seed of ``reset`` is part of it
    :param held_out: Whether to draw from the conventions that are held out of training, instead of from the others
    :param reveal_partner: Whether observations end with what the present convention says of the robot in sight, as an upper
        bound of what can be known
    :param render_mode: None or ``"rgb_array"``
    :raises ValueError: For any other value, for episodes without ``per_copy``, and for ``held_out`` with fewer than 3 kinds
    """

    metadata: ClassVar[dict[str, Any]] = {
        "name": "aisle_sides_v0",
        "render_modes": ["rgb_array"],
        "is_parallelizable": True,
    }
    action_names = ACTION_NAMES

    def __init__(
        self,
        kinds: int = 1,
        n_robots: int = 1,
        length: int = 8,
        sight: int = 3,
        traffic: float = 0.7,
        jam_steps: int = 8,
        max_steps: int = 40,
        others_visible: bool = True,
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
        self.config = AisleConfig(
            redraw_every=redraw_every,
            redraw_unit=redraw_unit,
            per_copy=per_copy,
            rollout_steps=rollout_steps,
            partner_seed=partner_seed,
            held_out=held_out,
            reveal_partner=reveal_partner,
            kinds=kinds,
            n_robots=n_robots,
            length=length,
            sight=sight,
            traffic=traffic,
            jam_steps=jam_steps,
            max_steps=max_steps,
            others_visible=others_visible,
        )
        self.core = AisleCore(1, self.config)
        self.possible_agents, others = robot_names(self.config)
        self.agents: list[str] = []
        self.observation_spaces = {agent: aisle_observation_space(self.config) for agent in self.possible_agents}
        self.action_spaces = {agent: spaces.Discrete(len(ACTION_NAMES)) for agent in self.possible_agents}
        self.scripted_action_spaces: dict[str, spaces.Space] = {other: spaces.Discrete(len(ACTION_NAMES)) for other in others}

    @property
    def partner(self) -> str:
        """The name of the convention that is valid in the next step."""
        return convention_names(self.config.kinds)[self.core.types.current[0]]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> ResetResult:
        """
        Start an episode in empty aisles.

        :param seed: Seed of the traffic. The sequence of conventions starts anew, too. With None both continue
        :param options: Not used
        :return: Observations and empty infos, by agent
        """
        if seed is not None:
            self.core.seed(0, seed)
        self.core.reset()
        self.agents = list(self.possible_agents)
        return self._observe(), {agent: {} for agent in self.possible_agents}

    def step(self, actions: dict[str, int]) -> StepResult:
        """
        Advance the episode by one step.

        :param actions: 0 (middle), 1 (left) or 2 (right) for every agent
        :return: Observations, rewards, terminations (all False), truncations (all True at the step limit) and empty infos, by
            agent. The infos also hold ``partner``, the name of the convention that was valid, for the team's info
        :raises ValueError: If an agent's action is missing or none of the three, or if no episode is under way
        """
        self._require_episode()
        joint, partner = np.array([[self._action_of(agent, actions) for agent in self.possible_agents]]), self.partner
        rewards, dones = self.core.step(joint)
        done = bool(dones[0])
        if done:
            self.agents = []
        return (
            self._observe(),
            dict(zip(self.possible_agents, rewards[0].tolist(), strict=True)),
            dict.fromkeys(self.possible_agents, False),
            dict.fromkeys(self.possible_agents, done),
            {**{agent: {} for agent in self.possible_agents}, "partner": partner},  # type: ignore[dict-item]
        )

    def scripted_actions(self) -> dict[str, int]:
        """
        Return what the others did in the last step.

        :return: 1 (left) or 2 (right) in a meeting in which the learner stepped aside, too, otherwise 0, also where there is
            nobody; by name of the other
        """
        return dict(zip(self.scripted_action_spaces, self.core.other_action[0].tolist(), strict=True))

    def visibility(self) -> dict[str, np.ndarray]:
        """
        Return whose action of the last step each agent could observe: the other robot's of its aisle, if it was in sight.

        :return: {agent: bool [n_others]}, the other agents in order, then the scripted others. All False after ``reset``
        """
        return dict(zip(self.possible_agents, visible_others(self.core)[0], strict=True))

    def render(self) -> np.ndarray:
        """
        Return a picture of the aisles.

        :return: uint8 [height, width, 3]
        :raises ValueError: If the environment was made without a render mode
        """
        require_render_mode(self.render_mode, ("rgb_array",))
        return draw_aisles(self.core, 0)

    def picture_positions(self) -> dict[str, tuple[float, float]]:
        """
        Return where the learners are in the picture.

        :return: {agent: (x, y)}, as fractions of its width and height, from the upper left corner
        """
        return robot_positions(self.core, 0, self.possible_agents)

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
        self.agents = list(self.possible_agents) if state["under_way"] else []

    def _observe(self) -> dict[str, np.ndarray]:
        return dict(zip(self.possible_agents, self.core.observe()[:, 0], strict=True))

    def _action_of(self, agent: str, actions: dict[str, int]) -> int:
        if agent not in actions:
            raise ValueError(f"No action for {agent!r}: every agent needs one at each step, also in a jam.")
        action = actions[agent]
        if action not in range(MIDDLE, RIGHT + 1):
            raise ValueError(f"The action of {agent!r} is {action!r}; allowed are 0 (middle), 1 (left) and 2 (right).")
        return int(action)


def robot_names(config: AisleConfig) -> tuple[list[str], list[str]]:
    """
    Return the names of the learners and of the scripted others.

    :param config: The rules
    :return: ``robot_0``, ``robot_1``, ... and ``other_0``, ``other_1``, ...
    """
    numbers = range(config.n_robots)
    return [f"robot_{i}" for i in numbers], [f"other_{i}" for i in numbers]


def aisle_observation_space(config: AisleConfig) -> spaces.Box:
    """
    Return a new observation space.

    :param config: The rules
    :return: Box from 0 to 1, float32 [width]
    """
    return spaces.Box(0.0, 1.0, (observation_width(config),), dtype=np.float32)


def visible_others(core: AisleCore) -> np.ndarray:
    """
    Return whose action of the last step each learner could observe.

    :param core: The copies
    :return: bool [n_copies, n_robots, n_robots - 1 + n_robots]: the other learners, who are hidden, then the scripted others
    """
    n = core.config.n_robots
    visible = np.zeros((core.n_copies, n, 2 * n - 1), dtype=bool)
    robots = np.arange(n)
    visible[:, robots, n - 1 + robots] = core.saw
    return visible
