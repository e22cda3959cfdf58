"""A user's environment as a team needs it: agents named by strings, spaces that SB3 takes, ``reset`` with seed and options."""

import inspect
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo import AECEnv, ParallelEnv

from sb3_belief.vec_env.validation import check_wrappers

_METHODS = ("reset", "step", "observation_space", "action_space")


class UserEnv(ParallelEnv):
    """
    The environment of a user behind the interface of a ``ParallelEnv`` whose agents have strings as names.

    An environment may name its agents by anything that can be a key, may know its agents and spaces only after a ``reset()``,
    which is then called once, may have a ``reset`` without ``seed`` or ``options``, and may have spaces that SB3's models do
    not take but that differ from others by their shape alone: numbers without a dimension, and tables of discrete choices.
    Actions and observations are reshaped on their way.

    :param env: A PettingZoo ``ParallelEnv``, or an object with its whole interface
    :raises TypeError: If it is something else
    :raises ValueError: For SuperSuit's black_death, for two names that are the same as text, or if the spaces remain unknown
    """

    def __init__(self, env: Any):
        check_interface(env)
        check_wrappers(env)
        self.env = env
        self._takes_seed, self._takes_options = (_takes(env.reset, name) for name in ("seed", "options"))
        self.metadata, self.render_mode = getattr(env, "metadata", {}), getattr(env, "render_mode", None)
        self._warned = False
        try:
            names, given = self._members()
        except Exception:
            # Many environments of people's own make their agents or spaces in reset()
            self.reset()
            names, given = self._members(known=True)
        self._own = {str(name): name for name in names}
        self._names = {name: str(name) for name in names}
        if len(self._own) < len(self._names):
            raise ValueError(
                f"Two agents of {names} have the same name as text; agents are known by str(name), in files and logs too, so"
                " give them different ones."
            )
        self.possible_agents = [str(name) for name in names]
        self.observation_spaces: dict[str, spaces.Space] = {}
        self.action_spaces: dict[str, spaces.Space] = {}
        # Shapes that the environment gives and takes, where they are not those of the spaces
        self._obs_shapes: dict[str, Any] = {}
        self._action_shapes: dict[str, Any] = {}
        for name, (observations, actions) in given.items():
            agent = self._names[name]
            self.observation_spaces[agent] = _with_shape(observations)
            self.action_spaces[agent] = _one_dimensional(actions)
            if self.observation_spaces[agent] is not observations:
                self._obs_shapes[agent] = observations.shape
            if self.action_spaces[agent] is not actions:
                self._action_shapes[agent] = actions.shape
        #: The environment's own names of its agents
        self.own_names = names
        # The text of a member of a class (str, Enum) is another than the string that it is
        #: Whether the names are not those of the environment
        self.renames = any(type(name) is not str for name in names)
        #: Whether anything differs from the environment itself, so that it has to be stepped through this object
        self.adapts = bool(
            self.renames or self._obs_shapes or self._action_shapes or not (self._takes_seed and self._takes_options)
        )

    def _members(self, known: bool = False) -> tuple[list[Any], dict[Any, tuple[Any, Any]]]:
        """
        Return the environment's own names of its agents, and their spaces.

        :param known: Whether they must be known by now
        """
        names = getattr(self.env, "possible_agents", None)
        if names is None and known:
            # PettingZoo's own tests do without possible_agents, too
            names = self.env.agents
        names = [] if names is None else list(names)
        given = {}
        for name in names:
            try:
                given[name] = self.env.observation_space(name), self.env.action_space(name)
            except Exception as error:
                raise ValueError(
                    f"The spaces of {name!r} are not known, even after a reset(): {type(error).__name__}: {error}. Return them"
                    " from observation_space(agent) and action_space(agent)."
                ) from error
            if not all(isinstance(space, spaces.Space) for space in given[name]):
                raise ValueError(
                    f"observation_space({name!r}) and action_space({name!r}) must return gymnasium spaces, got"
                    f" {' and '.join(type(space).__name__ for space in given[name])}, even after a reset()."
                )
        if not given and not known:
            raise ValueError("not known yet")
        return names, given

    @property
    def unwrapped(self) -> Any:
        """The environment without wrappers."""
        return getattr(self.env, "unwrapped", self.env)

    @property
    def agents(self) -> list[str]:
        """Names of the agents in play."""
        agents = getattr(self.env, "agents", None)
        return [] if agents is None else [self._names.get(name, str(name)) for name in agents]

    def reset(self, seed: int | None = None, options: Mapping[str, Any] | None = None) -> Any:
        """
        Reset the environment, with those of the arguments that it takes.

        :param seed: Goes to ``env.seed()``, as in old environments, where ``reset`` does not take it; None for no seed
        :param options: As PettingZoo has them
        :return: What the environment returns, by the agents' names as text
        :raises ValueError: If there are options that ``reset`` does not take
        """
        arguments: dict[str, Any] = {}
        if self._takes_seed:
            arguments["seed"] = seed
        elif seed is not None and callable(getattr(self.env, "seed", None)):
            self.env.seed(seed)
        elif seed is not None and not self._warned:
            self._warned = True
            name = type(self.unwrapped).__name__
            warnings.warn(f"{name} cannot be seeded: its reset() has no argument seed. Runs with one seed will differ.")
        if self._takes_options:
            arguments["options"] = options
        elif options:
            name = type(self.unwrapped).__name__
            raise ValueError(f"{name} takes no options: its reset() has no such argument, got {dict(options)}.")
        result = self.env.reset(**arguments)
        if "adapts" not in vars(self):
            # The first reset is for agents and spaces alone
            return result
        if isinstance(result, tuple):
            return tuple(self._translated(part, reshapes=i == 0) for i, part in enumerate(result))
        return self._translated(result, reshapes=True)

    def step(self, actions: Mapping[str, Any]) -> Any:
        """
        Step the environment.

        :param actions: Actions by agent, in the agents' action spaces
        :return: What the environment returns, by the agents' names as text
        """
        own = {}
        for agent, action in actions.items():
            shape = self._action_shapes.get(agent)
            own[self._own[agent]] = action if shape is None else np.reshape(action, shape)
        result = self.env.step(own)
        if not isinstance(result, tuple):
            return result
        return tuple(self._translated(part, reshapes=i == 0) for i, part in enumerate(result))

    def render(self) -> Any:
        """Return what the environment's own ``render()`` returns."""
        return self.env.render()

    def close(self) -> None:
        """Close the environment, if it can be closed."""
        if hasattr(self.env, "close"):
            self.env.close()

    def __getattr__(self, name: str) -> Any:
        # Private names are left out: pickle and copy ask for some of them before ``env`` is set
        if name.startswith("_") or name == "env":
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        return getattr(self.env, name)

    def renamed_members(self, visibility: Any, team_reward: Any) -> tuple[Any, Any]:
        """
        Return optional members of the environment that take and return dicts by the agents' names as text.

        :param visibility: Function that returns a dict by the environment's own names, or None
        :param team_reward: Function that takes a dict by the environment's own names, or None
        :return: Both, None for one that is None
        """

        def renamed_visibility() -> Any:
            return self._translated(visibility())

        def renamed_team_reward(rewards: Mapping[str, Any]) -> Any:
            return team_reward({self._own.get(agent, agent): reward for agent, reward in rewards.items()})

        return None if visibility is None else renamed_visibility, None if team_reward is None else renamed_team_reward

    def observation_space(self, agent: str) -> spaces.Space:
        """
        Return the observation space of an agent.

        :param agent: Name of the agent as text
        """
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space:
        """
        Return the action space of an agent.

        :param agent: Name of the agent as text
        """
        return self.action_spaces[agent]

    def _translated(self, part: Any, reshapes: bool = False) -> Any:
        if not isinstance(part, Mapping):
            return part
        part = {self._names.get(name, str(name)): value for name, value in part.items()}
        for agent, shape in self._obs_shapes.items() if reshapes else ():
            # What has another shape is left as it is, to be refused with agent and step
            if agent in part and np.shape(part[agent]) == shape:
                part[agent] = np.reshape(part[agent], self.observation_spaces[agent].shape or ())
        return part


def check_interface(env: Any) -> None:
    """
    Check that an environment is one of PettingZoo's parallel kind, by its class or by its members.

    :param env: The environment
    :raises TypeError: If it is not; the message says what it lacks
    """
    if isinstance(env, ParallelEnv):
        return
    lacks = [name for name in _METHODS if not callable(getattr(env, name, None))]
    lacks += [] if hasattr(env, "possible_agents") or hasattr(env, "agents") else ["possible_agents"]
    if isinstance(env, AECEnv) or hasattr(env, "agent_iter") or lacks:
        missing = f" (which has no {', '.join(lacks)})" if lacks else ""
        raise TypeError(
            f"A team needs a pettingzoo.ParallelEnv, got {type(env).__name__}{missing}. An AEC environment is converted by"
            " sb3_belief.envs.to_parallel(); a Gymnasium environment has no team."
        )


def _takes(method: Callable[..., Any], name: str) -> bool:
    try:
        parameters = inspect.signature(method).parameters.values()
    except (TypeError, ValueError):
        # Written in another language
        return True
    return any(parameter.name == name or parameter.kind is inspect.Parameter.VAR_KEYWORD for parameter in parameters)


def _with_shape(space: spaces.Space) -> spaces.Space:
    """Return an observation space that SB3's networks take, or the space itself."""
    if isinstance(space, spaces.Box) and space.shape == ():
        return spaces.Box(space.low.reshape(1), space.high.reshape(1), dtype=space.dtype.type)
    if isinstance(space, spaces.MultiDiscrete) and len(space.shape) > 1:
        return spaces.MultiDiscrete(space.nvec.ravel(), dtype=space.dtype.type)
    return space


def _one_dimensional(space: spaces.Space) -> spaces.Space:
    """Return an action space that SB3's distributions take, or the space itself."""
    if isinstance(space, spaces.MultiDiscrete) and len(space.shape) > 1 and not np.any(space.start):
        return spaces.MultiDiscrete(space.nvec.ravel(), dtype=space.dtype.type)
    if isinstance(space, spaces.MultiBinary) and len(space.shape) > 1:
        return spaces.MultiBinary(int(np.prod(space.shape)))
    if isinstance(space, spaces.Box) and space.shape == ():
        return spaces.Box(space.low.reshape(1), space.high.reshape(1), dtype=space.dtype.type)
    return space


def separate_agents(env: Any) -> None:
    """
    Give an environment a list ``agents`` of its own if that is the list ``possible_agents``, so that these do not shrink.

    :param env: The environment, just reset
    """
    for layer in (env, getattr(env, "unwrapped", env)):
        # In the object itself: a property may make its list anew
        members: dict[str, Any] = getattr(layer, "__dict__", {})
        agents = members.get("agents")
        if isinstance(agents, list) and getattr(layer, "possible_agents", None) is agents:
            members["agents"] = members["agents"][:]
