"""Multi-agent Gymnasium environments with tuples of spaces, observations and actions, one entry per agent."""

import copy
import operator
import warnings
from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import load_env_creator

from sb3_belief.envs.base import ResetResult, TeamGame
from sb3_belief.envs.suites import nearest

_SEQUENCES = (list, tuple, np.ndarray)
Step = tuple[dict[str, np.ndarray], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]


class GymTupleEnv(TeamGame[np.ndarray, Any]):
    """
    PettingZoo environment around a Gymnasium one whose observation and action spaces are ``Tuple`` spaces.

    Agents are called ``agent_0``, ``agent_1``, ... in the order of the tuples. All stay in ``agents`` until the episode ends
    for all of them. The reward of a step may be a sequence with one entry per agent, or a single number that every agent gets.

    A subclass can override hooks for what Gymnasium's interface cannot express: which agents see each other
    (:meth:`_visible`), which actions are possible (:meth:`_masks`), which agents are in play (:meth:`_active`), whether an
    episode was a success (:meth:`_is_success`), and whether a reported termination is a time limit (:meth:`_is_time_limit`).
    By default all agents see each other, are in play and may take every action.

    :param env: The environment
    :param max_episode_steps: Number of steps after which an episode is truncated, >= 1. None if the environment has a limit of
        its own
    :param name: Name of the environment for messages, for instance its id
    :raises TypeError: If the spaces are not tuples of the same length
    :raises ValueError: If ``max_episode_steps`` is less than 1
    """

    metadata: dict[str, Any]

    def __init__(self, env: gym.Env, max_episode_steps: int | None = None, name: str | None = None):
        observed, acted = env.observation_space, env.action_space
        if not (isinstance(observed, spaces.Tuple) and isinstance(acted, spaces.Tuple) and len(observed) == len(acted)):
            raise TypeError(
                f"{type(env.unwrapped).__name__} has the observation space {observed} and the action space {acted}; a team"
                " needs two Tuple spaces with one entry for each agent. A Gymnasium environment for one agent has no team."
            )
        if max_episode_steps is not None and max_episode_steps < 1:
            raise ValueError(f"max_episode_steps={max_episode_steps} must be at least 1, or None for no limit of ours.")
        self.gym_env = env
        #: The environment without Gymnasium's wrappers, which the hooks below read
        self.game: Any = env.unwrapped
        self.max_episode_steps = max_episode_steps
        self.possible_agents = [f"agent_{i}" for i in range(len(acted))]
        self.agents: list[str] = []
        # Packages repeat one space object for all agents. Copies, because each agent's space must have its own generator
        self.observation_spaces: dict[str, spaces.Space] = self._by_agent([copy.deepcopy(space) for space in observed])
        self.action_spaces: dict[str, spaces.Space] = self._by_agent([copy.deepcopy(space) for space in acted])
        # Used at every step. None for spaces other than Discrete from 0, whose actions need a fuller check
        self._n_actions = {
            agent: int(space.n) if isinstance(space, spaces.Discrete) and not space.start else None
            for agent, space in self.action_spaces.items()
        }
        self._dtypes = [space.dtype for space in self.observation_spaces.values()]
        self.render_mode = env.render_mode
        name = name or getattr(env.spec, "id", None) or type(self.game).__name__
        self.metadata = {**env.metadata, "name": name, "is_parallelizable": True}
        #: The info that the environment itself returned at the last step or reset
        self.info: dict[str, Any] = {}
        self._steps = 0
        # step() recognises the default of _active() by the identity of _everybody
        self._in_play = self._everybody = np.ones(len(acted), dtype=bool)
        self._saw = np.zeros((len(acted), len(acted) - 1), dtype=bool)

    # Hooks for subclasses. Except for _prepare_reset they are called directly after a reset or a step

    def _prepare_reset(self) -> None:
        """Prepare the game for a reset."""

    def _visible(self, observations: Sequence[np.ndarray]) -> np.ndarray:
        """
        Return whose action of this step each agent could observe.

        :param observations: Observations after the step, one for each agent
        :return: bool [n, n-1], the others in order
        """
        return np.ones_like(self._saw)

    def _masks(self) -> Sequence[np.ndarray] | None:
        """
        Return which actions are possible now.

        :return: One bool array for each agent, or None if the environment has no masks
        """
        return None

    def _active(self) -> np.ndarray:
        """
        Return which agents are in play now.

        :return: bool [n]
        """
        return self._everybody

    def _is_success(self) -> bool | None:
        """
        Return whether an episode that has just ended was a success.

        :return: The success, or None if the environment does not define one
        """
        return None

    @property
    def reports_success(self) -> bool:
        """Whether the environment says at the end of an episode whether it was a success."""
        return type(self)._is_success is not GymTupleEnv._is_success

    def _is_time_limit(self) -> bool:
        """
        Return whether a termination that the environment has just reported is in fact a time limit.

        :return: True to report a truncation instead
        """
        return False

    # PettingZoo's interface

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> ResetResult:
        """
        Start an episode.

        :param seed: Seed of the environment's random generator. With None the generator continues
        :param options: Passed on to the environment
        :return: Observations and infos, by agent
        :raises ValueError: If the environment does not return one observation for each agent
        """
        self._prepare_reset()
        obs, self.info = self.gym_env.reset(seed=seed, options=options)
        self.agents = self.possible_agents[:]
        self._steps = 0
        self._in_play = self._active()
        self._saw = np.zeros_like(self._saw)
        return self._by_agent(self._observations(obs)), self._infos()

    def step(self, actions: dict[str, Any]) -> Step:
        """
        Advance the episode by one step.

        :param actions: Action of each agent
        :return: Observations, rewards, terminations, truncations and infos, by agent. Infos have ``action_mask`` if there are
            masks, ``active`` if an agent was not in play, and at the end ``is_success`` if the environment defines it
        :raises ValueError: If an agent's action is missing or not in its space, if no episode is under way, or if the
            environment does not return one observation and reward for each agent and single values for the two ends
        """
        self._require_episode()
        was_in_play = self._in_play
        obs, reward, terminated, truncated, self.info = self.gym_env.step(self._joint_action(actions))
        self._steps += 1
        observations = self._observations(obs)
        rewards = self._rewards(reward)
        if isinstance(terminated, _SEQUENCES) or isinstance(truncated, _SEQUENCES):
            raise ValueError(
                f"{self.metadata['name']} returned terminated={terminated!r} and truncated={truncated!r}: they must be single"
                " values, since an episode ends for all agents at once."
            )
        if terminated and self._is_time_limit():
            terminated, truncated = False, True
        truncated = truncated or (self.max_episode_steps is not None and self._steps >= self.max_episode_steps)
        terminated, truncated = bool(terminated), bool(truncated and not terminated)
        self._saw = self._visible(observations)
        self._in_play = self._active()
        infos = self._infos()
        if was_in_play is not self._everybody and not was_in_play.all():
            for info, active in zip(infos.values(), was_in_play, strict=True):
                info["active"] = bool(active)
        if self._in_play is not self._everybody and not self._in_play.all():
            for info, active in zip(infos.values(), self._in_play, strict=True):
                if not active:
                    info["next_active"] = False
        if terminated or truncated:
            self.agents = []
            success = self._is_success()
            if success is not None:
                for info in infos.values():
                    info["is_success"] = success
        ends, cuts = dict.fromkeys(self.possible_agents, terminated), dict.fromkeys(self.possible_agents, truncated)
        return self._by_agent(observations), self._by_agent(rewards), ends, cuts, infos

    def visibility(self) -> dict[str, np.ndarray]:
        """
        Return whose action of the last step each agent could observe.

        :return: {agent: bool [n-1]}, the others in the order of ``possible_agents``. All False after ``reset``
        """
        return self._by_agent(self._saw)

    def render(self) -> Any:
        """
        Render the environment.

        :return: The result of the environment's own ``render()``
        """
        return self.gym_env.render()

    def close(self) -> None:
        """Close the environment."""
        self.gym_env.close()

    def _by_agent(self, values: Any) -> dict[str, Any]:
        return dict(zip(self.possible_agents, values, strict=True))

    def _observations(self, obs: Any) -> list[np.ndarray]:
        if len(obs) != len(self._dtypes):
            raise ValueError(f"{self.metadata['name']} returned {len(obs)} observations for {len(self._dtypes)} agents.")
        if None in self._dtypes:
            # A nested space has no single type
            return list(obs)
        return [np.asarray(part, dtype=dtype) for part, dtype in zip(obs, self._dtypes, strict=True)]

    def _rewards(self, reward: Any) -> list[float]:
        n_agents = len(self.possible_agents)
        if not isinstance(reward, _SEQUENCES):
            return [float(reward)] * n_agents
        if len(reward) != n_agents:
            raise ValueError(
                f"{self.metadata['name']} returned {len(reward)} rewards for {n_agents} agents: it must return one for each,"
                " or a single number for all."
            )
        return [float(own) for own in reward]

    def _infos(self) -> dict[str, dict[str, Any]]:
        masks = self._masks()
        if masks is None:
            return {agent: {} for agent in self.possible_agents}
        return {agent: {"action_mask": mask} for agent, mask in self._by_agent(masks).items()}

    def _joint_action(self, actions: dict[str, Any]) -> list[Any]:
        """
        Return the checked actions in the order of the agents.

        :return: One action for each agent. Those of ``Discrete`` spaces are plain integers, which some packages require
        """
        missing = [agent for agent in self.possible_agents if agent not in actions]
        if missing:
            raise ValueError(f"No action for {missing}; got actions for {list(actions)}.")
        return [self._checked_action(agent, actions[agent]) for agent in self.possible_agents]

    def _checked_action(self, agent: str, action: Any) -> Any:
        n_actions, space = self._n_actions[agent], self.action_spaces[agent]
        if isinstance(space, spaces.Box):
            # The bounds are left to the environment, which may clip
            return np.asarray(action, dtype=space.dtype)
        try:
            converted = np.asarray(action) if n_actions is None else operator.index(action)
            if space.contains(converted) if n_actions is None else 0 <= converted < n_actions:
                return converted
        except TypeError:
            # operator.index() refuses what is not an integer
            pass
        raise ValueError(f"The action of {agent!r} is {action!r}, which is not in its space {space}.")


class ResumableTupleEnv(GymTupleEnv):
    """
    ``GymTupleEnv`` whose whole state lies in a few attributes of the game, so that it can be saved and restored.
    """

    #: Names of these attributes
    state_names: ClassVar[tuple[str, ...]]

    def get_state(self) -> dict[str, Any]:
        """
        Return everything that determines the rest of this episode and the following ones.

        :return: A copy that can be pickled
        """
        game = {name: getattr(self.game, name) for name in self.state_names}
        # One deepcopy of everything, so that objects that several attributes share are still shared in the copy
        return copy.deepcopy({"game": game, "steps": self._steps, "saw": self._saw, "under_way": bool(self.agents)})

    def set_state(self, state: dict[str, Any]) -> None:
        """
        Restore a state. With the same actions, everything that follows is then the same.

        :param state: State that ``get_state`` returned in an environment with the same arguments
        """
        state = copy.deepcopy(state)
        # The reset puts everything that is not part of the state into a defined condition
        self.reset()
        for name, value in state["game"].items():
            setattr(self.game, name, value)
        self._steps, self._saw = state["steps"], state["saw"]
        self._in_play = self._active()
        self.agents = self.possible_agents[:] if state["under_way"] else []


class DrawnTupleEnv(ResumableTupleEnv):
    """
    ``ResumableTupleEnv`` whose game shows itself in a window, and ignores the render mode with which it was made.

    Its images are drawn here, because the packages draw theirs in a window too, which needs a display.

    :param env: The environment
    :param name: Name of the environment for messages, for instance its id
    """

    def __init__(self, env: gym.Env, name: str | None = None):
        super().__init__(env, name=name)
        self.metadata["render_modes"] = ["human", "rgb_array"]

    def _draw(self) -> np.ndarray:
        """
        Draw the state of the game.

        :return: uint8 [height, width, 3]
        """
        raise NotImplementedError

    def render(self) -> Any:
        """
        Return an image, or show the game in a window.

        :return: An image with ``render_mode="rgb_array"``. With ``"human"`` a window is opened
        """
        return self._draw() if self.render_mode == "rgb_array" else self.game.render(mode="human")


def make_registered(package: str, id: str, known: Sequence[str], **env_kwargs: Any) -> gym.Env:
    """
    Make an environment that a package has registered with Gymnasium, without Gymnasium's wrappers.

    The wrappers would cost time, and their checks assume a single agent.

    :param package: Name of the package, for messages
    :param id: Gymnasium's id of the environment
    :param known: The ids that exist
    :param env_kwargs: Keyword arguments that override those of the id, including ``max_episode_steps``
    :return: The environment
    :raises ValueError: For an unknown id. The message names the nearest ones
    """
    if id not in known:
        raise ValueError(
            f"{package} has no environment {id!r}.{nearest(id, known)} It has {len(known)}, such as {known[0]!r}."
        )
    spec = gym.spec(id)
    creator: Any = spec.entry_point if callable(spec.entry_point) else load_env_creator(str(spec.entry_point))
    with warnings.catch_warnings():
        # Harmless, and a user can do nothing about it
        warnings.filterwarnings("ignore", message=".*precision lowered by casting")
        return creator(**{**copy.deepcopy(spec.kwargs), **env_kwargs})
