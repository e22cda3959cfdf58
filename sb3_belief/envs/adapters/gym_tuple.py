"""Gymnasium environments of several agents: tuples of spaces, of observations and of actions, one entry per agent."""

import copy
import operator
import warnings
from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import load_env_creator

from sb3_belief.envs.base import TeamGame
from sb3_belief.envs.suites import nearest

_SEQUENCES = (list, tuple, np.ndarray)
Step = tuple[dict[str, np.ndarray], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]


class GymTupleEnv(TeamGame[np.ndarray, Any]):
    """
    A Gymnasium environment whose observation and action spaces are ``Tuple``s, one entry for each agent, as a PettingZoo one.

    Agents are called ``agent_0``, ``agent_1`` ... in the order of the tuples. All stay listed until the episode ends for all
    of them. Rewards may be a sequence with one for each agent, or a single number, which then is everybody's.

    What Gymnasium's interface cannot say is said by a subclass, in the methods whose names begin with an underscore: who sees
    whom (:meth:`_visible`), which actions are possible (:meth:`_masks`), who is in play (:meth:`_active`), what a success is
    (:meth:`_is_success`), whether an end that is reported as a termination is a time limit (:meth:`_is_time_limit`). Without
    them everyone sees everyone, is in play and may do everything.

    :param env: the environment
    :param max_episode_steps: the episode is truncated after this many steps, >= 1; None: the environment knows its own limit
    :param name: shown for the environment, e.g. its id
    :raises TypeError: if its spaces are not tuples of the same length
    :raises ValueError: if ``max_episode_steps`` is less than 1
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
        #: the environment without Gymnasium's wrappers, of which the methods below ask what they need
        self.game: Any = env.unwrapped
        self.max_episode_steps = max_episode_steps
        self.possible_agents = [f"agent_{i}" for i in range(len(acted))]
        self.agents: list[str] = []
        # Packages repeat one space object, but each agent's space has a generator of its own
        self.observation_spaces: dict[str, spaces.Space] = self._by_agent([copy.deepcopy(space) for space in observed])
        self.action_spaces: dict[str, spaces.Space] = self._by_agent([copy.deepcopy(space) for space in acted])
        # Looked up at every step
        self._n_actions = {
            agent: int(space.n) if isinstance(space, spaces.Discrete) and not space.start else None
            for agent, space in self.action_spaces.items()
        }
        self._dtypes = [space.dtype for space in self.observation_spaces.values()]
        self.render_mode = env.render_mode
        name = name or getattr(env.spec, "id", None) or type(self.game).__name__
        self.metadata = {**env.metadata, "name": name, "is_parallelizable": True}
        #: what the environment itself returned as info of the last step or reset
        self.info: dict[str, Any] = {}
        self._steps = 0
        self._in_play = self._everybody = np.ones(len(acted), dtype=bool)
        self._saw = np.zeros((len(acted), len(acted) - 1), dtype=bool)

    # What a subclass may say; all of it is asked right after a reset or a step

    def _prepare_reset(self) -> None:
        """Called before each reset."""

    def _visible(self, observations: Sequence[np.ndarray]) -> np.ndarray:
        """
        :param observations: of the step, one for each agent
        :return: whose action of this step each agent could observe, bool [n, n-1], the others in order
        """
        return np.ones_like(self._saw)

    def _masks(self) -> Sequence[np.ndarray] | None:
        """
        :return: for each agent which of its actions are possible now, bool; None if the environment does not tell
        """
        return None

    def _active(self) -> np.ndarray:
        """
        :return: who is in play now, bool [n]
        """
        return self._everybody

    def _is_success(self) -> bool | None:
        """
        :return: at an episode's end, whether it is a success; None if there is no such thing
        """
        return None

    def _is_time_limit(self) -> bool:
        """
        :return: when the environment says that it terminated, whether it merely reached a limit of its own
        """
        return False

    # PettingZoo's interface

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, dict[str, Any]]]:
        """
        :param seed: restarts the environment's generator; None: it goes on
        :param options: handed to the environment
        :return: observations and infos, by agent
        :raises ValueError: if the environment does not give one observation to each agent
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
        :param actions: an action for each agent
        :return: observations, rewards, terminations, truncations and infos, by agent. Infos have ``action_mask`` if there are
            masks, ``active`` when somebody was not in play, and at the end ``is_success`` if there is such a thing.
        :raises ValueError: if an agent's action is missing or not in its space, if no episode is under way, or if the
            environment returns something else than Gymnasium's five, with one observation and reward for each agent
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
        :return: whose action of the last step an agent could observe, {agent: bool [n-1]}, the others in the order of
            ``possible_agents``; all False after ``reset``
        """
        return self._by_agent(self._saw)

    def render(self) -> Any:
        """
        :return: what the environment's own ``render()`` returns
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
            return list(obs)  # nested ones, which have no single type
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
        :return: the actions in order; those of ``Discrete`` spaces as plain integers, which some packages insist on
        """
        missing = [agent for agent in self.possible_agents if agent not in actions]
        if missing:
            raise ValueError(f"No action for {missing}; got actions for {list(actions)}.")
        return [self._checked(agent, actions[agent]) for agent in self.possible_agents]

    def _checked(self, agent: str, action: Any) -> Any:
        n_actions, space = self._n_actions[agent], self.action_spaces[agent]
        if isinstance(space, spaces.Box):
            # The bounds are the environment's affair
            return np.asarray(action, dtype=space.dtype)
        try:
            known = np.asarray(action) if n_actions is None else operator.index(action)
            if space.contains(known) if n_actions is None else 0 <= known < n_actions:
                return known
        except TypeError:
            pass  # not an integer
        raise ValueError(f"The action of {agent!r} is {action!r}, which is not in its space {space}.")


class ResumableTupleEnv(GymTupleEnv):
    """
    One whose whole state lies in a few attributes of the game, so that it can be put back to where it was.
    """

    #: names of these attributes
    state_names: ClassVar[tuple[str, ...]]

    def get_state(self) -> dict[str, Any]:
        """
        :return: all that decides how the episode and those after it go on; it can be pickled
        """
        game = {name: getattr(self.game, name) for name in self.state_names}
        # One copy of it all: what its parts share, they go on sharing
        return copy.deepcopy({"game": game, "steps": self._steps, "saw": self._saw, "under_way": bool(self.agents)})

    def set_state(self, state: dict[str, Any]) -> None:
        """
        Go on where ``get_state`` was called; given the same actions, everything that follows is the same.

        :param state: what ``get_state`` returned in an environment with the same arguments
        """
        state = copy.deepcopy(state)
        self.reset()
        for name, value in state["game"].items():
            setattr(self.game, name, value)
        self._steps, self._saw = state["steps"], state["saw"]
        self._in_play = self._active()
        self.agents = self.possible_agents[:] if state["under_way"] else []


def make_registered(package: str, id: str, known: Sequence[str], **env_kwargs: Any) -> gym.Env:
    """
    Make an environment that a package has registered with Gymnasium. None of Gymnasium's wrappers is put around it: they check
    for one agent and take time.

    :param package: what the message about a wrong name calls it
    :param id: Gymnasium's id of it
    :param known: the ids that there are
    :param env_kwargs: override the arguments that the id stands for, ``max_episode_steps`` included
    :return: the environment
    :raises ValueError: for an unknown id, naming the nearest ones
    """
    if id not in known:
        raise ValueError(
            f"{package} has no environment {id!r}.{nearest(id, known)} It has {len(known)}, such as {known[0]!r}."
        )
    found = gym.spec(id)
    creator: Any = found.entry_point if callable(found.entry_point) else load_env_creator(str(found.entry_point))
    with warnings.catch_warnings():
        # Of no consequence, and nothing that a user could do about it
        warnings.filterwarnings("ignore", message=".*precision lowered by casting")
        return creator(**{**copy.deepcopy(found.kwargs), **env_kwargs})
