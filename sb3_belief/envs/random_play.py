"""Random play for the contract checker: what was seen, and the first fault of each kind."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from sb3_belief.vec_env.joint_env import mask_width
from sb3_belief.vec_env.scripted_others import ScriptedOthers, optional_member

# What the contract puts into infos
FLAGS = ("active", "life_end", "is_success")
KEYS = ("action_mask", *FLAGS)


@dataclass
class PlayRecord:
    """
    What was seen.

    :param trace: of each step (and the reset, first) everything that the environment returned, to be compared
    :param faults: {topic: the first fault, and what to change}
    """

    trace: list[tuple] = field(default_factory=list)
    faults: dict[str, str] = field(default_factory=dict)
    lengths: list[int] = field(default_factory=list)
    endings: list[str] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    other_keys: set[str] = field(default_factory=set)
    masked: set[str] = field(default_factory=set)
    n_possible: int = 0
    n_masked: int = 0
    acted: int = 0
    inactive: int = 0
    life_ends: int = 0
    n_flags: int = 0
    n_visible: int = 0
    n_pairs: int = 0
    n_one_sided: int = 0

    def fault(self, topic: str, what: str, change: str) -> None:
        """
        :param topic: what it is about; the first fault of each is kept
        :param what: what is wrong
        :param change: what to change
        """
        self.faults.setdefault(topic, f"{what}. Change: {change}.")

    def mask_summary(self) -> str:
        """
        :return: in words
        """
        if not self.masked:
            return "none, every action is possible at any time"
        return f"of {len(self.masked)} agents, {self.n_possible / self.n_masked:.0%} of the actions are possible"

    def visibility_summary(self) -> tuple[str, str]:
        """
        :return: verdict and words
        """
        if not self.n_flags:
            return "note", "no visibility(): everybody sees the actions of everybody in play"
        share, one_sided = self.n_visible / self.n_flags, self.n_one_sided / max(self.n_pairs, 1)
        symmetry = f"one-sided in {one_sided:.1%} of the pairs of agents" if self.n_one_sided else "always mutual"
        return "ok", f"{share:.1%} of the others' actions are visible, {symmetry}"

    def ends_summary(self) -> tuple[str, str]:
        """
        :return: verdict and words
        """
        if not self.lengths:
            return "note", "no episode ended: play longer, or see to it that they end"
        cut = self.endings.count("truncated")
        text = (
            f"{len(self.lengths)} episodes of {min(self.lengths)} to {max(self.lengths)} steps,"
            f" {len(self.lengths) - cut} terminated and {cut} truncated"
        )
        if len(self.lengths) >= 3 and not cut and min(self.lengths) == max(self.lengths) > 1:
            limit = f"; if {self.lengths[0]} steps are a time limit, report it by truncations, so that values are bootstrapped"
            return "note", text + limit
        return "ok", text


def play_randomly(env: ParallelEnv, n_steps: int, seed: int, action_seed: int = 0) -> PlayRecord:
    """
    :param env: the environment
    :param n_steps: how many steps to play; episodes that end are followed by further ones
    :param seed: of the environment's reset
    :param action_seed: of the actions
    :return: what was seen
    """
    player = RandomPlayer(env, action_seed)
    if player.reset(seed):
        for _ in range(n_steps):
            if not (player.step() if env.agents else player.reset(None) and player.step()):
                break
    return player.found


class RandomPlayer:
    """
    Plays with random actions that the masks allow, and looks at everything that comes back.

    :param env: the environment
    :param seed: of the actions
    """

    def __init__(self, env: ParallelEnv, seed: int):
        self.env, self.found, self.rng = env, PlayRecord(), np.random.default_rng(seed)
        self.agents = list(env.possible_agents)
        self.observation_spaces = {agent: env.observation_space(agent) for agent in self.agents}
        self.action_spaces = {agent: env.action_space(agent) for agent in self.agents}
        self.mask_widths = {agent: mask_width(space) for agent, space in self.action_spaces.items()}
        self.visibility = optional_member(env, "visibility")
        self.scripted = ScriptedOthers(env)
        self.masks: dict[str, np.ndarray] = {}
        self.t = 0

    def reset(self, seed: int | None) -> bool:
        """
        :param seed: of the environment
        :return: whether it can be played
        """
        found, self.t = self.found, 0
        try:
            obs, infos = self.env.reset(seed=seed)
            _require_dicts(obs, infos)
            playing = list(self.env.agents)
            self._observations(obs, playing)
            self._infos(infos, [])
            self._masks(infos, playing)
        except Exception as error:
            change = "it takes seed and options, returns two dicts by agent (observations, infos) and fills agents"
            found.fault("play", f"reset() fails with {type(error).__name__}: {error}", change)
            return False
        if not playing:
            found.fault("play", "agents is empty after reset()", "fill it with those who are in play")
            return False
        found.trace.append(("reset", *self._frozen(obs, infos)))
        return self._names("agents", playing)

    def step(self) -> bool:
        """
        :return: whether it can be played further
        """
        self.t += 1
        found, before = self.found, list(self.env.agents)
        actions = {agent: sample(self.action_spaces[agent], self.masks.get(agent), self.rng) for agent in before}
        try:
            obs, rewards, terminations, truncations, infos = self.env.step(actions)
            _require_dicts(obs, rewards, terminations, truncations, infos)
            after = list(self.env.agents)
            if not self._names("agents", after):
                return False
            self._observations(obs, before)
            self._rewards(rewards, before)
            self._ends(terminations, truncations, before, after)
            self._infos(infos, before)
            self._masks(infos, after)
            seen = self._visible(before)
            scripted = self.scripted.actions().tobytes() if self.scripted.action_spaces else b""
        except Exception as error:
            change = (
                "step() takes {agent: action} with the actions that masks and spaces allow, and returns five dicts by agent"
                " (observations, rewards, terminations, truncations, infos)"
            )
            found.fault("play", f"step {self.t} fails with {type(error).__name__}: {error}", change)
            return False
        flags = [(bool(terminations.get(agent)), bool(truncations.get(agent))) for agent in before]
        numbers = [repr(rewards.get(agent)) for agent in before]
        found.trace.append((before, after, numbers, flags, seen, scripted, *self._frozen(obs, infos)))
        if not after:
            found.lengths.append(self.t)
            found.endings.append("truncated" if any(cut for _, cut in flags) else "terminated")
        return True

    def _frozen(self, obs: Mapping[str, Any], infos: Mapping[str, Any]) -> tuple:
        seen = [np.asarray(obs[agent]).tobytes() if agent in obs else b"" for agent in self.agents]
        told = [[np.asarray(infos.get(agent, {}).get(key)).tobytes() for key in KEYS[:-1]] for agent in self.agents]
        return seen, told

    def _names(self, what: str, names: Any) -> bool:
        unknown = [name for name in names if name not in self.agents]
        if unknown:
            change = "name all agents that can ever appear in possible_agents, and only these elsewhere"
            self.found.fault("names", f"{what} have {unknown[0]!r} at step {self.t}, which is not in possible_agents", change)
        return not unknown

    def _observations(self, obs: Mapping[str, Any], acted: list[str]) -> None:
        self._names("observations", obs)
        for agent in acted:
            if agent not in obs:
                change = "give one to each agent that acted, also the last one of who leaves"
                self.found.fault("observations", f"none for {agent!r} at step {self.t}", change)
                continue
            why = misfit(self.observation_spaces[agent], obs[agent])
            if why:
                change = f"return what lies in {self.observation_spaces[agent]}, or correct observation_space({agent!r})"
                self.found.fault("observations", f"that of {agent!r} at step {self.t} {why}", change)

    def _rewards(self, rewards: Mapping[str, Any], acted: list[str]) -> None:
        self._names("rewards", rewards)
        for agent in acted:
            value = np.asarray(rewards.get(agent))
            if value.dtype.kind not in "biuf" or value.size != 1 or not np.isfinite(value).all():
                change = "give each agent that acted one finite number"
                self.found.fault("rewards", f"that of {agent!r} at step {self.t} is {rewards.get(agent)!r}", change)
            else:
                self.found.rewards.append(float(value.item()))

    def _ends(
        self, terminations: Mapping[str, Any], truncations: Mapping[str, Any], before: list[str], after: list[str]
    ) -> None:
        for agent in before:
            flags = [part.get(agent) for part in (terminations, truncations)]
            who = f"{agent!r} at step {self.t}"
            if not all(isinstance(flag, bool | np.bool_) for flag in flags):
                self.found.fault(
                    "ends", f"terminations and truncations are {flags} for {who}", "give each agent True or False"
                )
            elif all(flags):
                change = "terminations say that there is nothing more to come, truncations that a limit cut it: choose one"
                self.found.fault("ends", f"{who} is both terminated and truncated", change)
            elif any(flags) == (agent in after):
                state = "has ended but is still in agents" if any(flags) else "left agents without termination or truncation"
                change = "take an agent out of agents in the very step that terminates or truncates it"
                self.found.fault("ends", f"{who} {state}", change)

    def _infos(self, infos: Mapping[str, Any], acted: list[str]) -> None:
        self._names("infos", infos)
        for agent, info in infos.items():
            if not isinstance(info, Mapping):
                change = "infos is a dict of dicts by agent"
                self.found.fault("infos", f"that of {agent!r} at step {self.t} is a {type(info).__name__}", change)
                return
            self.found.other_keys |= {str(key) for key in info} - set(KEYS)
            for key in FLAGS:
                if key in info and not isinstance(info[key], bool | np.bool_):
                    what = f"infos[{agent!r}][{key!r}] at step {self.t} is {info[key]!r}"
                    self.found.fault("flags", what, "make it True or False, or leave it out")
        for agent in acted:
            info = infos.get(agent, {})
            self.found.acted += 1
            self.found.inactive += not info.get("active", True)
            self.found.life_ends += bool(info.get("life_end", False))

    def _masks(self, infos: Mapping[str, Any], playing: list[str]) -> None:
        found, self.masks = self.found, {}
        for agent in playing:
            who = f"{agent!r} at {'step ' + str(self.t) if self.t else 'reset'}"
            if "action_mask" not in infos.get(agent, {}):
                if agent in found.masked:
                    change = "give one at every step and at reset(), for the next action, or never"
                    found.fault("masks", f"none for {who}, though it had one before", change)
                continue
            mask, width = np.asarray(infos[agent]["action_mask"]).ravel(), self.mask_widths[agent]
            if self.t and agent not in found.masked:
                change = "give one at reset() too, for the first action"
                found.fault("masks", f"the first one of {agent!r} comes at step {self.t}", change)
            found.masked.add(agent)
            if mask.size != width or not np.isin(mask, (0, 1)).all():
                change = f"give {width} flags, one for each action" if width else "leave it out: boxes cannot be masked"
                found.fault("masks", f"that of {who} has {mask.size} entries, {mask.tolist()[:8]}", change)
            elif not mask.any():
                found.fault("masks", f"that of {who} allows no action", "allow one that does nothing, a model must choose one")
            else:
                self.masks[agent] = mask.astype(bool)
                found.n_masked += mask.size
                found.n_possible += int(mask.sum())

    def _visible(self, acted: list[str]) -> bytes:
        if self.visibility is None:
            return b""
        rows = self.visibility()
        n_others = len(self.agents) - 1 + len(self.scripted.action_spaces)
        change = (
            f"visibility() returns {{agent: {n_others} flags}}, the other agents in the order of possible_agents"
            + " and then the scripted others" * bool(self.scripted.action_spaces)
        )
        if not isinstance(rows, Mapping):
            self.found.fault("visibility", f"it returns a {type(rows).__name__} at step {self.t}", change)
            return b""
        sees: dict[tuple[str, str], bool] = {}
        for agent in rows:
            row = np.asarray(rows[agent]).ravel()
            if agent not in self.agents or row.size != n_others or not np.isin(row, (0, 1)).all():
                what = f"the entry for {agent!r} at step {self.t} is {row.tolist()[:8]} ({row.size})"
                self.found.fault("visibility", what, change)
                return b""
            if agent in acted:
                self.found.n_flags += row.size
                self.found.n_visible += int(row.sum())
                others = [other for other in self.agents if other != agent]
                sees |= {(agent, other): bool(flag) for other, flag in zip(others, row, strict=False) if other in acted}
        missing = [agent for agent in acted if agent not in rows]
        if missing:
            self.found.fault("visibility", f"no entry for {missing[0]!r}, who acted at step {self.t}", change)
        pairs = [(i, j) for i, j in sees if i < j and (j, i) in sees]
        self.found.n_pairs += len(pairs)
        self.found.n_one_sided += sum(sees[pair] != sees[pair[::-1]] for pair in pairs)
        return b"".join(np.asarray(rows[agent], dtype=bool).tobytes() for agent in self.agents if agent in rows)


def _require_dicts(*parts: Any) -> None:
    for part in parts:
        if not isinstance(part, Mapping):
            raise TypeError(f"a {type(part).__name__} is no dict by agent")


def sample(space: spaces.Space, mask: np.ndarray | None, rng: np.random.Generator) -> Any:
    """
    :param space: an action space
    :param mask: which actions are possible, None: all
    :param rng: generator
    :return: one of them, as a team would hand it over
    """
    if isinstance(space, spaces.Discrete):
        return int(rng.choice(np.arange(space.n) if mask is None else np.flatnonzero(mask)))
    if isinstance(space, spaces.MultiDiscrete | spaces.MultiBinary):
        sizes = np.full(space.shape, 2).ravel() if isinstance(space, spaces.MultiBinary) else space.nvec.ravel()
        whole = np.ones(int(sizes.sum()), dtype=bool) if mask is None else mask
        # A component of which nothing is possible is the environment's fault, and is found where it is played
        parts = np.split(whole, np.cumsum(sizes)[:-1])
        chosen = [rng.choice(np.flatnonzero(part)) if part.any() else 0 for part in parts]
        return np.array(chosen, dtype=space.dtype).reshape(space.shape)
    assert isinstance(space, spaces.Box)
    low, high = np.maximum(space.low, -1e3), np.minimum(space.high, 1e3)
    return rng.uniform(low, high).astype(space.dtype)


def misfit(space: spaces.Space, value: Any) -> str:
    """
    :param space: an observation space
    :param value: an observation
    :return: in which way it does not lie in the space, "" if it does; numbers of another type that fit do
    """
    array = np.asarray(value)
    if array.dtype.kind not in "biuf":
        return f"is a {type(value).__name__}"
    if array.shape != (space.shape or ()):
        return f"has the shape {array.shape} instead of {space.shape}"
    if not np.isfinite(array).all():
        return f"holds {array[~np.isfinite(array)].flat[0]}"
    if np.issubdtype(space.dtype, np.integer) and array.dtype.kind == "f":
        return f"is of type {array.dtype} instead of {space.dtype}"
    cast = array.astype(space.dtype)
    if space.contains(int(cast) if isinstance(space, spaces.Discrete) else cast):
        return ""
    if isinstance(space, spaces.Box):
        index = tuple(int(i) for i in np.argwhere((cast < space.low) | (cast > space.high))[0])
        return f"has {array[index]} at {index}, outside of [{space.low[index]}, {space.high[index]}]"
    return f"is {array.tolist()}"
