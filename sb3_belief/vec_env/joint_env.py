"""A PettingZoo ``ParallelEnv`` as a single Gymnasium environment, so that SB3's own vectorisers can hold copies of it."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from sb3_belief.vec_env.scripted_others import ScriptedOthers, optional_member
from sb3_belief.vec_env.validation import check_names, check_observation, check_wrappers, place

# Says whose action of the last step each agent could observe: bool [n_others] by agent
Visibility: TypeAlias = Callable[[ParallelEnv], Mapping[str, np.ndarray]]


class Flags(NamedTuple):
    """
    What a joint step meant for each agent.

    :param active: Whether it was in play when it acted, bool ``[n]``
    :param life_end: Whether its own return ended (it terminated, or its life ended), bool ``[n]``
    :param truncated: Whether its own return was cut off by a limit, bool ``[n]``; never together with ``life_end``
    """

    active: np.ndarray
    life_end: np.ndarray
    truncated: np.ndarray


class StepRecord(NamedTuple):
    """
    The results of a joint step other than observations and team reward.

    :param agent_rewards: Own rewards of the n agents
    :param flags: What the step meant for each agent
    :param visible: Whose action of this step each agent could observe, bool ``[n, n-1+n_scripted]``
    :param action_masks: Masks of all agents for their next actions, side by side in one row (True for an agent that has none);
        None if the environment has no masks
    :param scripted_actions: Flattened actions of the scripted others, float32 ``[W_scripted]``; None if there are none
    """

    agent_rewards: list[float]
    flags: Flags
    visible: np.ndarray
    action_masks: np.ndarray | None
    scripted_actions: np.ndarray | None


class _Events(NamedTuple):
    """
    What happened to the agents in a joint step.

    :param flags: What the step meant for each agent
    :param ended: Whether all agents that were in play have terminated or been truncated
    :param left: Agents that left in this step
    :param successes: The ``is_success`` of the agents that reported one
    """

    flags: Flags
    ended: bool
    left: list[str]
    successes: list[bool]


class JointEnv(gym.Env):
    """
    Gymnasium environment of a whole team: observations and actions are dictionaries by agent, the reward is the team's.

    An agent that leaves ``agents`` before the others is inactive from then on: its observation is zero, its actions are
    ignored, and its reward is what the environment still reports for it (0 if nothing). The episode continues until all agents
    have left. The info of a step holds a ``StepRecord`` under ``joint``; ``ParallelTeamVecEnv`` turns it into the infos of a
    ``TeamVecEnv``.

    :param env: The environment; the page "What an agent sees" says what it may offer beyond PettingZoo's interface
    :param visibility: Says whose actions agents could observe, for an environment that does not say so itself; see
        ``make_team_env``
    :param copy: Number of this copy, used in error messages
    :raises TypeError: If ``env`` is not a ``ParallelEnv``, or declares its scripted others wrongly
    :raises ValueError: For SuperSuit's black_death, or if ``visibility`` is given although the environment has a method
        ``visibility()`` of its own
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
        # Row i lists the others of agent i: the other agents in order, then the scripted others
        everyone = range(len(agents) + n_scripted)
        self._others = np.array([[j for j in everyone if j != i] for i in agents], dtype=int).reshape(len(agents), -1)
        self._scripted_in_play = np.ones(n_scripted, dtype=bool)
        self._mask_widths = {agent: mask_width(self.action_spaces[agent]) for agent in self.possible_agents}
        # The records of all uneventful steps share these arrays, so they are read-only
        self._uneventful = _Events(_no_flags(len(agents)), ended=False, left=[], successes=[])
        self._uneventful.flags.active[:] = True
        self._all_visible = np.ones(self._others.shape, dtype=bool)
        for shared in (*self._uneventful.flags, self._all_visible):
            shared.flags.writeable = False
        self._visibility = optional_member(env, "visibility")
        if visibility is not None:
            if self._visibility is not None:
                raise ValueError(
                    f"{type(env.unwrapped).__name__} says by its own visibility() who can observe whom, so it does not take"
                    " the argument visibility: leave it out, or override the method in a wrapper."
                )
            self._visibility = partial(visibility, env)
        self._team_reward = optional_member(env, "team_reward")
        self._zero_obs = {
            agent: np.zeros(space.shape or (), dtype=space.dtype) for agent, space in self.observation_spaces.items()
        }
        # Set at the first info that holds an action mask
        self._has_masks = False
        # Names and shapes in a form that each step's check can compare with quickly
        self._names = dict.fromkeys(self.possible_agents).keys()
        self._shapes = [(agent, space.shape) for agent, space in self.observation_spaces.items() if space.shape]
        self._copy, self._t = copy, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, np.ndarray], dict]:
        """
        Reset the environment.

        :param seed: Seed of the environment; None continues with its generator as it is
        :param options: Passed on to the environment
        :return: Observations by agent, and an info with ``action_masks`` as in ``StepRecord``, empty without masks
        :raises ValueError: If what the environment returns does not fit its agents and spaces
        """
        obs, infos = self.env.reset(seed=seed, options=options)
        self._t = 0
        if obs.keys() != self._names or self.env.agents != self.possible_agents:
            check_names(self.possible_agents, self.env.agents, self.env.agents, {"observations": obs}, place(self._copy, 0))
        self._check_observations(obs, self.possible_agents)
        return self._observations(obs), self._masks(infos)

    def step(self, action: dict[str, Any]) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """
        Step the environment.

        :param action: Actions by agent, one for every possible agent; those of agents that have left are ignored
        :return: Observations by agent (the environment's own arrays), team reward, whether the episode terminated, whether it
            was truncated, and an info with the ``StepRecord`` under ``joint``
        :raises ValueError: If what the environment returns does not fit its agents and spaces
        """
        before = self.env.agents[:]
        self._t += 1
        obs, rewards, terminations, truncations, infos = self.env.step({agent: action[agent] for agent in before})
        after = self.env.agents
        agents = self.possible_agents
        # Here and below, a cheap comparison decides whether the check that finds the cause has to run
        if obs.keys() != self._names or rewards.keys() != self._names or after != agents:
            check_names(agents, before, after, {"observations": obs, "rewards": rewards}, place(self._copy, self._t))
        for agent, shape in self._shapes:
            if agent in obs and getattr(obs[agent], "shape", None) != shape:
                self._check_observations(obs, [agent])
        any_info = any(infos.values())
        # In nearly all steps of nearly all environments nothing happens to any agent, and the loop over agents is saved
        events = self._uneventful
        if len(after) < len(agents) or any_info or True in terminations.values() or True in truncations.values():
            events = self._events(before, after, terminations, truncations, infos)
        flags, left = events.flags, events.left
        done = events.ended or not after

        agent_rewards = [rewards.get(agent, 0.0) for agent in agents]
        team_reward = sum(agent_rewards) / len(agents) if self._team_reward is None else self._team_reward(rewards)
        uneventful = events is self._uneventful
        visible = self._all_visible if uneventful and self._visibility is None else self._visible(flags.active)
        masks = self._masks(infos).get("action_masks") if any_info or self._has_masks else None
        scripted_actions = self._scripted.actions() if self.scripted_action_spaces else None
        info: dict[str, Any] = {"joint": StepRecord(agent_rewards, flags, visible, masks, scripted_actions)}
        if uneventful:
            return obs, float(team_reward), False, False, info
        if done or left:
            # The value at a time limit is computed from these, so they are checked in full
            self._check_observations(obs, agents if done else left)
        observations = self._observations(obs)
        if done:
            if events.successes:
                info["is_success"] = all(events.successes)
        elif left:
            # Copies of the last observations, before zeros replace them
            info["terminal_observation"] = {agent: np.array(observations[agent]) for agent in left}
            observations.update({agent: self._zero_obs[agent] for agent in left})
        cut = done and bool(flags.truncated.any())
        return observations, float(team_reward), done and not cut, cut, info

    def _events(
        self,
        before: list[str],
        after: list[str],
        terminations: dict[str, bool],
        truncations: dict[str, bool],
        infos: dict[str, dict[str, Any]],
    ) -> _Events:
        """Find out what happened to the agents, of which ``before`` acted and ``after`` are still in play."""
        left, successes = [], []
        active, life_end, truncated = flags = _no_flags(len(self.possible_agents))
        ended = True
        for i, agent in enumerate(self.possible_agents):
            if agent not in before:
                continue
            agent_info = infos.get(agent, {})
            terminates, truncates = terminations.get(agent, False), truncations.get(agent, False)
            has_left = agent not in after
            # An agent that leaves for no stated reason has ended its life: there is nothing to bootstrap from
            life_end[i] = terminates or agent_info.get("life_end", False) or (has_left and not truncates)
            active[i] = agent_info.get("active", True)
            truncated[i] = truncates and not life_end[i]
            if has_left:
                left.append(agent)
            ended = ended and (terminates or truncates)
            if "is_success" in agent_info:
                successes.append(bool(agent_info["is_success"]))
        return _Events(flags, ended, left, successes)

    def render(self) -> Any:
        """Return what the environment's own ``render()`` returns."""
        return self.env.render()

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def set_env_attr(self, name: str, value: Any) -> None:
        """
        Set an attribute of the ``ParallelEnv``; SB3's vectorisers would set it on this wrapper.

        :param name: Name of the attribute
        :param value: Its new value
        """
        setattr(self.env, name, value)

    def __getattr__(self, name: str) -> Any:
        # get_attr() and env_method() of the vectorisers find the environment's own members so. Private names are left out:
        # pickle and copy ask for some of them before ``env`` is set
        if name.startswith("_") or name == "env":
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        return getattr(self.env, name)

    def _observations(self, obs: dict[str, Any]) -> dict[str, np.ndarray]:
        """Return an array for every possible agent, with zeros for those that the environment left out."""
        return {
            agent: np.asarray(obs[agent], dtype=zero.dtype) if agent in obs else zero for agent, zero in self._zero_obs.items()
        }

    def _check_observations(self, obs: dict[str, Any], agents: list[str]) -> None:
        where = place(self._copy, self._t)
        for agent in agents:
            if agent in obs:
                check_observation(agent, obs[agent], self.observation_spaces[agent], where)

    def _visible(self, active: np.ndarray) -> np.ndarray:
        """Return whose actions each agent could observe, given which agents are active: bool ``[n, n_others]``."""
        # An inactive agent neither observes nor is observed. Scripted others count as in play; an environment in which they
        # cannot always be observed says so by its visibility()
        if self.scripted_action_spaces:
            in_play = np.concatenate([active, self._scripted_in_play])[self._others] & active[:, None]
        else:
            in_play = active[self._others] & active[:, None]
        if self._visibility is None:
            return in_play
        rows = self._visibility()
        unseen = np.zeros(self._others.shape[1], dtype=bool)
        # Checking each row would take longer than all the rest, so only a failure leads to a search for its cause
        try:
            if rows.keys() <= self._names:
                given = [rows.get(agent, unseen) for agent in self.possible_agents]
                return np.array(given, dtype=bool).reshape(in_play.shape) & in_play
        except (AttributeError, ValueError):
            pass
        raise self._wrong_visibility(rows)

    def _wrong_visibility(self, rows: Any) -> ValueError:
        """Return the error that says what is wrong with the result of ``visibility()``."""
        n_others, where = self._others.shape[1], place(self._copy, self._t)
        scripted = f" and then the scripted others {list(self.scripted_action_spaces)}" if self.scripted_action_spaces else ""
        rule = (
            f"It must return a dict with {n_others} flags for each agent, the other agents in the order of possible_agents"
            f"{scripted}; the agents are {self.possible_agents}."
        )
        if not isinstance(rows, Mapping):
            return ValueError(f"visibility() returned a {type(rows).__name__} {where}. {rule}")
        for agent, row in rows.items():
            if agent not in self._names:
                return ValueError(f"visibility() has an entry for {agent!r} {where}, which is not an agent. {rule}")
            if np.size(row) != n_others:
                return ValueError(f"visibility() has {np.size(row)} flags for {agent!r} {where}. {rule}")
        return ValueError(f"visibility() returned something that cannot be read as flags {where}: {dict(rows)}. {rule}")

    def _masks(self, infos: dict[str, dict[str, Any]]) -> dict[str, np.ndarray]:
        """Return ``action_masks`` as in ``StepRecord``, or nothing as long as no info has held a mask."""
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
    Step an environment, and reset it if its episode ends.

    :param env: The environment
    :param action: Actions by agent
    :return: Observations by agent, team reward, whether an episode has ended, the ``StepRecord``, the masks for the next
        actions, and what else the infos hold. Where an episode has ended, observations and masks are those of the new one
    """
    obs, reward, terminated, truncated, info = env.step(action)
    record: StepRecord = info.pop("joint")
    masks, done = record.action_masks, terminated or truncated
    if done:
        info["TimeLimit.truncated"] = truncated and not terminated
        # Copies, since the environment may reuse its arrays at the reset
        info["terminal_observation"] = {agent: np.array(last) for agent, last in obs.items()}
        obs, reset_info = env.reset()
        masks = reset_info.get("action_masks")
    return obs, reward, done, record, masks, info


def _no_flags(n_agents: int) -> Flags:
    return Flags(np.zeros(n_agents, dtype=bool), np.zeros(n_agents, dtype=bool), np.zeros(n_agents, dtype=bool))


def mask_width(space: spaces.Space) -> int:
    """
    Return the number of entries in an action mask, as sb3-contrib's ``MaskablePPO`` expects it.

    :param space: An action space
    :return: The number of entries; 0 for a space that cannot be masked
    """
    if isinstance(space, spaces.Discrete):
        return int(space.n)
    if isinstance(space, spaces.MultiDiscrete):
        return int(space.nvec.sum())
    if isinstance(space, spaces.MultiBinary):
        return 2 * int(np.prod(space.n))
    return 0
