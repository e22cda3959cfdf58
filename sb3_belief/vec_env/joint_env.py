"""A PettingZoo ``ParallelEnv`` as a single Gymnasium environment, so that SB3's own vectorisers can hold copies of it."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from math import isfinite
from typing import Any, TypeAlias

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from sb3_belief.common.action_masks import first_actions, mask_row, mask_width, wrong_width
from sb3_belief.common.exceptions import add_note
from sb3_belief.common.plain_data import PlainData
from sb3_belief.vec_env.copy_state import CopyState
from sb3_belief.vec_env.events import Events, Flags, StepRecord, find_events, no_flags
from sb3_belief.vec_env.observation_forms import ObservationForms, copied, has_parts, map_parts, zeros_in
from sb3_belief.vec_env.own_infos import own_infos
from sb3_belief.vec_env.own_state import own_state, state_row, state_width
from sb3_belief.vec_env.returned import (
    StepParts,
    plain_infos,
    plain_parts,
    plain_reset,
    plain_step,
    plain_team_reward,
)
from sb3_belief.vec_env.scripted_others import ScriptedOthers, optional_member
from sb3_belief.vec_env.success import reports_success
from sb3_belief.vec_env.user_env import UserEnv, separate_agents
from sb3_belief.vec_env.validation import check_names, check_observation, forgotten_agents, no_last_observation, place
from sb3_belief.vec_env.visible import VisibleOthers

# Says whose action of the last step each agent could observe: bool [n_others] by agent
Visibility: TypeAlias = Callable[[ParallelEnv], Mapping[str, np.ndarray]]
# Types of infos, and of the sum of rewards if these are numbers
_DICT, _NUMBERS = {dict}, {float, int, np.float64, np.float32, np.int64, np.int32}
#: Under this name the info of a step holds the state after it, and after the reset where an episode has ended
STATE = "team_state"


class JointEnv(gym.Env):
    """
    Gymnasium environment of a whole team: observations and actions are dictionaries by agent, the reward is the team's.

    Observations have the form that models take (see ``ObservationForms``): arrays, or dicts of arrays by name, without masks.

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
        self._user_env = user_env = UserEnv(env)
        self.env = env
        # What is stepped: mostly the environment itself
        self._game: Any = user_env if user_env.adapts else env
        self.possible_agents: list[str] = user_env.possible_agents
        forms = ObservationForms(user_env)
        self._forms = None if forms.is_identity else forms
        self.observation_spaces, self.action_spaces = forms.spaces, user_env.action_spaces
        self.observation_space = spaces.Dict(self.observation_spaces)
        self.action_space = spaces.Dict(self.action_spaces)
        self.render_mode = getattr(env, "render_mode", None)
        self.metadata = getattr(env, "metadata", {})

        self._scripted = ScriptedOthers(env)
        self.scripted_action_spaces = self._scripted.action_spaces

        self._mask_widths = {agent: mask_width(self.action_spaces[agent]) for agent in self.possible_agents}
        # The records of all uneventful steps share these arrays, so they are read-only
        self._no_event = no_flags(len(self.possible_agents))
        self._no_event.active[:] = True
        for shared in self._no_event:
            shared.flags.writeable = False
        says = optional_member(env, "visibility")
        if visibility is not None:
            if says is not None:
                raise ValueError(
                    f"{type(user_env.unwrapped).__name__} says by its own visibility() who can observe whom, so it does not"
                    " take the argument visibility: leave it out, or override the method in a wrapper."
                )
            says = partial(visibility, env)
        self._team_reward: Any = optional_member(env, "team_reward")
        if user_env.renames:
            says, self._team_reward = user_env.renamed_members(says, self._team_reward)
        #: Whether the environment reports ``is_success``, as far as can be known before it does
        self.reports_success = reports_success(env)
        watches = says is not None and bool(optional_member(env, "observe_while_inactive"))
        self._others = VisibleOthers(self.possible_agents, list(self.scripted_action_spaces), says, watches)
        self._zero_obs = {agent: zeros_in(space) for agent, space in self.observation_spaces.items()}
        # Set at the first info that holds an action mask
        self._has_masks = False
        # What those who left before the end of the episode said of its success
        self._said_success: dict[str, bool] = {}
        # Names and shapes in a form that each step's check can compare with quickly
        self._names = dict.fromkeys(self.possible_agents).keys()
        self._shapes = [(agent, space.shape) for agent, space in self.observation_spaces.items() if space.shape]
        self._dict_shapes = [
            (agent, space.spaces.keys(), [(key, part.shape) for key, part in space.spaces.items() if part.shape])
            for agent, space in self.observation_spaces.items()
            if isinstance(space, spaces.Dict)
        ]
        self._copy, self._t = copy, 0
        self._copy_state: CopyState | None = None
        self._state: Any = own_state(env)
        #: Whether the infos of steps hold the environment's own state
        self.tells_states = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, np.ndarray], dict]:
        """
        Reset the environment.

        :param seed: Seed of the environment; None continues with its generator as it is
        :param options: Passed on to the environment
        :return: Observations by agent, and an info with ``action_masks`` as in ``StepRecord``, empty without masks
        :raises ValueError: If what the environment returns does not fit its agents and spaces
        """
        self._t, self._said_success = 0, {}
        try:
            result = self._game.reset(seed=seed, options=options)
        except Exception as error:
            self.name_place(error, "reset()")
            raise
        obs, infos = plain_reset(result, self._where)
        if self._forms is not None:
            obs, infos = self._forms.convert(obs, infos, self._where)
        separate_agents(self.env)
        self._copy_state = self._copy_state or CopyState(self.env)
        after = self.agents_in_play
        if not after:
            raise ValueError(f"agents is empty {self._where}: reset() must fill it with the agents that are in play.")
        self._check_possible_agents()
        if obs.keys() != self._names or after != self.possible_agents:
            check_names(self.possible_agents, after, after, {"observations": obs}, self._where)
        self._check_observations(obs, self.possible_agents)
        return self._observations(obs), self._masks(plain_infos(infos, self.possible_agents, self._where))

    def step(self, action: dict[str, Any]) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """
        Step the environment.

        :param action: Actions by agent, one for every possible agent; those of agents that have left are ignored
        :return: Observations by agent (the environment's own arrays), team reward, whether the episode terminated, whether it
            was truncated, and an info with the ``StepRecord`` under ``joint``
        :raises ValueError: If what the environment returns does not fit its agents and spaces
        """
        before = list(self._game.agents)
        self._t += 1
        try:
            result = self._game.step({agent: action[agent] for agent in before})
        except Exception as error:
            self.name_place(error, "step()")
            raise
        if self._forms is not None:
            result = self._converted(result)
        agents = self.possible_agents
        # Here and below, a cheap look decides whether something has to be converted, or the cause of a fault found
        try:
            after = list(self._game.agents)
            obs, rewards, terminations, truncations, infos = result
            any_info = any(infos.values())
            any_end = any(terminations.values()) or any(truncations.values())
            agent_rewards = [rewards.get(agent, 0.0) for agent in agents]
            total = sum(agent_rewards)
            as_usual = obs.keys() == self._names and rewards.keys() == self._names and after == agents
        except (AttributeError, TypeError, ValueError):
            total = None
        if type(total) not in _NUMBERS:
            any_info = any_end = True
            as_usual = False
            after = self.agents_in_play
            obs, rewards, terminations, truncations, infos = plain_parts(result, agents, self._where)
            agent_rewards = [rewards.get(agent, 0.0) for agent in agents]
            total = sum(agent_rewards)
        if not as_usual:
            check_names(agents, before, after, {"observations": obs, "rewards": rewards}, self._where)
        for agent, shape in self._shapes:
            if agent in obs and getattr(obs[agent], "shape", None) != shape:
                self._check_observations(obs, [agent])
        for agent, keys, shapes in self._dict_shapes:
            if agent in obs and not has_parts(obs[agent], keys, shapes):
                self._check_observations(obs, [agent])
        team_reward = float(total / len(agents)) if self._team_reward is None else self._own_team_reward(rewards, total)
        # In nearly all steps of nearly all environments nothing happens to any agent, and the loop over agents is saved
        if any_info or any_end or len(after) < len(agents):
            if any_info and not _DICT.issuperset(map(type, infos.values())):
                infos = plain_infos(infos, agents, self._where)
            events = find_events(agents, before, after, terminations, truncations, infos, self._copy, self._t)
            info = own_infos(infos, self.action_spaces) if any_info else {}
            done, cut = events.ended or not after, events.flags.truncated
            gone = [a for i, a in enumerate(agents) if a not in after and (a not in before or not (done or cut[i]))]
            info["joint"] = self._record(agent_rewards, events.flags, infos if any_info or self._has_masks else None, gone)
            return self._after_events(obs, team_reward, events, done, info)
        record = self._record(agent_rewards, self._no_event, infos if self._has_masks else None)
        return obs, team_reward, False, False, {"joint": record}

    def _after_events(
        self, obs: dict[str, Any], team_reward: float, events: Events, done: bool, info: dict[str, Any]
    ) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Return a step in which something has happened to an agent."""
        flags, left = events.flags, events.left
        if done or left:
            self._check_ends(obs, flags, self.possible_agents if done else left)
        observations = self._observations(obs)
        if done:
            if successes := self._said_success | events.successes:
                info["is_success"] = all(successes.values())
        elif left:
            # Copies of the last observations, before zeros replace them
            info["terminal_observation"] = {agent: copied(observations[agent]) for agent in left}
            observations.update({agent: self._zero_obs[agent] for agent in left})
            self._said_success |= {agent: said for agent, said in events.successes.items() if agent in left}
        cut = done and bool(flags.truncated.any())
        return observations, team_reward, done and not cut, cut, info

    def _converted(self, result: Any) -> StepParts:
        """Return what a step returned with observations in the form that models take, and masks in the infos."""
        assert self._forms is not None
        obs, rewards, terminations, truncations, infos = plain_step(result, self._where)
        obs, infos = self._forms.convert(obs, infos, self._where if self._t < 2 else None)
        return obs, rewards, terminations, truncations, infos

    def _own_team_reward(self, rewards: dict[str, float], total: float) -> float:
        """Return the team's reward as the environment computes it."""
        reward = self._team_reward(rewards)
        # Where an agent's own reward is not finite, that one is refused later
        if type(reward) is not float or (isfinite(total) and not isfinite(reward)):
            return plain_team_reward(reward, self._where)
        return reward

    def _record(self, rewards: list[float], flags: Flags, infos: Any, gone: Sequence[str] = ()) -> StepRecord:
        """Return the record of a step; without infos there are no masks to look for."""
        always = self._others.all_visible if flags is self._no_event else None
        visible = self._others.rows(flags.active, self._copy, self._t) if always is None else always
        masks = None if infos is None else self._masks(infos, gone).get("action_masks")
        scripted_actions = self._scripted.actions() if self.scripted_action_spaces else None
        return StepRecord(rewards, flags, visible, masks, scripted_actions)

    def _check_ends(self, obs: dict[str, Any], flags: Flags, ended: list[str]) -> None:
        """Check the last observations of agents that left or, if the episode is over, of all."""
        # The value at a time limit is computed from these, so they are checked in full
        self._check_observations(obs, ended)
        for agent, cut in zip(self.possible_agents, flags.truncated & flags.active, strict=True):
            if cut and agent not in obs:
                raise no_last_observation(agent, self._where)
        self._check_possible_agents()

    def get_copy_state(self) -> tuple[Any, PlainData]:
        """Return what decides how this copy goes on, to be called after a reset (see ``CopyState``)."""
        assert self._copy_state is not None
        return (self._t, self._has_masks, self._said_success), self._copy_state.get()

    def set_copy_state(self, own: Any, state: PlainData) -> None:
        """
        Restore what :meth:`get_copy_state` returned, after a reset.

        :param own: Its first part
        :param state: Its second part
        """
        assert self._copy_state is not None
        self._copy_state.set(state)
        self._t, self._has_masks, self._said_success = own

    def state_width(self) -> int | None:
        """Return the number of entries of the environment's own state; None if it has none."""
        return state_width(self.env, self._state, lambda: self.agents_in_play or self._game.reset(), self._where)

    def tell_state(self) -> np.ndarray:
        """Return the environment's own state, float32 ``[d_s]``, and let the info of each step hold it from now on."""
        self.tells_states = True
        return state_row(self._state(), self._where)

    def render(self) -> Any:
        """Return what the environment's own ``render()`` returns."""
        try:
            return self.env.render()
        except Exception as error:
            self.name_place(error, "render()")
            raise

    @property
    def agents_in_play(self) -> list[str]:
        """Names of the agents that are in play, none also where the environment has None for nobody."""
        told = getattr(self._game, "agents", None)
        return [] if told is None else list(told)

    def close(self) -> None:
        """Close the environment."""
        self._user_env.close()

    def name_place(self, error: BaseException, what: str) -> None:
        """
        Add to an error of the environment where it was raised.

        :param error: The error, as it is being handled
        :param what: What raised it
        """
        add_note(error, f"Raised by the environment's {what} {self._where}.")

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
            agent: map_parts(_as_array, zero, obs[agent]) if agent in obs else zero for agent, zero in self._zero_obs.items()
        }

    def _check_observations(self, obs: dict[str, Any], agents: list[str]) -> None:
        where = self._where
        for agent in agents:
            if agent in obs:
                check_observation(agent, obs[agent], self.observation_spaces[agent], where)

    @property
    def _where(self) -> str:
        return place(self._copy, self._t)

    def _check_possible_agents(self) -> None:
        names = getattr(self._game, "possible_agents", None)
        if names is not None and len(names) != len(self.possible_agents):
            raise forgotten_agents(type(self.env).__name__, self.possible_agents, list(names), self._where)

    def _masks(self, infos: dict[str, dict[str, Any]], gone: Sequence[str] = ()) -> dict[str, np.ndarray]:
        """Return ``action_masks`` as in ``StepRecord``, or nothing as long as no info has held a mask. ``gone`` have left."""
        self._has_masks = self._has_masks or any("action_mask" in (infos.get(a) or ()) for a in self.possible_agents)
        if not self._has_masks:
            return {}
        masks = []
        # What is wrong with masks is mostly wrong from the beginning
        where = self._where if self._t < 2 else None
        for agent, width in self._mask_widths.items():
            info = infos.get(agent) or {}
            if "action_mask" not in info or not width:
                # All of them would let those into a joint maximum which nobody may ever take
                masks.append(first_actions(self.action_spaces[agent]) if agent in gone else np.ones(width, dtype=bool))
                continue
            mask = mask_row(info["action_mask"], self.action_spaces[agent], agent, where)
            if mask.size != width:
                raise wrong_width(agent, width, mask.size, self._where)
            masks.append(mask)
        return {"action_masks": np.concatenate(masks)}


def step_and_reset(
    env: JointEnv, action: dict[str, Any]
) -> tuple[dict[str, np.ndarray], float, bool, StepRecord, np.ndarray | None, dict[str, Any]]:
    """
    Step an environment, and reset it if its episode ends.

    :param env: The environment
    :param action: Actions by agent
    :return: Observations by agent, team reward, whether an episode has ended, the ``StepRecord``, the masks for the next
        actions, and what else the infos hold. Where an episode has ended, observations and masks are those of the new one, and
        the infos hold the last masks, those of all agents side by side, under ``terminal_action_masks``
    """
    obs, reward, terminated, truncated, info = env.step(action)
    record: StepRecord = info.pop("joint")
    masks, done = record.action_masks, terminated or truncated
    if done:
        info["TimeLimit.truncated"] = truncated and not terminated
        # Copies, since the environment may reuse its arrays at the reset
        info["terminal_observation"] = {agent: copied(last) for agent, last in obs.items()}
        if masks is not None:
            info["terminal_action_masks"] = masks
        if env.tells_states:
            info["terminal_state"] = env.tell_state()
        obs, reset_info = env.reset()
        masks = reset_info.get("action_masks")
    if env.tells_states:
        info[STATE] = env.tell_state()
    return obs, reward, done, record, masks, info


def _as_array(zero: np.ndarray, value: Any) -> np.ndarray:
    return np.asarray(value, dtype=zero.dtype)
