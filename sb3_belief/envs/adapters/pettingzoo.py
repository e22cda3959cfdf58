"""PettingZoo's own environments (``pettingzoo/sisl.pursuit_v5``), and the conversion of AEC environments."""

import pkgutil
import warnings
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils.conversions import aec_to_parallel, aec_to_parallel_wrapper, turn_based_aec_to_parallel_wrapper
from pettingzoo.utils.wrappers import BaseParallelWrapper, BaseWrapper

from sb3_belief.common.action_masks import first_actions
from sb3_belief.envs.suites import unknown_name
from sb3_belief.vec_env.observation_forms import ObservationForms
from sb3_belief.vec_env.user_env import UserEnv

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


def to_parallel(env: AECEnv | ParallelEnv, turn_based: bool | None = None) -> ParallelEnv:
    """
    Convert a PettingZoo environment to one that a team can play, with PettingZoo's own conversions.

    - An AEC environment with ``is_parallelizable`` in its metadata is converted by ``aec_to_parallel``.
    - Any other AEC environment is turn-based and converted by ``turn_based_aec_to_parallel``. All agents act at each step, but
      only the action of the agent whose turn it is counts, and only for that agent the step is an active one (``active`` in
      the infos). The others see that action and can only choose action 0. Rewards that they get meanwhile count for what they
      did before.
    - Observations that models do not take are converted. Masks beside an observation, as in PettingZoo's
      ``{"observation": ..., "action_mask": ...}``, are moved to the infos, whatever the other entries are called. Tuples and
      nested dicts become dicts of one level (``"sensors/camera"``).

    :param env: The environment, AEC or parallel; also an object with the whole interface of a ``ParallelEnv``
    :param turn_based: Whether an AEC environment is turn-based; None to go by its metadata
    :return: The parallel environment
    :raises TypeError: If it is neither
    :raises ValueError: If ``turn_based`` is given for a parallel environment
    """
    if isinstance(env, AECEnv):
        if turn_based is None:
            turn_based = not env.metadata.get("is_parallelizable", False)
        return TurnBased(env) if turn_based else AllAtOnce(env)
    kind = type(env).__name__
    if not isinstance(env, ParallelEnv):
        try:
            env = UserEnv(env)
        except TypeError as error:
            raise TypeError(f"to_parallel() needs an AECEnv or a ParallelEnv of PettingZoo, got {kind}: {error}") from None
    if turn_based is not None:
        raise ValueError(
            f"turn_based={turn_based} says how to convert an AECEnv, but {kind} is a ParallelEnv: leave it out."
            " An environment of this kind says by infos[agent]['active'] = False who could not act in a step."
        )
    return in_model_form(env)


def in_model_form(env: ParallelEnv) -> ParallelEnv:
    """
    Convert the observations of an environment, if they need it.

    :param env: The environment
    :return: The same, or a :class:`ModelObservations` around it
    """
    return env if ObservationForms(env).is_identity else ModelObservations(env)


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


class _WithInfos(BaseWrapper):
    """AEC environment in which each agent has an info, without which PettingZoo's conversions and its dead step fail."""

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        super().reset(seed=seed, options=options)
        self._fill()

    def step(self, action: Any) -> None:
        super().step(action)
        self._fill()

    def _fill(self) -> None:
        game = self.env
        while isinstance(game, BaseWrapper):
            game = game.env
        infos = getattr(game, "infos", None) or {}
        if not all(isinstance(infos.get(agent), dict) for agent in game.agents):
            game.infos = {**infos, **{agent: infos.get(agent) or {} for agent in game.agents}}


class AllAtOnce(Adapter):
    """
    AEC environment whose agents all act at once, on what they observed at the beginning of the cycle.

    :param env: The AEC environment
    """

    def __init__(self, env: AECEnv):
        if not env.metadata.get("is_parallelizable", False):
            # to_parallel(env, turn_based=False) overrides what PettingZoo's conversion looks at
            env.metadata = {**env.metadata, "is_parallelizable": True}
        parallel = aec_to_parallel(env)
        if isinstance(parallel, aec_to_parallel_wrapper):
            parallel.aec_env = _WithInfos(env)
        super().__init__(in_model_form(parallel))
        self._aec = env

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """
        Reset the environment.

        :param seed: Seed of the environment. With None its random generator continues
        :param options: Passed on to the environment
        :return: Observations and infos, by agent
        :raises ValueError: If an agent cannot act, as in a turn-based game
        """
        obs, infos = self.env.reset(seed=seed, options=options)
        self._check_masks(infos)
        return obs, infos

    def step(self, actions: dict[str, Any]) -> tuple[dict, dict, dict, dict, dict]:
        """
        Let all agents act in a cycle.

        :param actions: Actions by agent
        :return: Observations, rewards, terminations, truncations and infos, by agent
        :raises ValueError: If the agents do not act in a cycle, as in a turn-based game
        """
        try:
            step = self.env.step(actions)
        except AssertionError as error:
            if "Parallel environment wrapper expects" not in str(error):
                raise
            raise self._refusal(str(error)) from error
        self._check_masks(step[-1])
        return step

    def _check_masks(self, infos: dict[str, dict[str, Any]]) -> None:
        for agent in self.agents:
            if not np.any(infos.get(agent, {}).get("action_mask", True)):
                raise self._refusal(f"the action mask of {agent!r} allows nothing at the beginning of a cycle.")

    def _refusal(self, why: str) -> ValueError:
        return ValueError(
            f"{type(self._aec.unwrapped).__name__} is not played by all agents at once, although is_parallelizable in its"
            f" metadata says so: {why} Use sb3_belief.envs.to_parallel(env, turn_based=True)."
        )


class _Turns(turn_based_aec_to_parallel_wrapper):
    """PettingZoo's conversion, in which those who are out leave at once, and with what the others observe from then on."""

    agents: list[Any]

    def __init__(self, env: AECEnv):
        super().__init__(_WithInfos(env))

    def step(self, actions: dict[str, Any]) -> tuple[dict, dict, dict, dict, dict]:
        acted = set(self.agents)
        obs, rewards, terminations, truncations, infos = super().step(actions)
        # A game may let those who are out wait for their turn before it takes them out of its agents
        out = {agent for agent, ended in terminations.items() if ended or truncations.get(agent)}
        for part in (obs, terminations, truncations, infos):
            for agent in out - acted:
                part.pop(agent, None)
        self.agents = [agent for agent in self.agents if agent not in out]
        if len(self.agents) < len(obs):
            # Until then one who is out was on turn, and nobody else had an action in its mask
            obs.update({agent: self.aec_env.observe(agent) for agent in self.agents})
        return obs, rewards, terminations, truncations, infos


class TurnBased(Adapter):
    """
    Turn-based game, in which all others see the action of the agent whose turn it is.

    :param env: The AEC environment
    """

    #: Who waits for its turn watches
    observe_while_inactive = True

    def __init__(self, env: AECEnv):
        super().__init__(in_model_form(_Turns(env)))
        self._aec = env
        self._moved = ""
        self._watched: list[str] = []

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """
        Start an episode, in which no agent has had its turn yet.

        :param seed: Seed of the environment. With None its random generator continues
        :param options: Passed on to the environment
        :return: Observations and infos, by agent
        """
        self._moved, self._watched = "", []
        obs, infos = self.env.reset(seed=seed, options=options)
        return obs, self._with_turns(infos)

    def step(self, actions: dict[str, Any]) -> tuple[dict, dict, dict, dict, dict]:
        """
        Advance the episode by one turn.

        :param actions: Actions of all agents. Only that of the agent whose turn it is counts
        :return: Observations, rewards, terminations, truncations and infos, by agent
        """
        acted, self._moved = list(self.agents), self._aec.agent_selection
        obs, rewards, terminations, truncations, infos = self.env.step(actions)
        infos = self._with_turns(infos)
        self._watched = acted
        for agent in acted:
            turns = {"active": agent == self._moved, "next_active": agent == self._aec.agent_selection}
            infos[agent] = {**infos.get(agent, {}), **turns}
        return obs, rewards, terminations, truncations, infos

    def _with_turns(self, infos: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
        """Return infos in which the masks of all who are not on turn allow action 0 only, whatever the game gives them."""
        infos = dict(infos)
        for agent, info in infos.items():
            if agent != self._aec.agent_selection and "action_mask" in info:
                infos[agent] = {**info, "action_mask": first_actions(self.action_space(agent))}
        return infos

    def visibility(self) -> dict[str, np.ndarray]:
        """
        Return which other agent had its turn in the last step, since no other agent's action counted.

        :return: {agent: bool [n_others]} of those who were in the game
        """
        return {
            agent: np.array([other == self._moved for other in self.possible_agents if other != agent], dtype=bool)
            for agent in self._watched
        }


class ModelObservations(Adapter):
    """
    Wrapper that brings observations into the form that models take: arrays or dicts of arrays, with the masks in the infos.

    A team does so itself; the wrapper is for those who play the environment by hand. See :class:`ObservationForms`.

    :param env: The environment
    """

    def __init__(self, env: ParallelEnv):
        super().__init__(env)
        self._forms = ObservationForms(env)

    def observation_space(self, agent: str) -> spaces.Space:
        """
        Return the observation space of an agent.

        :param agent: Name of the agent
        :return: Space of its observations in that form
        """
        return self._forms.spaces[agent]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """
        Reset the environment and convert its observations.

        :param seed: Seed of the environment. With None its random generator continues
        :param options: Passed on to the environment
        :return: Observations and infos, by agent
        """
        obs, infos = self.env.reset(seed=seed, options=options)
        return self._forms.convert(obs, infos, "at reset")

    def step(self, actions: dict[str, Any]) -> tuple[dict, dict, dict, dict, dict]:
        """
        Step the environment and convert its observations.

        :param actions: Actions by agent
        :return: Observations, rewards, terminations, truncations and infos, by agent
        """
        obs, rewards, terminations, truncations, infos = self.env.step(actions)
        obs, infos = self._forms.convert(obs, infos, "at a step")
        return obs, rewards, terminations, truncations, infos


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
