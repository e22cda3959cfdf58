"""MPE's speaker and listener with a scripted speaker, whose symbols mean something else from time to time."""

from itertools import permutations
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from sb3_belief.envs.adapters import mpe
from sb3_belief.envs.base import ResetResult, StepResult, TeamGame, check_render_mode, require_render_mode
from sb3_belief.envs.drawn_partner import DrawnPartner, partner_schedule
from sb3_belief.envs.suites import SUITES

LISTENER, SPEAKER = "listener_0", "speaker_0"
#: The symbol for each landmark, in each of the languages
LANGUAGES = tuple(permutations(range(3)))
# So that the return is the mean reward of the last position over as many steps as an episode of MPE has
_SCALE = 25.0
_RENDER_MODES = ("human", "rgb_array")


class ForeignSpeaker(TeamGame[np.ndarray, int]):
    """
    Game of a listener, the only agent, that has to go to the landmark which a scripted speaker names in a foreign language.

    It is ``simple_speaker_listener_v4`` of mpe2. The speaker says symbol ``language[k]`` while landmark k is the goal, where
    the language is one of the 6 permutations and stays for a number of episodes. The listener hears the symbol from its second
    observation on. Its reward, -25 times the squared distance from the goal, comes at the end only, so that a position does
    not give the goal away while there is time left. An episode has 25 steps and terminates.

    What a symbol means shows in the reward alone. A history of observations and of the speaker's actions says nothing of it,
    so who is better than the blind policies without having kept its own rewards has found a leak. See
    :mod:`sb3_belief.envs.foreign_speaker.policies` for what policies without training reach.

    The observation is MPE's: float32 [11], own velocity 2, landmarks relative to oneself 2 each, what was heard as a one-hot
    code of 3. Actions are nothing, left, right, down and up. Infos of the team hold ``partner``, the symbol for each landmark
    as text (``"2-0-1"``).

    :param redraw_every: Number of episodes (or rollouts) for which a language stays, >= 1. None if it never changes. It is
        drawn at the beginning of an episode
    :param redraw_unit: ``"episodes"`` or ``"rollouts"``
    :param per_copy: Whether each copy draws by itself. False is for rollouts only
    :param rollout_steps: With rollouts, the learner's ``n_steps``
    :param partner_seed: Seed of the draws, >= 0. With ``per_copy`` they depend on the seed of ``reset`` too
    :param reveal_partner: Whether the listener observes the language, as a one-hot code of 6 behind the rest
    :param render_mode: None, ``"human"`` or ``"rgb_array"``
    :raises ValueError: For any other value
    :raises ModuleNotFoundError: If mpe2 is not installed. The message has the line that installs it
    """

    metadata: ClassVar[dict[str, Any]] = {
        "name": "foreign_speaker_v0",
        "render_modes": list(_RENDER_MODES),
        "is_parallelizable": True,
        "render_fps": 10,
    }
    action_names: ClassVar[dict[str, list[str]]] = {LISTENER: ["nothing", "left", "right", "down", "up"]}

    def __init__(
        self,
        redraw_every: int | None = 8,
        redraw_unit: str = "episodes",
        per_copy: bool = True,
        rollout_steps: int | None = None,
        partner_seed: int = 0,
        reveal_partner: bool = False,
        render_mode: str | None = None,
    ):
        self.render_mode = check_render_mode(render_mode, _RENDER_MODES)
        schedule = partner_schedule(redraw_every, redraw_unit, per_copy, partner_seed)
        names = ["-".join(map(str, language)) for language in LANGUAGES]
        self._drawn = DrawnPartner(names, schedule, rollout_steps, reveal_partner)
        SUITES["mpe"].require("foreign-speaker")
        self._mpe = mpe.make("simple_speaker_listener_v4", render_mode=render_mode)
        self._game: Any = self._mpe.unwrapped
        self.possible_agents = [LISTENER]
        self.agents: list[str] = []
        own = self._mpe.observation_space(LISTENER).shape[0]
        shape = (own + self._drawn.revealed,)
        self.observation_spaces: dict[str, spaces.Space] = {LISTENER: spaces.Box(-np.inf, np.inf, shape, np.float32)}
        self.action_spaces: dict[str, spaces.Space] = {LISTENER: spaces.Discrete(5)}
        self.scripted_action_spaces: dict[str, spaces.Space] = {SPEAKER: spaces.Discrete(3)}
        self._said = 0

    @property
    def partner(self) -> str:
        """The symbol for each landmark."""
        return self._drawn.name

    @property
    def goal(self) -> int:
        """Index of the landmark that is the goal, which the speaker alone knows."""
        world = self._game.world
        return int(world.landmarks.index(world.agents[0].goal_b))

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> ResetResult:
        """
        Start an episode.

        :param seed: Seed of positions, goals and languages, which begin anew. With None they continue
        :param options: Not used
        :return: Observation and an empty info, by agent
        """
        obs, _ = self._mpe.reset(seed=seed)
        self._drawn.begin_episode(seed)
        self.agents = [LISTENER]
        return {LISTENER: self._drawn.told(obs[LISTENER])}, {LISTENER: {}}

    def step(self, actions: dict[str, int]) -> StepResult:
        """
        Advance the episode by one step.

        :param actions: Action of the listener, in [0, 5)
        :return: Observation, reward, termination (True at the last step), truncation (False) and infos, by agent. The infos
            also hold ``partner``
        :raises ValueError: If the action is missing or not allowed, or if no episode is under way
        """
        self._require_episode()
        action = actions.get(LISTENER)
        if action not in range(5):
            raise ValueError(f"The action of {LISTENER!r} is {action!r}; allowed are the integers 0 to 4.")
        self._said = LANGUAGES[self._drawn.index][self.goal]
        obs, rewards, _, truncations, _ = self._mpe.step({SPEAKER: self._said, LISTENER: action})
        self._drawn.count_step()
        done = bool(truncations[LISTENER])
        if done:
            self.agents = []
        reward = _SCALE * float(rewards[LISTENER]) if done else 0.0
        infos: Any = {LISTENER: {}, "partner": self.partner}
        return {LISTENER: self._drawn.told(obs[LISTENER])}, {LISTENER: reward}, {LISTENER: done}, {LISTENER: False}, infos

    def scripted_actions(self) -> dict[str, int]:
        """
        Return what the speaker said in the last step.

        :return: Its symbol, in [0, 3)
        """
        return {SPEAKER: self._said}

    def render(self) -> Any:
        """
        Draw the world as mpe2 does.

        :return: uint8 [height, width, 3] with ``"rgb_array"``
        :raises ValueError: If the environment was made without a render mode
        """
        require_render_mode(self.render_mode, _RENDER_MODES)
        return self._mpe.render()

    def picture_positions(self) -> dict[str, tuple[float, float]]:
        """
        Return where the listener is in the picture.

        :return: {agent: (x, y)} as fractions of its width and height, from the upper left corner
        """
        return {LISTENER: self._mpe.picture_positions()[LISTENER]}

    def close(self) -> None:
        """Close the window, if there is one."""
        self._mpe.close()

    def get_state(self) -> dict[str, Any]:
        """
        Return everything that determines the rest of this episode and the following ones.

        :return: Arrays and plain data
        """
        speaker, listener = self._game.world.agents
        return {
            "landmarks": [landmark.state.p_pos.copy() for landmark in self._game.world.landmarks],
            "position": listener.state.p_pos.copy(),
            "velocity": listener.state.p_vel.copy(),
            "speaker": speaker.state.p_pos.copy(),
            "heard": speaker.state.c.copy(),
            "goal": self.goal,
            "steps": self._game.steps,
            "generator": self._game.np_random.bit_generator.state,
            "drawn": self._drawn.get_state(),
            "said": self._said,
            "under_way": bool(self.agents),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """
        Restore a state. With the same actions, everything that follows is then the same bit for bit.

        :param state: State that ``get_state`` returned in an environment with the same arguments
        """
        # The reset puts everything that is not part of the state into a defined condition
        self.reset()
        world = self._game.world
        speaker, listener = world.agents
        for landmark, position in zip(world.landmarks, state["landmarks"], strict=True):
            landmark.state.p_pos = np.array(position)
        listener.state.p_pos, listener.state.p_vel = np.array(state["position"]), np.array(state["velocity"])
        speaker.state.p_pos, speaker.state.c = np.array(state["speaker"]), np.array(state["heard"])
        speaker.goal_b = world.landmarks[state["goal"]]
        # The colour by which mpe2 shows the goal in pictures
        listener.color = speaker.goal_b.color + 0.45
        self._game.steps = state["steps"]
        self._game.np_random.bit_generator.state = state["generator"]
        self._drawn.set_state(state["drawn"])
        self._said = state["said"]
        self.agents = [LISTENER] if state["under_way"] else []
