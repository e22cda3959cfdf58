"""One PettingZoo ``ParallelEnv`` as one Gymnasium environment, so that SB3's own vectorisers can hold copies of it."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from sb3_belief.vec_env.scripted_others import ScriptedOthers, optional_member
from sb3_belief.vec_env.validation import check_names, check_observation, check_wrappers, place

Flags: TypeAlias = tuple[np.ndarray, np.ndarray, np.ndarray]
# Who could observe whose action of the last step: {agent: bool [n_others]}
Visibility: TypeAlias = Callable[[ParallelEnv], Mapping[str, np.ndarray]]


class StepRecord(NamedTuple):
    """
    What there is to say about a joint step besides observations and team reward.

    :param agent_rewards: of the n agents
    :param flags: active, life_end and truncated, bool [n] each
    :param visible: bool [n, n-1+n_scripted]
    :param action_masks: the masks of all agents for their next actions one after the other (True where an agent has none);
        None if the environment gives none
    :param scripted_actions: what the scripted others did, flattened, float32 [W_scripted]; None if there are none
    """

    agent_rewards: list[float]
    flags: Flags
    visible: np.ndarray
    action_masks: np.ndarray | None
    scripted_actions: np.ndarray | None


class JointEnv(gym.Env):
    """
    A whole team as one Gymnasium environment: observations and actions are dictionaries by agent, the reward is the team's.

    An agent that leaves ``agents`` before the others is inactive from then on: its observation is zero, its actions go
    nowhere, its reward is what the environment still reports for it (else 0). The episode goes on until all have left.
    The info of a step has a ``StepRecord`` as ``joint``, of which ``ParallelTeamVecEnv`` makes the infos of a ``TeamVecEnv``.

    :param env: the environment, see the README for what it may offer beyond PettingZoo's interface
    :param visibility: says whose actions agents could observe in the place of an environment that does not, see
        ``make_team_env``
    :param copy: number of this copy, for messages
    :raises TypeError: if it is not a ``ParallelEnv``, or is wrong about its scripted others
    :raises ValueError: for SuperSuit's black_death, and for ``visibility`` if the environment has a method ``visibility()``
        itself
    """

    def __init__(self, env: ParallelEnv, visibility: Visibility | None = None, copy: int = 0):
        if not isinstance(env, ParallelEnv):
            raise TypeError(
                f"A team needs a pettingzoo.ParallelEnv, got {type(env).__name__}. An AEC environment is converted by"
                " sb3_belief.envs.to_parallel(); a Gymnasium environment has no team."
            )
        check_wrappers(env)
        self.env = env
        self.possible_agents: list[str] = list(env.possible_agents)
        self.observation_spaces = {agent: env.observation_space(agent) for agent in self.possible_agents}
        self.action_spaces = {agent: env.action_space(agent) for agent in self.possible_agents}
        self.observation_space = spaces.Dict(self.observation_spaces)
        self.action_space = spaces.Dict(self.action_spaces)
        self.render_mode = getattr(env, "render_mode", None)
        self.metadata = getattr(env, "metadata", {})

        self._scripted = ScriptedOthers(env)
        self.scripted_action_spaces = self._scripted.action_spaces

        agents, n_scripted = range(len(self.possible_agents)), len(self.scripted_action_spaces)
        # The scripted ones come after the agents, for every viewer
        everybody = range(len(agents) + n_scripted)
        self._others = np.array([[j for j in everybody if j != i] for i in agents], dtype=int).reshape(len(agents), -1)
        self._scripted_in_play = np.ones(n_scripted, dtype=bool)
        self._mask_widths = {agent: mask_width(self.action_spaces[agent]) for agent in self.possible_agents}
        # Shared by the records of all steps at which nothing happens
        self._uneventful = _no_flags(len(agents))
        self._uneventful[0][:] = True
        self._all_visible = np.ones(self._others.shape, dtype=bool)
        for shared in (*self._uneventful, self._all_visible):
            shared.flags.writeable = False
        self._visibility = optional_member(env, "visibility")
        if visibility is not None:
            if self._visibility is not None:
                raise ValueError(
                    f"{type(env.unwrapped).__name__} says by its own visibility() who can observe whom, so the argument"
                    " visibility is not for it: leave it out, or override the method in a wrapper."
                )
            self._visibility = partial(visibility, env)
        self._team_reward = optional_member(env, "team_reward")
        self._zero_obs = {
            agent: np.zeros(space.shape or (), dtype=space.dtype) for agent, space in self.observation_spaces.items()
        }
        self._has_masks = False
        # For the checks: quick to compare with
        self._names = dict.fromkeys(self.possible_agents).keys()
        self._shapes = [(agent, space.shape) for agent, space in self.observation_spaces.items() if space.shape]
        self._copy, self._t = copy, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, np.ndarray], dict]:
        """
        :param seed: seed of the environment, None: go on with its generator
        :param options: handed to the environment
        :return: {agent: observation} and {"action_masks": as in StepRecord} or {}
        :raises ValueError: if the environment returns what does not fit its agents and spaces
        """
        obs, infos = self.env.reset(seed=seed, options=options)
        self._t = 0
        if obs.keys() != self._names or self.env.agents != self.possible_agents:
            check_names(self.possible_agents, self.env.agents, self.env.agents, {"observations": obs}, place(self._copy, 0))
        self._check_observations(obs, self.possible_agents)
        return self._observations(obs), self._masks(infos)

    def step(self, action: dict[str, Any]) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """
        :param action: {agent: action} with an entry for every possible agent; those of agents that have left are ignored
        :return: {agent: observation}, team reward, terminated, truncated, {"joint": StepRecord}; observations are the
            environment's own arrays
        :raises ValueError: if the environment returns what does not fit its agents and spaces
        """
        before = self.env.agents[:]
        self._t += 1
        obs, rewards, terminations, truncations, infos = self.env.step({agent: action[agent] for agent in before})
        after = self.env.agents
        agents = self.possible_agents
        if obs.keys() != self._names or rewards.keys() != self._names or after != agents:
            check_names(agents, before, after, {"observations": obs, "rewards": rewards}, place(self._copy, self._t))
        for agent, shape in self._shapes:
            if agent in obs and getattr(obs[agent], "shape", None) != shape:
                self._check_observations(obs, [agent])
        told = any(infos.values())
        left: list[str] = []
        successes: list[bool] = []
        if len(after) < len(agents) or told or True in terminations.values() or True in truncations.values():
            flags, ended = self._events(before, after, terminations, truncations, infos, left, successes)
        else:
            # Nearly all steps of nearly all environments: nothing happened to anybody
            flags, ended = self._uneventful, False
        done = ended or not after

        agent_rewards = [rewards.get(agent, 0.0) for agent in agents]
        team_reward = sum(agent_rewards) / len(agents) if self._team_reward is None else self._team_reward(rewards)
        visible = self._all_visible if flags is self._uneventful and self._visibility is None else self._visible(flags)
        masks = self._masks(infos).get("action_masks") if told or self._has_masks else None
        scripted_actions = self._scripted.actions() if self.scripted_action_spaces else None
        info: dict[str, Any] = {"joint": StepRecord(agent_rewards, flags, visible, masks, scripted_actions)}
        if flags is self._uneventful:
            return obs, float(team_reward), False, False, info
        if done or left:
            # What a value at a time limit is computed from
            self._check_observations(obs, agents if done else left)
        observations = self._observations(obs)
        if done:
            if successes:
                info["is_success"] = all(successes)
        elif left:
            # Their last observation is not the zero one that they have from now on
            info["terminal_observation"] = {agent: np.array(observations[agent]) for agent in left}
            observations.update({agent: self._zero_obs[agent] for agent in left})
        cut = done and bool(flags[2].any())
        return observations, float(team_reward), done and not cut, cut, info

    def _events(
        self,
        before: list[str],
        after: list[str],
        terminations: dict[str, bool],
        truncations: dict[str, bool],
        infos: dict[str, dict[str, Any]],
        left: list[str],
        successes: list[bool],
    ) -> tuple[Flags, bool]:
        """
        Fill ``left`` with who leaves at this step, and ``successes`` with what agents say of theirs.

        :return: the flags of the step's record, and whether all who were in play have come to an end
        """
        active, life_end, truncated = flags = _no_flags(len(self.possible_agents))
        ended = True
        for i, agent in enumerate(self.possible_agents):
            if agent not in before:
                continue
            agent_info = infos.get(agent, {})
            terminates, truncates = terminations.get(agent, False), truncations.get(agent, False)
            has_left = agent not in after
            # Who is gone without a reason given has ended its life: there is nothing to bootstrap from
            life_end[i] = terminates or agent_info.get("life_end", False) or (has_left and not truncates)
            active[i] = agent_info.get("active", True)
            truncated[i] = truncates and not life_end[i]
            if has_left:
                left.append(agent)
            ended = ended and (terminates or truncates)
            if "is_success" in agent_info:
                successes.append(bool(agent_info["is_success"]))
        return flags, ended

    def render(self) -> Any:
        """
        :return: what the environment's own ``render()`` returns
        """
        return self.env.render()

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def set_env_attr(self, name: str, value: Any) -> None:
        """
        :param name: attribute of the ``ParallelEnv`` to set (SB3's vectorisers would set it on this wrapper)
        :param value: its new value
        """
        setattr(self.env, name, value)

    def __getattr__(self, name: str) -> Any:
        # For get_attr() and env_method() of the vectorisers; private names are left alone so that pickle and copy work
        if name.startswith("_") or name == "env":
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        return getattr(self.env, name)

    def _observations(self, obs: dict[str, Any]) -> dict[str, np.ndarray]:
        return {
            agent: np.asarray(obs[agent], dtype=zero.dtype) if agent in obs else zero for agent, zero in self._zero_obs.items()
        }

    def _check_observations(self, obs: dict[str, Any], agents: list[str]) -> None:
        where = place(self._copy, self._t)
        for agent in agents:
            if agent in obs:
                check_observation(agent, obs[agent], self.observation_spaces[agent], where)

    def _visible(self, flags: Flags) -> np.ndarray:
        # Who is not in play neither sees nor shows anything
        active = flags[0]
        if self.scripted_action_spaces:
            # An environment tells by its visibility() when they do not show themselves
            in_play = np.concatenate([active, self._scripted_in_play])[self._others] & active[:, None]
        else:
            in_play = active[self._others] & active[:, None]
        if self._visibility is None:
            return in_play
        rows = self._visibility()
        unseen = np.zeros(self._others.shape[1], dtype=bool)
        try:
            if rows.keys() <= self._names:
                given = [rows.get(agent, unseen) for agent in self.possible_agents]
                return np.array(given, dtype=bool).reshape(in_play.shape) & in_play
        except (AttributeError, ValueError):
            pass
        raise self._wrong_visibility(rows)

    def _wrong_visibility(self, rows: Any) -> ValueError:
        n_others, where = self._others.shape[1], place(self._copy, self._t)
        scripted = f" and then the scripted others {list(self.scripted_action_spaces)}" if self.scripted_action_spaces else ""
        wanted = (
            f"It must return a dict with {n_others} flags for each agent, the other agents in the order of possible_agents"
            f"{scripted}; the agents are {self.possible_agents}."
        )
        if not isinstance(rows, Mapping):
            return ValueError(f"visibility() returned a {type(rows).__name__} {where}. {wanted}")
        for agent, row in rows.items():
            if agent not in self._names:
                return ValueError(f"visibility() has an entry for {agent!r} {where}, which is no agent. {wanted}")
            if np.size(row) != n_others:
                return ValueError(f"visibility() has {np.size(row)} flags for {agent!r} {where}. {wanted}")
        return ValueError(f"visibility() returned what cannot be read as flags {where}: {dict(rows)}. {wanted}")

    def _masks(self, infos: dict[str, dict[str, Any]]) -> dict[str, np.ndarray]:
        self._has_masks = self._has_masks or any("action_mask" in info for info in infos.values())
        if not self._has_masks:
            return {}
        masks = []
        for agent in self.possible_agents:
            width = self._mask_widths[agent]
            mask = np.asarray(infos.get(agent, {}).get("action_mask", np.ones(width)), dtype=bool).ravel()
            if width and mask.size != width:
                raise ValueError(
                    f"The action mask of {agent!r} {place(self._copy, self._t)} must have {width} entries, one for each"
                    f" action, got {mask.size}."
                )
            masks.append(mask[:width])
        return {"action_masks": np.concatenate(masks)}


def step_and_reset(
    env: JointEnv, action: dict[str, Any]
) -> tuple[dict[str, np.ndarray], float, bool, StepRecord, np.ndarray | None, dict[str, Any]]:
    """
    :param env: a copy
    :param action: by agent
    :return: observations, reward, whether an episode has ended, what there is to say about the step, the masks for the next
        actions, and what else the infos hold; the observations and masks are the new episode's where one has ended
    """
    obs, reward, terminated, truncated, info = env.step(action)
    record: StepRecord = info.pop("joint")
    masks, done = record.action_masks, terminated or truncated
    if done:
        info["TimeLimit.truncated"] = truncated and not terminated
        # The environment may use its arrays again
        info["terminal_observation"] = {agent: np.array(part) for agent, part in obs.items()}
        obs, reset_info = env.reset()
        masks = reset_info.get("action_masks")
    return obs, reward, done, record, masks, info


def _no_flags(n_agents: int) -> Flags:
    return np.zeros(n_agents, dtype=bool), np.zeros(n_agents, dtype=bool), np.zeros(n_agents, dtype=bool)


def mask_width(space: spaces.Space) -> int:
    """
    :param space: an action space
    :return: number of entries of its action mask as sb3-contrib's MaskablePPO expects it (0: cannot be masked)
    """
    if isinstance(space, spaces.Discrete):
        return int(space.n)
    if isinstance(space, spaces.MultiDiscrete):
        return int(space.nvec.sum())
    if isinstance(space, spaces.MultiBinary):
        return 2 * int(np.prod(space.n))
    return 0
