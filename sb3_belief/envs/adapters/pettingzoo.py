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
    :return: what comes after ``pettingzoo/``: ``<group>.<module>``; what a module needs may still be missing
    """
    return versioned_modules(*(f"pettingzoo.{group}" for group in _GROUPS), root="pettingzoo")


def versioned_modules(*packages: str, root: str) -> list[str]:
    """
    :param packages: names of packages
    :param root: package that the names are to be relative to
    :return: names of their modules that end in a version, as those of the environments do; none of them is imported
    """
    found = []
    for package in packages:
        spec = find_spec(package)
        locations = [] if spec is None else list(spec.submodule_search_locations or [])
        for module in pkgutil.iter_modules(locations, f"{package}."):
            if module.name.rpartition("_v")[2].isdecimal():
                found.append(module.name.removeprefix(f"{root}."))
    return sorted(found)


def make(name: str, **env_kwargs: Any) -> ParallelEnv:
    """
    :param name: ``<group>.<module>``, e.g. ``"sisl.pursuit_v5"``
    :param env_kwargs: keyword arguments of the environment
    :return: its parallel environment; one that has none is converted by ``to_parallel``. Everybody sees everybody's actions,
        except in ``sisl.pursuit``, where a pursuer sees those in its window.
    :raises ValueError: for an unknown name
    :raises ModuleNotFoundError: if what the environment needs is not installed, with the line that installs it
    """
    known = names()
    if name not in known:
        raise unknown_name("pettingzoo", name, known)
    try:
        with warnings.catch_warnings():
            # They are meant for those who import the module themselves
            warnings.simplefilter("ignore", DeprecationWarning)
            module = import_module(f"pettingzoo.{name}")
    except ImportError as error:
        group = name.partition(".")[0]
        raise ModuleNotFoundError(
            f"'pettingzoo/{name}' needs what is not installed ({error}): pip install 'pettingzoo[{group}]'.", name=error.name
        ) from error
    env = to_parallel((module.parallel_env if hasattr(module, "parallel_env") else module.env)(**env_kwargs))
    return Pursuit(env) if name.startswith("sisl.pursuit_v") else env


def to_parallel(env: AECEnv | ParallelEnv) -> ParallelEnv:
    """
    Make a PettingZoo environment one that a team can play, with PettingZoo's own conversions:

    - an AEC environment that says ``is_parallelizable`` by ``aec_to_parallel``, one whose agents take turns by
      ``turn_based_aec_to_parallel``: then all act at each step but only the action of the one on turn counts, the others see
      that one and can do nothing but action 0
    - observations ``{"observation": ..., "action_mask": ...}``, PettingZoo's convention, are split: masks go to the infos

    :param env: the environment, AEC or parallel
    :return: the parallel environment
    :raises TypeError: if it is neither
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
    A wrapper that stays ``unwrapped``: what it offers beyond PettingZoo's interface is found there even behind conversions to
    AEC and back, which some wrappers of SuperSuit consist of.

    :param env: the environment
    """

    def __init__(self, env: ParallelEnv):
        super().__init__(env)
        self.possible_agents = list(env.possible_agents)
        self.metadata = env.metadata
        self.render_mode = getattr(env, "render_mode", None)

    @property
    def unwrapped(self) -> ParallelEnv:
        """
        :return: this wrapper
        """
        return self

    @property
    def agents(self) -> list[str]:
        """
        :return: who is in play
        """
        return self.env.agents

    def __getattr__(self, name: str) -> Any:
        # Private names are left alone so that pickle and copy work; PettingZoo's conversions pass nothing on
        if name.startswith("_") or name == "env":
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        return getattr(self.env, name) if hasattr(self.env, name) else getattr(self.env.unwrapped, name)


class TurnBased(Adapter):
    """
    A game of turns: all others see the action of the one on turn.

    :param env: the AEC environment
    """

    def __init__(self, env: AECEnv):
        super().__init__(turn_based_aec_to_parallel(env))
        self._aec = env
        self._moved = ""

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """
        :param seed: of the game, None: its generator goes on
        :param options: handed to the environment
        :return: observations and infos, by agent
        """
        self._moved = ""
        return self.env.reset(seed=seed, options=options)

    def step(self, actions: dict[str, Any]) -> tuple[dict, dict, dict, dict, dict]:
        """
        :param actions: of all agents; only that of the one on turn counts
        :return: observations, rewards, terminations, truncations and infos, by agent
        """
        self._moved = self._aec.agent_selection
        return self.env.step(actions)

    def visibility(self) -> dict[str, np.ndarray]:
        """
        :return: bool [n_others] by agent: who was on turn in the last step, since nobody else did anything
        """
        return {
            agent: np.array([other == self._moved for other in self.possible_agents if other != agent], dtype=bool)
            for agent in self.possible_agents
        }


class SplitMasks(Adapter):
    """
    Splits observations ``{"observation": ..., "action_mask": ...}``: the masks go to the infos. A mask that allows nothing, as
    those have who are not on turn, allows action 0, since a model cannot but act.

    :param env: the environment; agents whose observations are of another kind are left as they are
    """

    def __init__(self, env: ParallelEnv):
        super().__init__(env)
        self._masked = [agent for agent in self.possible_agents if _has_mask(env.observation_space(agent))]

    def observation_space(self, agent: str) -> spaces.Space:
        """
        :param agent: its name
        :return: the space of its observation without the mask
        """
        space: Any = self.env.observation_space(agent)
        return space["observation"] if agent in self._masked else space

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """
        :param seed: of the environment, None: its generator goes on
        :param options: handed to the environment
        :return: observations and infos, by agent
        """
        return self._split(*self.env.reset(seed=seed, options=options))

    def step(self, actions: dict[str, Any]) -> tuple[dict, dict, dict, dict, dict]:
        """
        :param actions: by agent
        :return: observations, rewards, terminations, truncations and infos, by agent
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
    SISL's pursuit: a pursuer sees what those in its window do (``obs_range``, 7x7 cells by default, itself in the middle).

    :param env: the parallel environment
    """

    def visibility(self) -> dict[str, np.ndarray]:
        """
        :return: bool [n_others] by agent: who was in its window after the last step
        """
        game = self.env.unwrapped.env
        cells = np.array([game.pursuer_layer.get_position(i) for i in range(len(self.possible_agents))])
        near = np.abs(cells[:, None] - cells[None]).max(axis=-1) <= game.obs_offset
        return {agent: np.delete(near[i], i) for i, agent in enumerate(self.possible_agents)}


def _has_mask(space: spaces.Space) -> bool:
    return isinstance(space, spaces.Dict) and set(space.spaces) == {"observation", "action_mask"}
