"""Environments that are unusual in one way each, but mean something that is clear: what ``Walkers`` mean."""

from collections import OrderedDict
from types import MappingProxyType
from typing import Any

import numpy as np
from gymnasium import spaces

from tests.field.walkers import Walkers


class NoInfos(Walkers):
    def reset(self, seed=None, options=None):
        return super().reset()[0], None

    def change(self, *parts):
        return (*parts[:4], None)


class NoneAsInfo(Walkers):
    def reset(self, seed=None, options=None):
        obs, infos = super().reset()
        return obs, dict.fromkeys(infos)

    def change(self, *parts):
        return (*parts[:4], dict.fromkeys(parts[4]))


class NoneAsInfoOfSome(Walkers):
    def change(self, *parts):
        return (*parts[:4], {"walker_0": None, "walker_1": {"active": True}})


class InfoOfTheGame(Walkers):
    def change(self, *parts):
        return (*parts[:4], {**parts[4], "score": 3.5, "board": np.zeros(2), "words": "action_mask"})


class ListsOfOne(Walkers):
    def change(self, obs, rewards, *rest):
        return obs, {agent: [reward] for agent, reward in rewards.items()}, *rest


class ArraysOfOne(Walkers):
    def change(self, obs, rewards, terminations, truncations, infos):
        flags = {agent: np.array([cut]) for agent, cut in truncations.items()}
        return obs, {agent: np.array([[reward]]) for agent, reward in rewards.items()}, terminations, flags, infos


class NumpyNumbers(Walkers):
    def change(self, obs, rewards, terminations, truncations, infos):
        flags = {agent: np.bool_(cut) for agent, cut in truncations.items()}
        return obs, {agent: np.float16(reward) for agent, reward in rewards.items()}, terminations, flags, infos


class Integers(Walkers):
    def change(self, obs, rewards, terminations, truncations, infos):
        flags = {agent: int(cut) for agent, cut in truncations.items()}
        return obs, {agent: int(reward) for agent, reward in rewards.items()}, terminations, flags, infos


class OtherMappings(Walkers):
    def change(self, obs, rewards, *rest):
        return OrderedDict(obs), MappingProxyType(rewards), *map(MappingProxyType, rest)


class ListOfParts(Walkers):
    def change(self, *parts):
        return list(parts)


class ListsAsObservations(Walkers):
    def observe(self, agent):
        return super().observe(agent).tolist()


class OldReset(Walkers):
    def reset(self, seed=None, options=None):
        return super().reset()[0]


class OldStep(Walkers):
    def change(self, obs, rewards, terminations, truncations, infos):
        return obs, rewards, truncations, {agent: {"TimeLimit.truncated": True} for agent in infos}


class Views(Walkers):
    kind: Any = staticmethod(lambda agents: dict.fromkeys(agents).keys())

    def reset(self, seed=None, options=None):
        result = super().reset()
        self.agents = self.kind(self.agents)
        return result

    def step(self, actions):
        result = super().step(actions)
        self.agents = self.kind(self.agents)
        return result


class Tuples(Views):
    kind = tuple


class Sets(Views):
    kind = set


class Arrays(Views):
    kind = staticmethod(lambda agents: np.array(list(agents), dtype=str))


class NoneForNobody(Walkers):
    def step(self, actions):
        result = super().step(actions)
        self.agents = self.agents or None
        return result


class NoOptions(Walkers):
    def reset(self, seed=None):  # type: ignore[override]
        return super().reset()


class Positional(Walkers):
    def reset(self):  # type: ignore[override]
        return super().reset()


class SpacesAfterReset(Walkers):
    """Agents and spaces do not exist before the first reset."""

    def __init__(self):
        super().__init__()
        del self.possible_agents
        self.known: dict[str, spaces.Space] = {}

    def observation_space(self, agent):
        return self.known[agent]

    def reset(self, seed=None, options=None):
        self.possible_agents = ["walker_0", "walker_1"]
        self.known = dict.fromkeys(self.possible_agents, self.obs_space)
        return super().reset()


class NoneBeforeReset(SpacesAfterReset):
    def observation_space(self, agent):
        return self.known.get(agent)


class Duck:
    """The interface without the base class, and with slots instead of a dict."""

    __slots__ = ("_game",)

    def __init__(self):
        self._game = Walkers()

    possible_agents = property(lambda self: self._game.possible_agents)
    agents = property(lambda self: self._game.agents)

    def observation_space(self, agent):
        return self._game.observation_space(agent)

    def action_space(self, agent):
        return self._game.action_space(agent)

    def reset(self, seed=None, options=None):
        return self._game.reset()

    def step(self, actions):
        return self._game.step(actions)


CLEAR = [
    NoInfos,
    NoneAsInfo,
    NoneAsInfoOfSome,
    InfoOfTheGame,
    ListsOfOne,
    ArraysOfOne,
    NumpyNumbers,
    Integers,
    OtherMappings,
    ListOfParts,
    ListsAsObservations,
    OldReset,
    OldStep,
    Views,
    Tuples,
    Sets,
    Arrays,
    NoneForNobody,
    NoOptions,
    Positional,
    SpacesAfterReset,
    NoneBeforeReset,
    Duck,
]
