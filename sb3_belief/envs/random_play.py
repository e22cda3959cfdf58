"""Random play for the environment checker, with a record of what was observed and the first fault of each kind."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from sb3_belief.common.action_masks import first_actions, flat_mask, mask_parts, mask_width, sample_action
from sb3_belief.vec_env.observation_forms import as_bytes
from sb3_belief.vec_env.returned import ALL, plain_ends, plain_infos, plain_reset, plain_step
from sb3_belief.vec_env.scripted_others import ScriptedOthers, optional_member
from sb3_belief.vec_env.user_env import UserEnv, separate_agents

# The keys of infos that belong to the contract
FLAGS = ("active", "life_end", "is_success")
KEYS = ("action_mask", *FLAGS)


@dataclass
class PlayRecord:
    """
    What was observed during play.

    :param trace: Everything that the environment returned, one entry for each reset and step, to be compared between plays
    :param faults: {topic: the first fault and what to change}
    :param lengths: Length in steps of each finished episode
    :param endings: ``"terminated"`` or ``"truncated"`` for each finished episode
    :param successes: For each finished episode whether the environment said if it was a success
    :param rewards: The rewards of all agents
    :param other_keys: Keys of infos that do not belong to the contract
    :param masked: Agents that have action masks
    :param n_possible: Number of mask entries that allow an action, out of ``n_masked``
    :param n_masked: Number of mask entries
    :param n_actions: Number of actions, summed over agents
    :param n_inactive: Number of actions with the flag ``active`` False
    :param life_ends: Number of flags ``life_end`` that were True
    :param n_visible: Number of visibility flags that are True, out of ``n_flags``
    :param n_flags: Number of visibility flags
    :param n_one_sided: Number of pairs of agents of which exactly one observed the other, out of ``n_pairs``
    :param n_pairs: Number of pairs of agents, summed over steps
    """

    trace: list[tuple] = field(default_factory=list)
    faults: dict[str, str] = field(default_factory=dict)
    lengths: list[int] = field(default_factory=list)
    endings: list[str] = field(default_factory=list)
    successes: list[bool] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    other_keys: set[str] = field(default_factory=set)
    masked: set[str] = field(default_factory=set)
    n_possible: int = 0
    n_masked: int = 0
    n_actions: int = 0
    n_inactive: int = 0
    life_ends: int = 0
    n_visible: int = 0
    n_flags: int = 0
    n_one_sided: int = 0
    n_pairs: int = 0

    def fault(self, topic: str, what: str, change: str) -> None:
        """
        Record a fault, unless there is already one of the same topic.

        :param topic: The part of the contract that is violated
        :param what: What is wrong
        :param change: What to change
        """
        self.faults.setdefault(topic, f"{what}. Change: {change}.")

    def mask_summary(self) -> str:
        """
        Describe the action masks.

        :return: Text for the report
        """
        if not self.masked:
            return "none, every action is possible at any time"
        return f"of {len(self.masked)} agents, {self.n_possible / self.n_masked:.0%} of the actions are possible"

    def visibility_summary(self) -> tuple[str, str]:
        """
        Describe how much agents observe of each other's actions.

        :return: Verdict and text for the report
        """
        if not self.n_flags:
            return "note", "no visibility(): every agent sees the actions of all agents in play"
        share, one_sided = self.n_visible / self.n_flags, self.n_one_sided / max(self.n_pairs, 1)
        symmetry = f"one-sided in {one_sided:.1%} of the pairs of agents" if self.n_one_sided else "always mutual"
        return "ok", f"{share:.1%} of the others' actions are visible, {symmetry}"

    def success_summary(self) -> tuple[str, str]:
        """
        Describe at how many ends the environment said whether the episode was a success.

        :return: Verdict and text for the report
        """
        if any(self.successes) and not all(self.successes):
            change = "the others count as False; better return it at each end, False where the team did not succeed"
            return "note", f"is_success at {sum(self.successes)} of {len(self.successes)} ends only: {change}"
        return "ok", "is_success at each end" if any(self.successes) else "the environment does not report is_success"

    def ends_summary(self) -> tuple[str, str]:
        """
        Describe how episodes ended.

        :return: Verdict and text for the report
        """
        if not self.lengths:
            return "note", "no episode ended: play longer, or make sure that episodes end"
        n_truncated = self.endings.count("truncated")
        text = (
            f"{len(self.lengths)} episodes of {min(self.lengths)} to {max(self.lengths)} steps,"
            f" {len(self.lengths) - n_truncated} terminated and {n_truncated} truncated"
        )
        # Several terminations after the same number of steps look like a time limit that is reported wrongly
        if len(self.lengths) >= 3 and not n_truncated and min(self.lengths) == max(self.lengths) > 1:
            limit = f"; if {self.lengths[0]} steps are a time limit, report it by truncations, so that values are bootstrapped"
            return "note", text + limit
        return "ok", text


def play_randomly(env: ParallelEnv, n_steps: int, seed: int, action_seed: int = 0) -> PlayRecord:
    """
    Play an environment with random actions until a fault makes that impossible.

    :param env: The environment
    :param n_steps: Number of steps to play. An episode that ends is followed by another one
    :param seed: Seed of the environment's first reset
    :param action_seed: Seed of the actions
    :return: What was observed
    """
    player = RandomPlayer(env, action_seed)
    if player.reset(seed):
        for _ in range(n_steps):
            if not (player.step() if player.env.agents else player.reset(None) and player.step()):
                break
    return player.record


class RandomPlayer:
    """
    Player that takes random actions allowed by the masks and checks everything that the environment returns.

    :param env: The environment
    :param seed: Seed of the actions
    """

    def __init__(self, env: ParallelEnv, seed: int):
        self.env = user_env = env if isinstance(env, UserEnv) else UserEnv(env)
        self.record, self.rng = PlayRecord(), np.random.default_rng(seed)
        self.agents = list(user_env.possible_agents)
        self.observation_spaces = {agent: user_env.observation_space(agent) for agent in self.agents}
        self.action_spaces = {agent: user_env.action_space(agent) for agent in self.agents}
        self.mask_widths = {agent: mask_width(space) for agent, space in self.action_spaces.items()}
        self.visibility, _ = user_env.renamed_members(optional_member(env, "visibility"), None)
        self.scripted = ScriptedOthers(env)
        self.masks: dict[str, np.ndarray] = {}
        # Whose present mask allows no action, and where it was given
        self.unable: dict[str, str] = {}
        self.t, self.says_success = 0, False

    def reset(self, seed: int | None) -> bool:
        """
        Reset the environment and check what it returns.

        :param seed: Seed of the reset
        :return: Whether the environment can be stepped
        """
        record, self.t, self.says_success = self.record, 0, False
        try:
            obs, infos = plain_reset(self.env.reset(seed=seed), "at reset")
            infos = plain_infos(infos, self.agents, "at reset")
            separate_agents(self.env.env)
            playing = list(self.env.agents)
            self._check_observations(obs, playing)
            self._check_infos(infos, [])
            self._check_masks(infos, playing)
        except Exception as error:
            change = "reset() takes seed and options, returns two dicts by agent (observations, infos) and fills agents"
            record.fault("play", f"reset() fails with {type(error).__name__}: {error}", change)
            return False
        if not playing:
            record.fault("play", "agents is empty after reset()", "fill it with the agents that are in play")
            return False
        record.trace.append(("reset", *self._as_bytes(obs, infos)))
        return self._check_agents("agents", playing)

    def step(self) -> bool:
        """
        Step the environment with a random action of each agent and check what it returns.

        :return: Whether the environment can be stepped further
        """
        self.t += 1
        record, before = self.record, list(self.env.agents)
        actions = {agent: sample_action(self.action_spaces[agent], self.masks.get(agent), self.rng) for agent in before}
        try:
            obs, rewards, terminations, truncations, infos = plain_step(self.env.step(actions), f"at step {self.t}")
            infos = plain_infos(infos, self.agents, f"at step {self.t}")
            after = list(self.env.agents)
            ended = [name for name in (*terminations, *truncations) if name != ALL]
            if not self._check_agents("agents", after) or not self._check_agents("terminations and truncations", ended):
                return False
            if ALL in terminations or ALL in truncations:
                terminations, truncations = plain_ends(terminations, truncations, self.agents, before, f"at step {self.t}")
            self._check_observations(obs, before)
            self._check_rewards(rewards, before)
            self._check_ends(terminations, truncations, before, after)
            self._check_infos(infos, before)
            self._check_masks(infos, after)
            visible = self._check_visibility(before)
            scripted = self.scripted.actions().tobytes() if self.scripted.action_spaces else b""
        except Exception as error:
            change = (
                "step() takes {agent: action} with the actions that masks and spaces allow, and returns five dicts by agent"
                " (observations, rewards, terminations, truncations, infos)"
            )
            record.fault("play", f"step {self.t} fails with {type(error).__name__}: {error}", change)
            self._fault_unable(list(self.unable))
            return False
        flags = [(np.any(terminations.get(agent)), np.any(truncations.get(agent))) for agent in before]
        # repr(), because a faulty value may be of any type, and nan would differ from itself
        numbers = [repr(rewards.get(agent)) for agent in before]
        record.trace.append((before, after, numbers, flags, visible, scripted, *self._as_bytes(obs, infos)))
        self.says_success |= any("is_success" in infos.get(agent, {}) for agent in before if agent not in after)
        if not after:
            record.lengths.append(self.t)
            record.successes.append(self.says_success)
            record.endings.append("truncated" if any(truncated for _, truncated in flags) else "terminated")
        return True

    def _as_bytes(self, obs: Mapping[str, Any], infos: Mapping[str, Any]) -> tuple:
        # Copies, because an environment may later write into the arrays that it returned
        observations = [as_bytes(obs[agent]) if agent in obs else b"" for agent in self.agents]
        told = [infos.get(agent, {}) for agent in self.agents]
        masks = [flat_mask(info["action_mask"]).tobytes() if "action_mask" in info else b"" for info in told]
        return observations, masks, [[as_bytes(info.get(key)) for key in KEYS[1:-1]] for info in told]

    def _check_agents(self, what: str, names: Any) -> bool:
        unknown = [name for name in names if name not in self.agents]
        if unknown:
            change = "name all agents that can ever appear in possible_agents, and only these elsewhere"
            self.record.fault("names", f"{what} have {unknown[0]!r} at step {self.t}, which is not in possible_agents", change)
        return not unknown

    def _check_observations(self, obs: Mapping[str, Any], acted: list[str]) -> None:
        self._check_agents("observations", obs)
        for agent in acted:
            if agent not in obs:
                change = "return one for each agent that acted, including the last one of an agent that leaves"
                self.record.fault("observations", f"none for {agent!r} at step {self.t}", change)
                continue
            if why := misfit(self.observation_spaces[agent], obs[agent]):
                change = f"return what lies in {self.observation_spaces[agent]}, or correct observation_space({agent!r})"
                self.record.fault("observations", f"that of {agent!r} at step {self.t} {why}", change)

    def _check_rewards(self, rewards: Mapping[str, Any], acted: list[str]) -> None:
        self._check_agents("rewards", rewards)
        for agent in acted:
            value = np.asarray(rewards.get(agent))
            if value.dtype.kind not in "biuf" or value.size != 1 or not np.isfinite(value).all():
                change = "return one finite number for each agent that acted"
                self.record.fault("rewards", f"that of {agent!r} at step {self.t} is {rewards.get(agent)!r}", change)
            else:
                self.record.rewards.append(float(value.item()))

    def _check_ends(
        self, terminations: Mapping[str, Any], truncations: Mapping[str, Any], before: list[str], after: list[str]
    ) -> None:
        for agent in before:
            flags = [np.asarray(part.get(agent)) for part in (terminations, truncations)]
            where = f"{agent!r} at step {self.t}"
            if not all(flag.size == 1 and flag.dtype.kind in "biu" for flag in flags):
                what = f"terminations and truncations are {[flag.tolist() for flag in flags]} for {where}"
                self.record.fault("ends", what, "return True or False for each agent")
            elif all(flags):
                change = "a termination says that nothing follows, a truncation that a limit ended the episode: choose one"
                self.record.fault("ends", f"{where} is both terminated and truncated", change)
            elif any(flags) == (agent in after):
                state = "has ended but is still in agents" if any(flags) else "left agents without termination or truncation"
                change = "remove an agent from agents in the same step that terminates or truncates it"
                self.record.fault("ends", f"{where} {state}", change)

    def _check_infos(self, infos: Mapping[str, Any], acted: list[str]) -> None:
        for agent in self.agents:
            info = infos.get(agent, {})
            self.record.other_keys |= {str(key) for key in info} - set(KEYS)
            for key in FLAGS:
                if key in info and not isinstance(info[key], bool | np.bool_):
                    what = f"infos[{agent!r}][{key!r}] at step {self.t} is {info[key]!r}"
                    self.record.fault("flags", what, "make it True or False, or leave it out")
        for agent in acted:
            info = infos.get(agent, {})
            if agent in self.unable and info.get("active", True):
                self._fault_unable([agent])
            self.record.n_actions += 1
            self.record.n_inactive += not info.get("active", True)
            self.record.life_ends += bool(info.get("life_end", False))

    def _check_masks(self, infos: Mapping[str, Any], playing: list[str]) -> None:
        record, self.masks, self.unable = self.record, {}, {}
        for agent in playing:
            where = f"{agent!r} at {'step ' + str(self.t) if self.t else 'reset'}"
            if "action_mask" not in infos.get(agent, {}):
                if agent in record.masked:
                    change = "give one at every step and at reset(), for the next action, or never"
                    record.fault("masks", f"none for {where}, though it had one before", change)
                continue
            mask, width = flat_mask(infos[agent]["action_mask"]), self.mask_widths[agent]
            if self.t and agent not in record.masked:
                change = "give one at reset() too, for the first action"
                record.fault("masks", f"the first one of {agent!r} comes at step {self.t}", change)
            record.masked.add(agent)
            if mask.size != width or not np.isin(mask, (0, 1)).all():
                change = f"give {width} flags, one for each action" if width else "leave it out: Box actions cannot be masked"
                record.fault("masks", f"that of {where} has {mask.size} entries, {mask.tolist()[:8]}", change)
            elif not np.logical_or.reduceat(mask != 0, np.cumsum([0, *mask_parts(self.action_spaces[agent])[:-1]])).all():
                # Whether it could act at all, the next step's info says
                self.unable[agent], self.masks[agent] = where, first_actions(self.action_spaces[agent])
            else:
                self.masks[agent] = mask.astype(bool)
                record.n_masked += mask.size
                record.n_possible += int(mask.sum())

    def _fault_unable(self, agents: list[str]) -> None:
        change = "allow one that does nothing, or say active=False of an agent that cannot act, as one not on turn"
        for agent in agents:
            self.record.fault("masks", f"that of {self.unable[agent]} allows no action", change)

    def _check_visibility(self, acted: list[str]) -> bytes:
        if self.visibility is None:
            return b""
        rows = self.visibility()
        n_others = len(self.agents) - 1 + len(self.scripted.action_spaces)
        change = (
            f"visibility() returns {{agent: {n_others} flags}}, the other agents in the order of possible_agents"
            + " and then the scripted others" * bool(self.scripted.action_spaces)
        )
        if not isinstance(rows, Mapping):
            self.record.fault("visibility", f"it returns a {type(rows).__name__} at step {self.t}", change)
            return b""
        sees: dict[tuple[str, str], bool] = {}
        for agent in rows:
            row = np.asarray(rows[agent]).ravel()
            if agent not in self.agents or row.size != n_others or not np.isin(row, (0, 1)).all():
                what = f"the entry for {agent!r} at step {self.t} is {row.tolist()[:8]} ({row.size})"
                self.record.fault("visibility", what, change)
                return b""
            if agent in acted:
                self.record.n_flags += row.size
                self.record.n_visible += int(row.sum())
                others = [other for other in self.agents if other != agent]
                # strict=False: the flags of scripted others come last and have no counterpart
                sees |= {(agent, other): bool(flag) for other, flag in zip(others, row, strict=False) if other in acted}
        missing = [agent for agent in acted if agent not in rows]
        if missing:
            self.record.fault("visibility", f"no entry for {missing[0]!r}, which acted at step {self.t}", change)
        pairs = [(i, j) for i, j in sees if i < j and (j, i) in sees]
        self.record.n_pairs += len(pairs)
        self.record.n_one_sided += sum(sees[pair] != sees[pair[::-1]] for pair in pairs)
        return b"".join(np.asarray(rows[agent], dtype=bool).tobytes() for agent in self.agents if agent in rows)


def misfit(space: spaces.Space, value: Any) -> str:
    """
    Return why an observation does not lie in its space. Numbers of another type are accepted if they fit.

    :param space: Observation space
    :param value: Observation
    :return: The reason as the end of a sentence, or an empty string if the observation lies in the space
    """
    if isinstance(space, spaces.Dict):
        if not (isinstance(value, Mapping) and value.keys() >= space.spaces.keys()):
            return f"is no dict with the entries {list(space.spaces)}"
        reasons = {key: misfit(part, value[key]) for key, part in space.spaces.items()}
        return next((f"has an entry {key!r} that {reason}" for key, reason in reasons.items() if reason), "")
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
