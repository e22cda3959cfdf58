"""What each agent is given of a joint step: its own observation, reward and done, and others' actions that it could see."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from sb3_belief.vec_env.team_vec_env import TeamObs, TeamStep

AgentStep = tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]


class AgentTransition(NamedTuple):
    """
    What an agent is given of a joint step, as arrays.

    :param obs: ``[num_envs, ...]``
    :param rewards: float32 ``[num_envs]``
    :param dones: bool ``[num_envs]``
    :param others_actions: float32 ``[num_envs, W]``, zero where not visible
    :param others_visible: bool ``[num_envs, n_others]``
    :param active: bool ``[num_envs]``
    :param ends: {copy in which it is done: what its info says besides}
    """

    obs: np.ndarray
    rewards: np.ndarray
    dones: np.ndarray
    others_actions: np.ndarray
    others_visible: np.ndarray
    active: np.ndarray
    ends: dict[int, dict[str, Any]]

    def as_step(self) -> AgentStep:
        """
        :return: observations, rewards, dones and infos, as a ``VecEnv`` returns them
        """
        infos: list[dict[str, Any]] = [
            {"others_actions": others, "others_visible": seen, "active": is_active}
            for others, seen, is_active in zip(self.others_actions, self.others_visible, self.active.tolist(), strict=True)
        ]
        for env_idx, end in self.ends.items():
            infos[env_idx].update(end)
        # Copies: SB3's on-policy algorithms add the bootstrapped value to the rewards in place
        return self.obs, self.rewards.copy(), self.dones.copy(), infos


def _component_sizes(space: spaces.Space) -> np.ndarray | None:
    """
    :return: number of values of each discrete component of an action, None if actions are numbers to be taken as they are
    """
    if isinstance(space, spaces.Discrete):
        return np.array([space.n])
    if isinstance(space, spaces.MultiDiscrete):
        return space.nvec.ravel()
    return None


class TransitionSplitter:
    """
    Splits joint steps into the steps of the agents, for all of them at once with flat arrays.

    :param possible_agents: names of the agents in order
    :param action_spaces: their action spaces
    :param scripted_action_spaces: those of the scripted others, in order
    """

    def __init__(
        self,
        possible_agents: Sequence[str],
        action_spaces: dict[str, spaces.Space],
        scripted_action_spaces: Mapping[str, spaces.Space] = MappingProxyType({}),
    ):
        self._agents, self._scripted = list(possible_agents), list(scripted_action_spaces)
        n_agents = len(self._agents)
        self._n_others = n_agents - 1 + len(self._scripted)
        # All actions stand in one row of W_all columns, coded as gymnasium.spaces.flatten does it; column c is owner[c]'s
        all_spaces = [action_spaces[agent] for agent in self._agents] + list(scripted_action_spaces.values())
        widths = [int(spaces.flatdim(space)) for space in all_spaces]
        starts = np.concatenate([[0], np.cumsum(widths)])
        self._width = int(starts[-1])
        self._scripted_columns = slice(int(starts[n_agents]), self._width)
        owner = np.repeat(np.arange(len(widths)), widths)
        self._numbers: dict[str, slice] = {}
        self._discrete: list[str] = []
        offsets: list[np.ndarray] = []
        for agent, (start, stop) in zip(self._agents, pairwise(starts[: n_agents + 1]), strict=True):
            sizes = _component_sizes(action_spaces[agent])
            if sizes is None:
                self._numbers[agent] = slice(start, stop)
            else:
                self._discrete.append(agent)
                offsets.append(start + np.concatenate([[0], np.cumsum(sizes)[:-1]]))
        # Where the one-hot code of each discrete component starts
        self._offsets = np.concatenate(offsets).astype(int) if offsets else np.zeros(0, dtype=int)
        # Agent i is given, of those columns, the others': (viewer, column) pairs of all agents one after the other
        pairs = [(i, column) for i in range(n_agents) for column in range(self._width) if owner[column] != i]
        viewers = np.array([i for i, _ in pairs], dtype=int)
        self._sources = np.array([column for _, column in pairs], dtype=int)
        # visible[i] has a column for each of the others, so the owner's number shifts by one behind the viewer itself
        owners = owner[self._sources] if pairs else np.zeros(0, dtype=int)
        seen_rows = owners - (owners > viewers)
        # Places in visible[i, j], laid out flat
        self._seen = viewers * self._n_others + seen_rows
        bounds = np.concatenate([[0], np.cumsum([self._width - width for width in widths[:n_agents]])])
        self._others = [slice(start, stop) for start, stop in pairwise(bounds)]

    def split(self, actions: TeamObs, step: TeamStep) -> list[AgentStep]:
        """
        :param actions: as for ``parts``
        :param step: as for ``parts``
        :return: each agent's step
        """
        return [part.as_step() for part in self.parts(actions, step)]

    def parts(self, actions: TeamObs, step: TeamStep) -> list[AgentTransition]:
        """
        :param actions: {agent: array [num_envs, ...]} that led to the step
        :param step: what ``TeamVecEnv.step`` returned for them
        :return: each agent's part
        :raises ValueError: if the infos say too little or too much of who saw whom, or of the scripted others
        """
        obs, _, team_dones, infos = step
        n_envs, n_agents = len(infos), len(self._agents)
        # concatenate() takes a third of the time of array()
        rewards = np.concatenate([info["agent_rewards"] for info in infos]).astype(np.float32).reshape(n_envs, n_agents)
        visible = self._rows("visible", (n_agents, self._n_others), infos)
        active = np.concatenate([info["active"] for info in infos]).reshape(n_envs, n_agents)
        life_end = np.concatenate([info["life_end"] for info in infos]).reshape(n_envs, n_agents)
        truncated = np.concatenate([info["truncated"] for info in infos]).reshape(n_envs, n_agents)
        dones = team_dones[:, None] | life_end | truncated
        # The value of an inactive slot is never trained, so it must not be bootstrapped from either
        cut = truncated & ~life_end & active
        seen_actions = self._seen_actions(actions, visible, infos)
        any_done = bool(dones.any())

        parts: list[AgentTransition] = []
        for i, agent in enumerate(self._agents):
            ends = {
                int(env_idx): self._end(i, obs[agent][env_idx], bool(cut[env_idx, i]), infos[env_idx])
                for env_idx in (np.flatnonzero(dones[:, i]) if any_done else ())
            }
            others = seen_actions[:, self._others[i]]
            parts.append(AgentTransition(obs[agent], rewards[:, i], dones[:, i], others, visible[:, i], active[:, i], ends))
        return parts

    def _end(self, i: int, obs: np.ndarray, cut: bool, info: dict[str, Any]) -> dict[str, Any]:
        """What SB3 expects in an info at a done; an agent whose own return ends before the team's has no reset between."""
        end = {"terminal_observation": info.get("terminal_observation", {}).get(self._agents[i], obs)}
        end["TimeLimit.truncated"] = cut
        if "episode" in info:
            end["episode"] = {**info["episode"], "r": float(info["agent_episode_rewards"][i])}
            if "is_success" in info:
                end["is_success"] = info["is_success"]
        return end

    def _rows(self, key: str, shape: tuple[int, ...], infos: list[dict[str, Any]]) -> np.ndarray:
        """
        :return: array [num_envs, *shape] of what all infos have under ``key``
        """
        try:
            return np.concatenate([info[key] for info in infos], axis=None).reshape(len(infos), *shape)
        except (KeyError, ValueError):
            raise ValueError(
                f"Each info of a TeamVecEnv with the agents {self._agents} and the scripted others {self._scripted} must have"
                f" {key!r} of shape {shape}, got {[np.shape(info[key]) if key in info else None for info in infos]}."
            ) from None

    def _seen_actions(self, actions: TeamObs, visible: np.ndarray, infos: list[dict[str, Any]]) -> np.ndarray:
        """
        :return: float32 [num_envs, sum over agents of W]: what each is given of the others' actions
        """
        n_envs = len(visible)
        flat = np.zeros((n_envs, self._width), dtype=np.float32)
        if self._discrete:
            chosen = np.concatenate([actions[agent].reshape(n_envs, -1) for agent in self._discrete], axis=1)
            flat[np.arange(n_envs)[:, None], chosen.astype(int) + self._offsets] = 1.0
        for agent, columns in self._numbers.items():
            flat[:, columns] = actions[agent].reshape(n_envs, -1)
        if self._scripted:
            columns = self._scripted_columns
            flat[:, columns] = self._rows("scripted_actions", (columns.stop - columns.start,), infos)
        seen = visible.reshape(n_envs, -1).take(self._seen, axis=1)
        # where() and not a product: an invisible action that is not a number must not come through as one
        return np.where(seen, flat.take(self._sources, axis=1), np.float32(0.0))
