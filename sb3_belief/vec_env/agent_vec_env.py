"""
What one agent is given of a team's joint steps: its own observation, reward and done, and the actions of the others that it
could see. :class:`AgentVecEnv` is the vectorised environment that the agent's model learns in.
"""

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from itertools import pairwise
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from sb3_belief.common.action_encoding import action_encoding
from sb3_belief.vec_env.observation_forms import row_of
from sb3_belief.vec_env.team_vec_env import TeamObs, TeamStep

AgentStep = tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]


class AgentTransition(NamedTuple):
    """
    One agent's part of a joint step, as arrays.

    :param obs: Its observations after the step, ``[num_envs, ...]``: an array, or a dict of arrays for a ``Dict`` space
    :param rewards: Its own rewards, float32 ``[num_envs]``
    :param dones: Whether its own return ended or was cut off, bool ``[num_envs]``
    :param others_actions: The others' flattened actions of this step, zero where not visible, float32 ``[num_envs, W]``
    :param others_visible: Whose action of this step it could observe, bool ``[num_envs, n_others]``
    :param active: Whether it was in play when it acted, bool ``[num_envs]``
    :param ends: For each copy in which it is done: what SB3 expects in the info besides
    :param own_infos: For each copy what the environment's own info of the agent holds besides; None if nowhere anything
    """

    obs: np.ndarray
    rewards: np.ndarray
    dones: np.ndarray
    others_actions: np.ndarray
    others_visible: np.ndarray
    active: np.ndarray
    ends: dict[int, dict[str, Any]]
    own_infos: list[dict[str, Any]] | None = None

    def as_step(self) -> AgentStep:
        """
        Convert the transition to what a ``VecEnv`` returns.

        :return: Observations, rewards, dones and infos
        """
        infos: list[dict[str, Any]] = [
            {"others_actions": others, "others_visible": seen, "active": is_active}
            for others, seen, is_active in zip(self.others_actions, self.others_visible, self.active.tolist(), strict=True)
        ]
        if self.own_infos is not None:
            # Its keys are none of those above or below (own_infos.RESERVED)
            for info, own in zip(infos, self.own_infos, strict=True):
                info.update(own)
        for env_idx, end in self.ends.items():
            infos[env_idx].update(end)
        # Copies: SB3's on-policy algorithms add the bootstrapped value to the rewards in place
        return self.obs, self.rewards.copy(), self.dones.copy(), infos


class StepSource(Protocol):
    """Steps the whole team on behalf of an :class:`AgentVecEnv`; in a ``Team`` this is its scheduler."""

    num_envs: int
    observation_spaces: dict[str, spaces.Space]
    action_spaces: dict[str, spaces.Space]
    scripted_action_spaces: dict[str, spaces.Space]
    render_mode: str | None

    @property
    def masks(self) -> dict[str, np.ndarray] | None:
        """The action masks for the current observations, bool ``[num_envs, k]`` by agent; None without masks."""

    def first_observation(self, agent: str) -> np.ndarray:
        """
        Return the agent's observations of the last joint reset.

        :param agent: Name of the agent
        :return: ``[num_envs, ...]``
        """

    def exchange(self, agent: str, actions: np.ndarray) -> AgentStep:
        """
        Wait until all agents have acted, and step the team.

        :param agent: Name of the agent
        :param actions: Its actions, ``[num_envs, ...]``
        :return: Its part of the joint step
        """

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Return one image per copy, None where there cannot be one."""


class AgentVecEnv(VecEnv):
    """
    The SB3 ``VecEnv`` of one agent, with its own spaces; it steps only together with those of the other agents.

    ``infos[e]`` holds ``others_actions`` float32 ``[W]`` (the others in order, the scripted ones last: one-hot for Discrete
    and MultiDiscrete, values for Box and MultiBinary; zero where not visible), ``others_visible`` bool ``[n_others]`` and
    ``active`` bool. At a done it also holds ``terminal_observation``, ``TimeLimit.truncated``, ``terminal_action_masks`` (the
    agent's own masks after its last step, bool ``[k]``, in an environment with masks), ``truncated`` True where a limit has
    cut its return off, also while it was out of play, and at the end of the team's episode ``episode`` (with the agent's own
    return) and ``is_success``. The global state never reaches an agent. What the environment's own info of the agent holds
    besides (``infos[agent]["fuel"]``) is there under the same keys. ``get_attr("others_action_spaces")`` returns the spaces of
    the others, and ``env_method("action_masks")`` the agent's own masks where the environment has masks.

    :param source: Steps the team
    :param agent: Name of the agent
    """

    def __init__(self, source: StepSource, agent: str):
        self.agent = agent
        self._source = source
        self._actions = np.zeros(0)
        others = {other: space for other, space in source.action_spaces.items() if other != agent}
        # Copies: a space has a random generator, which is its owner's
        self._others_action_spaces = deepcopy({**others, **source.scripted_action_spaces})
        super().__init__(source.num_envs, source.observation_spaces[agent], source.action_spaces[agent])

    def reset(self) -> np.ndarray:
        """
        Return the agent's part of the joint reset at the beginning of ``Team.learn``.

        :return: Observations, ``[num_envs, ...]``
        :raises RuntimeError: If called outside of ``Team.learn``, or while episodes are under way
        """
        return self._source.first_observation(self.agent)

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> AgentStep:
        """
        Wait for the other agents' actions and step.

        :return: Observations, rewards, dones and infos of the agent
        :raises RuntimeError: If called outside of ``Team.learn``
        """
        return self._source.exchange(self.agent, self._actions)

    def step(self, actions: np.ndarray) -> AgentStep:
        """
        Act, wait for the other agents' actions and step.

        :param actions: ``[num_envs, ...]``
        :return: Observations, rewards, dones and infos of the agent
        :raises RuntimeError: If called outside of ``Team.learn``
        """
        return self._source.exchange(self.agent, actions)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        # The Team seeds the joint environment once; otherwise each model would seed it again
        return [None] * self.num_envs

    def close(self) -> None:
        """Do nothing: the joint environment is closed by whoever made it."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        known: dict[str, Any] = {
            "render_mode": self._source.render_mode,
            "others_action_spaces": dict(self._others_action_spaces),
        }
        masks = self._source.masks
        if masks is not None and self.agent in masks:
            known["action_masks"] = masks[self.agent]
        if attr_name not in known:
            # Nothing else of the environment reaches an agent
            raise AttributeError(f"The environment of {self.agent!r} has the attributes {list(known)}, not {attr_name!r}.")
        return [known[attr_name] for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        raise AttributeError(f"{attr_name!r} cannot be set through {self.agent!r}: set it on the team's environment.")

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        masks = self._source.masks
        if method_name != "action_masks" or masks is None or self.agent not in masks:
            raise AttributeError(
                f"{method_name!r} cannot be called through {self.agent!r}"
                + (": the environment gives no action masks." if method_name == "action_masks" else ".")
            )
        return [masks[self.agent][env_idx] for env_idx in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        # The infos hold episode returns, as those of a Monitor do
        return [issubclass(wrapper_class, Monitor) for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[np.ndarray | None]:
        return self._source.get_images()


class TransitionSplitter:
    """
    Splits joint steps into the agents' own, with flat arrays for all agents at once.

    :param possible_agents: Names of the agents in order
    :param action_spaces: Action space of each agent
    :param scripted_action_spaces: Action space of each scripted other, in order
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
        # All actions lie in one row of W_all columns, encoded as by gymnasium.spaces.flatten; column c belongs to owner[c]
        names = [*self._agents, *self._scripted]
        all_spaces = [action_spaces[agent] for agent in self._agents] + list(scripted_action_spaces.values())
        encodings = [action_encoding(name, space) for name, space in zip(names, all_spaces, strict=True)]
        widths = [encoding.width for encoding in encodings]
        starts = np.concatenate([[0], np.cumsum(widths)])
        self._width = int(starts[-1])
        self._scripted_columns = slice(int(starts[n_agents]), self._width)
        owner = np.repeat(np.arange(len(widths)), widths)
        self._numbers: dict[str, slice] = {}
        self._discrete: list[str] = []
        offsets: list[np.ndarray] = []
        for agent, encoding, (start, stop) in zip(self._agents, encodings, pairwise(starts), strict=False):
            if encoding.kind == "categorical":
                self._discrete.append(agent)
                offsets.append(start + np.concatenate([[0], np.cumsum(encoding.widths)[:-1]]))
            else:
                self._numbers[agent] = slice(start, stop)
        # The first column of the one-hot code of each discrete component
        self._offsets = np.concatenate(offsets).astype(int) if offsets else np.zeros(0, dtype=int)
        # Of these columns agent i gets those of the others: (viewer, column) pairs, agent after agent
        pairs = [(i, column) for i in range(n_agents) for column in range(self._width) if owner[column] != i]
        viewers = np.array([i for i, _ in pairs], dtype=int)
        self._sources = np.array([column for _, column in pairs], dtype=int)
        # visible[i] has no column for agent i itself, so the columns of all agents after it shift by one
        owners = owner[self._sources] if pairs else np.zeros(0, dtype=int)
        seen_rows = owners - (owners > viewers)
        # Indices into visible[i, j], flattened
        self._seen = viewers * self._n_others + seen_rows
        bounds = np.concatenate([[0], np.cumsum([self._width - width for width in widths[:n_agents]])])
        self._others = [slice(start, stop) for start, stop in pairwise(bounds)]

    def split(self, actions: TeamObs, step: TeamStep) -> list[AgentStep]:
        """
        Split a joint step into what each agent's ``VecEnv`` returns.

        :param actions: As for :meth:`transitions`
        :param step: As for :meth:`transitions`
        :return: Each agent's step, in order
        """
        return [transition.as_step() for transition in self.transitions(actions, step)]

    def transitions(
        self, actions: TeamObs, step: TeamStep, masks: Callable[[], Mapping[str, np.ndarray] | None] | None = None
    ) -> list[AgentTransition]:
        """
        Split a joint step into each agent's part.

        :param actions: The actions that led to the step, ``[num_envs, ...]`` by agent
        :param step: What ``TeamVecEnv.step`` returned for them
        :param masks: Returns the masks for the present observations, bool ``[num_envs, k]`` by agent; None without masks
        :return: Each agent's part, in order
        :raises ValueError: If the infos lack visibility or scripted actions, or hold them in another shape
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
        # Where only an agent's own return ends nothing is reset, so the present masks are those after its last step
        present = masks() if masks is not None and any_done and not team_dones.all() else None
        by_agent = [info["agent_infos"] if "agent_infos" in info else {} for info in infos]
        any_own = any(by_agent)

        transitions: list[AgentTransition] = []
        for i, agent in enumerate(self._agents):
            ends = {
                int(env_idx): self._end(
                    i,
                    int(env_idx),
                    row_of(obs[agent], int(env_idx)),
                    bool(cut[env_idx, i]),
                    infos[env_idx],
                    None if team_dones[env_idx] else present,
                )
                for env_idx in (np.flatnonzero(dones[:, i]) if any_done else ())
            }
            others = seen_actions[:, self._others[i]]
            own = [each.get(agent, {}) for each in by_agent] if any_own else None
            transitions.append(
                AgentTransition(obs[agent], rewards[:, i], dones[:, i], others, visible[:, i], active[:, i], ends, own)
            )
        return transitions

    def _end(
        self, i: int, env_idx: int, obs: Any, cut: bool, info: dict[str, Any], masks: Mapping[str, np.ndarray] | None
    ) -> dict[str, Any]:
        """Return what SB3 expects in the info of a done. Where only the agent's own return has ended, nothing is reset."""
        end = {"terminal_observation": info.get("terminal_observation", {}).get(self._agents[i], obs)}
        end["TimeLimit.truncated"] = cut
        if info["truncated"][i]:
            end["truncated"] = True
        if self._agents[i] in info.get("terminal_action_masks", ()):
            end["terminal_action_masks"] = info["terminal_action_masks"][self._agents[i]]
        elif masks is not None and self._agents[i] in masks:
            end["terminal_action_masks"] = masks[self._agents[i]][env_idx]
        if "episode" in info:
            end["episode"] = {**info["episode"], "r": float(info["agent_episode_rewards"][i])}
            if "is_success" in info:
                end["is_success"] = info["is_success"]
        return end

    def _rows(self, key: str, shape: tuple[int, ...], infos: list[dict[str, Any]]) -> np.ndarray:
        """Stack what all infos have under ``key`` to ``[num_envs, *shape]``."""
        try:
            return np.concatenate([info[key] for info in infos], axis=None).reshape(len(infos), *shape)
        except (KeyError, ValueError):
            raise ValueError(
                f"Each info of a TeamVecEnv with the agents {self._agents} and the scripted others {self._scripted} must have"
                f" {key!r} of shape {shape}, got {[np.shape(info[key]) if key in info else None for info in infos]}."
            ) from None

    def _seen_actions(self, actions: TeamObs, visible: np.ndarray, infos: list[dict[str, Any]]) -> np.ndarray:
        """Return what each agent gets of the others' actions, side by side, float32 ``[num_envs, sum of all W]``."""
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
        # Not a product: the NaN of an invisible action must not come through
        return np.where(seen, flat.take(self._sources, axis=1), np.float32(0.0))
