"""PettingZoo's own environments (``pettingzoo/sisl.pursuit_v5``), and the conversion of AEC environments."""

import pkgutil
import warnings
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils.conversions import aec_to_parallel, turn_based_aec_to_parallel
from pettingzoo.utils.wrappers import BaseParallelWrapper

from sb3_belief.envs.suites import unknown_name

_GROUPS = ("atari", "butterfly", "classic", "sisl")


def names() -> list[str]:
    """
    Return the names of PettingZoo's environments, including those whose own requirements are not installed.

    :return: Names ``<group>.<module>`` that follow ``pettingzoo/`` in an id
    """
    return versioned_modules(*(f"pettingzoo.{group}" for group in _GROUPS), root="pettingzoo")


def versioned_modules(*packages: str, root: str) -> list[str]:
    """
    Return the modules of packages whose names end in a version, as those of environments do, without importing them.

    :param packages: Names of packages
    :param root: Package that the returned names are relative to
    :return: Sorted names of modules
    """
    modules = []
    for package in packages:
        spec = find_spec(package)
        locations = [] if spec is None else list(spec.submodule_search_locations or [])
        for module in pkgutil.iter_modules(locations, f"{package}."):
            if module.name.rpartition("_v")[2].isdecimal():
                modules.append(module.name.removeprefix(f"{root}."))
    return sorted(modules)


def make(name: str, **env_kwargs: Any) -> ParallelEnv:
    """
    Make an environment of PettingZoo.

    Every agent sees the actions of all others, except in ``sisl.pursuit``, where a pursuer sees those in its window.

    :param name: ``<group>.<module>``, for instance ``"sisl.pursuit_v5"``
    :param env_kwargs: Keyword arguments of the environment
    :return: The parallel environment. An AEC environment is converted by ``to_parallel``
    :raises ValueError: For an unknown name
    :raises ModuleNotFoundError: If a package that the environment needs is not installed. The message has the line that
        installs it
    """
    known = names()
    if name not in known:
        raise unknown_name("pettingzoo", name, known)
    try:
        with warnings.catch_warnings():
            # PettingZoo advises users who import the module themselves to call its make function
            warnings.simplefilter("ignore", DeprecationWarning)
            module = import_module(f"pettingzoo.{name}")
    except ImportError as error:
        group = name.partition(".")[0]
        raise ModuleNotFoundError(
            f"'pettingzoo/{name}' needs a package that is not installed ({error}): pip install 'pettingzoo[{group}]'.",
            name=error.name,
        ) from error
    env = to_parallel((module.parallel_env if hasattr(module, "parallel_env") else module.env)(**env_kwargs))
    return Pursuit(env) if name.startswith("sisl.pursuit_v") else env


def to_parallel(env: AECEnv | ParallelEnv) -> ParallelEnv:
    """
    Convert a PettingZoo environment to one that a team can play, with PettingZoo's own conversions.

    - An AEC environment with ``is_parallelizable`` in its metadata is converted by ``aec_to_parallel``.
    - Any other AEC environment is turn-based and converted by ``turn_based_aec_to_parallel``. All agents act at each step, but
      only the action of the agent whose turn it is counts. The others see that action and can only choose action 0.
    - Observations of the form ``{"observation": ..., "action_mask": ...}``, PettingZoo's convention, are split, and the masks
      are moved to the infos.

    :param env: The environment, AEC or parallel
    :return: The parallel environment
    :raises TypeError: If it is neither
    """
    if isinstance(env, AECEnv):
        if env.metadata.get("is_parallelizable", False):
            env = aec_to_parallel(env)
        else:
            return SplitMasks(TurnBased(env))
    if not isinstance(env, ParallelEnv):
        raise TypeError(f"to_parallel() needs an AECEnv or a ParallelEnv of PettingZoo, got {type(env).__name__}.")
    masked = [agent for agent in env.possible_agents if _has_mask(env.observation_space(agent))]
    return SplitMasks(env) if masked else env


class Adapter(BaseParallelWrapper):
    """
    Wrapper that returns itself as ``unwrapped``.

    Some wrappers of SuperSuit convert an environment to AEC and back, and only ``unwrapped`` passes through these conversions.
    What the adapter offers beyond PettingZoo's interface is therefore still found there.

    :param env: The environment
    """

    def __init__(self, env: ParallelEnv):
        super().__init__(env)
        self.possible_agents = list(env.possible_agents)
        self.metadata = env.metadata
        self.render_mode = getattr(env, "render_mode", None)

    @property
    def unwrapped(self) -> ParallelEnv:
        """This wrapper."""
        return self

    @property
    def agents(self) -> list[str]:
        """The agents that are in play."""
        return self.env.agents

    def __getattr__(self, name: str) -> Any:
        # PettingZoo's conversions do not pass on attributes, so these are looked up behind them. Private names are excluded so
        # that pickle and copy work
        if name.startswith("_") or name == "env":
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        return getattr(self.env, name) if hasattr(self.env, name) else getattr(self.env.unwrapped, name)


class TurnBased(Adapter):
    """
    Turn-based game, in which all others see the action of the agent whose turn it is.

    :param env: The AEC environment
    """

    def __init__(self, env: AECEnv):
        super().__init__(turn_based_aec_to_parallel(env))
        self._aec = env
        self._moved = ""

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """
        Start an episode, in which no agent has had its turn yet.

        :param seed: Seed of the environment. With None its random generator continues
        :param options: Passed on to the environment
        :return: Observations and infos, by agent
        """
        self._moved = ""
        return self.env.reset(seed=seed, options=options)

    def step(self, actions: dict[str, Any]) -> tuple[dict, dict, dict, dict, dict]:
        """
        Advance the episode by one turn.

        :param actions: Actions of all agents. Only that of the agent whose turn it is counts
        :return: Observations, rewards, terminations, truncations and infos, by agent
        """
        self._moved = self._aec.agent_selection
        return self.env.step(actions)

    def visibility(self) -> dict[str, np.ndarray]:
        """
        Return which other agent had its turn in the last step, since no other agent's action counted.

        :return: {agent: bool [n_others]}
        """
        return {
            agent: np.array([other == self._moved for other in self.possible_agents if other != agent], dtype=bool)
            for agent in self.possible_agents
        }


class SplitMasks(Adapter):
    """
    Wrapper that moves the masks of observations ``{"observation": ..., "action_mask": ...}`` to the infos.

    A mask that allows no action, as for an agent whose turn it is not, is changed to allow action 0, since a model must always
    choose one.

    :param env: The environment. Observations of another form are left unchanged
    """

    def __init__(self, env: ParallelEnv):
        super().__init__(env)
        self._masked = [agent for agent in self.possible_agents if _has_mask(env.observation_space(agent))]

    def observation_space(self, agent: str) -> spaces.Space:
        """
        Return the observation space of an agent.

        :param agent: Name of the agent
        :return: Space of its observations without the mask
        """
        space: Any = self.env.observation_space(agent)
        return space["observation"] if agent in self._masked else space

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """
        Reset the environment and move the masks to the infos.

        :param seed: Seed of the environment. With None its random generator continues
        :param options: Passed on to the environment
        :return: Observations and infos, by agent
        """
        return self._split(*self.env.reset(seed=seed, options=options))

    def step(self, actions: dict[str, Any]) -> tuple[dict, dict, dict, dict, dict]:
        """
        Step the environment and move the masks to the infos.

        :param actions: Actions by agent
        :return: Observations, rewards, terminations, truncations and infos, by agent
        """
        obs, rewards, terminations, truncations, infos = self.env.step(actions)
        obs, infos = self._split(obs, infos)
        return obs, rewards, terminations, truncations, infos

    def _split(self, obs: dict[str, Any], infos: dict[str, dict[str, Any]]) -> tuple[dict, dict]:
        obs, infos = dict(obs), dict(infos)
        for agent in self._masked:
            if agent in obs:
                mask = np.array(obs[agent]["action_mask"], dtype=bool)
                mask[0] |= not mask.any()
                obs[agent], infos[agent] = obs[agent]["observation"], {**infos.get(agent, {}), "action_mask": mask}
        return obs, infos


class Pursuit(Adapter):
    """
    SISL's pursuit, in which a pursuer sees the actions of the pursuers in its window.

    The window has ``obs_range`` x ``obs_range`` cells, 7x7 by default, with the pursuer in the middle.

    :param env: The parallel environment
    """

    def visibility(self) -> dict[str, np.ndarray]:
        """
        Return which other pursuers were in the window after the last step.

        :return: {agent: bool [n_others]}
        """
        game = self.env.unwrapped.env
        cells = np.array([game.pursuer_layer.get_position(i) for i in range(len(self.possible_agents))])
        near = np.abs(cells[:, None] - cells[None]).max(axis=-1) <= game.obs_offset
        return {agent: np.delete(near[i], i) for i, agent in enumerate(self.possible_agents)}


def _has_mask(space: spaces.Space) -> bool:
    return isinstance(space, spaces.Dict) and set(space.spaces) == {"observation", "action_mask"}
