"""Level-Based Foraging of one learner beside one scripted player, whose type changes from time to time."""

from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from sb3_belief.common.checks import check_integer
from sb3_belief.envs.adapters import lbf
from sb3_belief.envs.base import ResetResult, StepResult, TeamGame
from sb3_belief.envs.drawn_partner import DrawnPartner, partner_schedule
from sb3_belief.envs.foraging_partners.partners import PARTNERS, Cell, Situation, action_towards
from sb3_belief.envs.suites import SUITES

LEARNER, PARTNER = "agent_0", "agent_1"
# The package's entries for what is not in sight
_UNSEEN = (-1.0, -1.0, 0.0)


class PartneredForaging(TeamGame[np.ndarray, int]):
    """
    Level-Based Foraging of one learner, ``agent_0``, beside one scripted player, ``agent_1``. Two ids stand for it:

    - ``picker``: ``Foraging-8x8-2p-3f-coop-v3`` with 20 steps. Every food needs both players, and the scripted one collects in
      one of the six orders of the three foods, which are numbered in reading order at the beginning of an episode. The learner
      sees it within 2 cells only, so it has to know where to go
    - ``lbf-heuristics``: ``Foraging-8x8-2p-3f-v3`` with 50 steps in full sight. The scripted player follows one of the
      heuristics H1 to H4 (see :mod:`sb3_belief.envs.foraging_partners.partners`). Where it goes can be seen, so little is to
      be gained

    Observation: float32 [3 foods + 3 + 3]: row, column and level of each food, of oneself and of the partner; (-1, -1, 0) for
    what is collected or not in sight. Foods keep their place in it during an episode, unlike in the package. All food is in
    sight; the partner is where both rows and columns differ by at most ``partner_sight``, and its action is visible where it
    is in sight after the step.

    The reward is the share of all food that is collected in the step, by whomever, so a return is the share of food. An
    episode terminates when no food is left, with ``is_success``, and is truncated at the step limit otherwise.

    :param game: Gymnasium's id of a game of lbforaging with two players in full sight and three foods
    :param partners: ``"orders"`` or ``"heuristics"``
    :param partner_sight: Number of cells within which the learner sees its partner, >= 0. None for no limit
    :param max_episode_steps: Limit of an episode, >= 1
    :param redraw_every: Number of episodes (or rollouts) for which a type stays, >= 1. None if it never changes. It is drawn
        at the beginning of an episode
    :param redraw_unit: ``"episodes"`` or ``"rollouts"``
    :param per_copy: Whether each copy draws by itself. False is for rollouts only
    :param rollout_steps: With rollouts, the learner's ``n_steps``
    :param partner_seed: Seed of the draws, >= 0. With ``per_copy`` they depend on the seed of ``reset`` too
    :param reveal_partner: Whether the learner observes the type, as a one-hot code behind the rest
    :param render_mode: None, ``"human"`` or ``"rgb_array"``
    :raises ValueError: For any other value
    :raises ModuleNotFoundError: If lbforaging is not installed. The message has the line that installs it
    """

    metadata: ClassVar[dict[str, Any]] = {
        "name": "partnered_foraging_v0",
        "render_modes": ["human", "rgb_array"],
        "is_parallelizable": True,
    }
    action_names: ClassVar[tuple[str, ...]] = lbf.Foraging.action_names

    def __init__(
        self,
        game: str = "Foraging-8x8-2p-3f-coop-v3",
        partners: str = "orders",
        partner_sight: int | None = 2,
        max_episode_steps: int = 20,
        redraw_every: int | None = 10,
        redraw_unit: str = "episodes",
        per_copy: bool = True,
        rollout_steps: int | None = None,
        partner_seed: int = 0,
        reveal_partner: bool = False,
        render_mode: str | None = None,
    ):
        if partners not in PARTNERS:
            raise ValueError(f"partners={partners!r} is not one of {', '.join(map(repr, PARTNERS))}.")
        if partner_sight is not None:
            check_integer("partner_sight", partner_sight, 0, "within how many cells the partner is seen, or None for anywhere")
        check_integer("max_episode_steps", max_episode_steps, 1, "the length of an episode")
        schedule = partner_schedule(redraw_every, redraw_unit, per_copy, partner_seed)
        self._choices = PARTNERS[partners]
        self._drawn = DrawnPartner(list(self._choices), schedule, rollout_steps, reveal_partner)
        SUITES["lbf"].require("picker" if partners == "orders" else "lbf-heuristics")
        self._foraging = lbf.make(game, max_episode_steps=max_episode_steps, render_mode=render_mode)
        self._game = self._foraging.game
        n_foods, sight = self._game.max_num_food, self._game.sight
        if len(self._foraging.possible_agents) != 2 or n_foods != 3 or sight < max(self._game.field_size):
            raise ValueError(f"game={game!r} must have two players in full sight and three foods ('-2p-3f', no '-2s').")
        self.partner_sight, self.render_mode = partner_sight, render_mode
        self.possible_agents = [LEARNER]
        self.agents: list[str] = []
        box: Any = self._foraging.observation_space(LEARNER)
        told = self._drawn.revealed
        low, high = np.append(box.low, np.zeros(told)), np.append(box.high, np.ones(told))
        self.observation_spaces: dict[str, spaces.Space] = {
            LEARNER: spaces.Box(low.astype(np.float32), high.astype(np.float32))
        }
        self.action_spaces: dict[str, spaces.Space] = {LEARNER: self._foraging.action_space(LEARNER)}
        self.scripted_action_spaces: dict[str, spaces.Space] = {PARTNER: self._foraging.action_space(PARTNER)}
        self._foods: list[Cell] = []
        self._did = 0
        self._generator = np.random.default_rng()

    @property
    def partner(self) -> str:
        """The type of the scripted player."""
        return self._drawn.name

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> ResetResult:
        """
        Start an episode.

        :param seed: Seed of players, food and types, which begin anew. With None they continue
        :param options: Not used
        :return: Observation and an empty info, by agent
        """
        self._foraging.reset(seed=seed)
        if seed is not None:
            # A stream beside that of the game, which the scripted player does not disturb
            self._generator = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1,)))
        self._drawn.begin_episode(seed)
        self._foods = [(int(row), int(column)) for row, column in np.argwhere(self._game.field)]
        self.agents = [LEARNER]
        return {LEARNER: self._observe()}, {LEARNER: {}}

    def step(self, actions: dict[str, int]) -> StepResult:
        """
        Advance the episode by one step.

        :param actions: Action of the learner: none, north, south, west, east or load
        :return: Observation, reward, termination, truncation and infos, by agent. The infos also hold ``partner``
        :raises ValueError: If the action is missing or not allowed, or if no episode is under way
        """
        self._require_episode()
        if LEARNER not in actions:
            raise ValueError(f"No action for {LEARNER!r}, the agent that acts here; got actions for {list(actions)}.")
        self._did = self._partner_action()
        _, rewards, ends, cuts, infos = self._foraging.step({LEARNER: actions[LEARNER], PARTNER: self._did})
        self._drawn.count_step()
        if not self._foraging.agents:
            self.agents = []
        told: Any = {LEARNER: infos[LEARNER], "partner": self.partner}
        reward = self._foraging.team_reward(rewards)
        return {LEARNER: self._observe()}, {LEARNER: reward}, {LEARNER: ends[LEARNER]}, {LEARNER: cuts[LEARNER]}, told

    def situation(self) -> Situation:
        """
        Return what the scripted player knows.

        :return: Field, food and players
        """
        learner, partner = self._game.players
        return Situation(
            self._game.field,
            self._foods,
            (int(partner.position[0]), int(partner.position[1])),
            (int(learner.position[0]), int(learner.position[1])),
            int(partner.level),
            int(learner.level + partner.level),
        )

    def _partner_action(self) -> int:
        now = self.situation()
        food = self._choices[self.partner](now)
        # As the heuristics of the package, one that can load nothing walks about
        return int(self._generator.integers(5)) if food is None else action_towards(food, now.field, now.me, now.other)

    def _in_sight(self) -> bool:
        if self.partner_sight is None:
            return True
        (row, column), (other_row, other_column) = (player.position for player in self._game.players)
        return max(abs(row - other_row), abs(column - other_column)) <= self.partner_sight

    def _observe(self) -> np.ndarray:
        learner, partner = self._game.players
        field = self._game.field
        foods = [(*food, field[food]) if field[food] else _UNSEEN for food in self._foods]
        # The package gives up on a food for which it finds no place
        foods += [_UNSEEN] * (self._game.max_num_food - len(foods))
        seen = (*partner.position, partner.level) if self._in_sight() else _UNSEEN
        rows = [*foods, (*learner.position, learner.level), seen]
        return self._drawn.told(np.array(rows, dtype=np.float32).ravel())

    def scripted_actions(self) -> dict[str, int]:
        """
        Return what the scripted player did in the last step.

        :return: Its action, in [0, 6)
        """
        return {PARTNER: self._did}

    def visibility(self) -> dict[str, np.ndarray]:
        """
        Return whether the learner could observe the partner's action of the last step.

        :return: {learner: bool [1]}
        """
        return {LEARNER: np.array([self._in_sight()])}

    def render(self) -> Any:
        """
        Draw the field.

        :return: uint8 [height, width, 3] with ``"rgb_array"``
        """
        return self._foraging.render()

    def picture_positions(self) -> dict[str, tuple[float, float]]:
        """
        Return where the learner is in the picture.

        :return: {agent: (x, y)} as fractions of its width and height, from the upper left corner
        """
        return {LEARNER: self._foraging.picture_positions()[LEARNER]}

    def close(self) -> None:
        """Close the window, if there is one."""
        self._foraging.close()

    def get_state(self) -> dict[str, Any]:
        """
        Return everything that determines the rest of this episode and the following ones.

        :return: A copy that can be pickled
        """
        return {
            "foraging": self._foraging.get_state(),
            "drawn": self._drawn.get_state(),
            "foods": list(self._foods),
            "did": self._did,
            "generator": self._generator.bit_generator.state,
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """
        Restore a state. With the same actions, everything that follows is then the same bit for bit.

        :param state: State that ``get_state`` returned in an environment with the same arguments
        """
        self._foraging.set_state(state["foraging"])
        self._drawn.set_state(state["drawn"])
        self._foods, self._did = list(state["foods"]), state["did"]
        self._generator.bit_generator.state = state["generator"]
        self.agents = [LEARNER] if self._foraging.agents else []
