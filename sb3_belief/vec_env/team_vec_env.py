"""The vectorised environment of a whole team: an SB3 ``VecEnv`` whose observations and actions are dictionaries by agent."""

import os
import time
from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from copy import deepcopy
from typing import Any, TypeAlias

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor, ResultsWriter
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from sb3_belief.common.plain_data import NotPlainError
from sb3_belief.vec_env.monitor_files import monitor_sizes, open_monitor_files
from sb3_belief.vec_env.states import GlobalStates
from sb3_belief.vec_env.validation import check_spaces, difference

TeamObs: TypeAlias = dict[str, np.ndarray]
TeamStep: TypeAlias = tuple[TeamObs, np.ndarray, np.ndarray, list[dict[str, Any]]]


class JointObs(dict[str, Any]):
    """
    Observations by agent that also know where an agent's own return has just ended.

    SB3's ``evaluate_policy`` hands a model the observations and the dones of the team, and nothing else of a step. A recurrent
    agent's state has to start anew at each life of its own, as in training, which is known in this way.

    :param obs: The observations, ``[num_envs, ...]`` by agent
    :param possible_agents: Names of the agents
    :param infos: Those of the step; none after a reset
    """

    def __init__(self, obs: TeamObs, possible_agents: Sequence[str], infos: Sequence[Mapping[str, Any]] = ()):
        super().__init__(obs)
        self._agents, self._infos = possible_agents, infos

    def __deepcopy__(self, memo: dict[int, Any]) -> "JointObs":
        # SB3's VecTransposeImage copies the observations; the infos need not be
        return JointObs(deepcopy(dict(self), memo), self._agents, self._infos)

    def of(self, agents: Iterable[str]) -> "JointObs":
        """
        Return the observations of some agents, which know as much of lives that have ended.

        :param agents: Their names
        """
        return JointObs({agent: self[agent] for agent in agents}, self._agents, self._infos)

    def life_ends(self, agent: str) -> np.ndarray | None:
        """
        Return where the agent's own return has ended or been cut off at the step that led to these observations.

        :param agent: Name of the agent
        :return: bool ``[num_envs]``; None after a reset
        """
        i = self._agents.index(agent)
        return np.array([info["life_end"][i] or info["truncated"][i] for info in self._infos]) if self._infos else None


class TeamVecEnv(GlobalStates, VecEnv):
    """
    Vectorised environment of a team of ``n`` agents: copies that are stepped together and reset automatically.

    A subclass implements ``_reset_joint`` and ``_step_joint``. This class does what every team environment needs besides: it
    checks the actions and monitors episodes (returns of the team and of each agent, monitor files). After every step
    ``infos[e]`` holds

    - ``agent_rewards`` float32 ``[n]``
    - ``visible`` bool ``[n, n-1+n_scripted]``: row i says whose action of this step agent i could observe (the other agents in
      order, then the scripted others)
    - ``active`` bool ``[n]``: whether the agent was in play when it acted
    - ``life_end`` bool ``[n]``: whether the agent's own return ended at this step (it terminated, or its life ended)
    - ``truncated`` bool ``[n]``: whether the agent's own return was cut off by a limit at this step (never together with
      ``life_end``)
    - ``scripted_actions`` float32 ``[W_scripted]``, only with scripted others: their actions of this step, each encoded as by
      ``gymnasium.spaces.flatten``, side by side
    - ``agent_infos`` {agent: dict}, only if the environment's infos hold more than a team reads of them: copies of what they
      hold besides
    - each key in ``agent_infos``, with the mean over the agents that report it where these are numbers, otherwise the value of
      the first such agent; so ``VecMonitor(env, info_keywords=("fuel",))`` works
    - what the environment's infos hold under names that are no agents, under these names

    Entries of the environment never replace one of the others. At the end of the team's episode it also holds
    ``terminal_observation`` {agent: obs}, ``terminal_action_masks`` {agent: bool ``[k]``} (the masks after the last step, in
    an environment with masks), ``terminal_state`` float32 ``[d_s]`` (from the first call of :meth:`states` on),
    ``TimeLimit.truncated`` bool, ``is_success`` bool (if the environment reports it:
    then at every end, False where it says nothing), ``episode`` {"r": team return, "l": length, "t": seconds since the start}
    and ``agent_episode_rewards`` float64 ``[n]``. Where a copy has failed and was made anew, its episode ends so too, with
    rewards of 0 and ``worker_restarted`` True.

    :param num_envs: Number of copies
    :param possible_agents: Names of the agents; their order is the order of every array over agents
    :param observation_spaces: Observation space of each agent (``Discrete``, ``MultiDiscrete``, ``MultiBinary`` or ``Box``),
        or a ``Dict`` of such spaces by name (not nested), whose observations are dicts of arrays
    :param action_spaces: Action space of each agent (``Discrete``, ``MultiDiscrete``, ``MultiBinary`` or ``Box``)
    :param render_mode: Render mode of the copies (None, "rgb_array" or "human")
    :param scripted_action_spaces: Action space of each scripted other (a partner that belongs to the environment and does not
        learn), in order and of the same kinds; None if there are none
    :raises ValueError: For names or spaces that a team cannot have
    """

    def __init__(
        self,
        num_envs: int,
        possible_agents: Sequence[str],
        observation_spaces: Mapping[str, spaces.Space],
        action_spaces: Mapping[str, spaces.Space],
        render_mode: str | None = None,
        scripted_action_spaces: Mapping[str, spaces.Space] | None = None,
    ):
        self.possible_agents = list(possible_agents)
        self.scripted_action_spaces = dict(scripted_action_spaces or {})
        check_spaces(self.possible_agents, observation_spaces, action_spaces, self.scripted_action_spaces)
        # Set first, because VecEnv.__init__ asks for it through get_attr()
        self.render_mode = render_mode
        super().__init__(
            num_envs,
            # Iterate over possible_agents, never over these: gymnasium may sort their keys
            spaces.Dict({agent: observation_spaces[agent] for agent in self.possible_agents}),
            spaces.Dict({agent: action_spaces[agent] for agent in self.possible_agents}),
        )
        #: Whether the environment reports ``is_success``, as far as is known
        self.reports_success = False
        self.monitor_dir: str | None = None
        self._writers: list[ResultsWriter] = []
        self._actions: TeamObs = {}
        self._action_shapes = {agent: (num_envs, *(action_spaces[agent].shape or ())) for agent in self.possible_agents}
        #: What the last step returned, whatever wrappers make of it: team rewards and dones, ``[num_envs]``, and the agents'
        #: own rewards, ``[num_envs, n]``
        self.last_rewards, self.last_dones = np.zeros(num_envs, dtype=np.float32), np.zeros(num_envs, dtype=bool)
        self.last_agent_rewards = np.zeros((num_envs, len(self.possible_agents)), dtype=np.float32)
        self._t_start = time.time()
        self._zero_episode_sums()

    # What a subclass implements

    @abstractmethod
    def _reset_joint(self) -> TeamObs:
        """
        Reset all copies, copy i with the seed ``self._seeds[i]`` (None: unseeded) and the options ``self._options[i]``.

        :return: Observations ``[num_envs, ...]`` by agent
        """

    @abstractmethod
    def _step_joint(self, actions: TeamObs) -> TeamStep:
        """
        Step all copies and reset those whose team episode ended.

        :param actions: ``[num_envs, ...]`` by agent, already checked
        :return: Observations ``[num_envs, ...]`` by agent, team rewards float32 ``[num_envs]``, dones bool ``[num_envs]``, and
            infos as described for the class, without what the monitoring adds (``episode``, ``agent_episode_rewards``). The
            arrays must be new ones at each step, since models keep them
        """

    def action_masks(self) -> dict[str, np.ndarray] | None:
        """
        Return the masks for the current observations.

        :return: bool ``[num_envs, k]`` by agent, or None if the environment has no masks
        """
        return None

    # The VecEnv interface

    def reset(self) -> TeamObs:
        """
        Reset all copies.

        :return: First observations of the new episodes, ``[num_envs, ...]`` by agent
        """
        if self.monitor_dir is not None and not self._writers:
            self.start_monitor(self.monitor_dir)
        self._obs = self._reset_joint()
        obs = JointObs(self._obs, self.possible_agents)
        # Seeds and options are used only once
        self._reset_seeds()
        self._reset_options()
        self._zero_episode_sums()
        return obs

    def step_async(self, actions: TeamObs) -> None:  # type: ignore[override]
        """
        Check the actions of the next step and keep them until ``step_wait``.

        :param actions: ``[num_envs, ...]`` by agent, with an entry for every agent
        :raises ValueError: If an agent is missing or unknown, or an array has the wrong shape
        """
        self._actions = self._check_actions(actions)

    def step_wait(self) -> TeamStep:
        """
        Step all copies with the actions of ``step_async``, and reset those whose team episode ends.

        :return: Observations ``[num_envs, ...]`` by agent, team rewards float32 ``[num_envs]``, dones bool ``[num_envs]`` and
            infos
        """
        obs, rewards, dones, infos = self._step_joint(self._actions)
        self._monitor_step(rewards, dones, infos)
        self._obs = obs
        if self._asked_for_states:
            self._tell_terminal_states(dones, infos)
        return JointObs(obs, self.possible_agents, infos), rewards, dones, infos

    def step(self, actions: TeamObs) -> TeamStep:  # type: ignore[override]
        """
        Step all copies, and reset those whose team episode ends.

        :param actions: ``[num_envs, ...]`` by agent, with an entry for every agent
        :return: Observations ``[num_envs, ...]`` by agent, team rewards float32 ``[num_envs]``, dones bool ``[num_envs]`` and
            infos
        :raises ValueError: If an agent is missing or unknown, or an array has the wrong shape
        """
        self.step_async(actions)
        return self.step_wait()

    def close(self) -> None:
        """Close the monitor files; a subclass that holds other resources closes these too."""
        for writer in self._writers:
            writer.close()
        self._writers = []
        # A reset after close() must not truncate the finished files
        self.monitor_dir = None

    # All copies live in one object unless a subclass says otherwise

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        value = getattr(self, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        if indices is not None:
            raise ValueError(f"The copies of {type(self).__name__} share their attributes: set_attr() takes no indices.")
        setattr(self, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        result = getattr(self, method_name)(*method_args, **method_kwargs)
        if method_name == "action_masks":
            # sb3-contrib's evaluation asks each copy for its masks and passes the answers on to predict()
            return [{agent: masks[i] for agent, masks in (result or {}).items()} for i in self._get_indices(indices)]
        return [result for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        # evaluate_policy asks whether there is a Monitor before it trusts info["episode"]; the monitoring here does the same
        return [issubclass(wrapper_class, Monitor) for _ in self._get_indices(indices)]

    def begin_rollout(self) -> None:
        """Be told that the team which learns here begins a rollout; what changes with rollouts overrides it."""

    # Monitoring

    def start_monitor(self, folder: str, continue_from: Mapping[str, Any] | None = None) -> None:
        """
        Start writing one row per finished episode in SB3's monitor format.

        ``monitor.csv`` holds the team's returns and ``agents/<agent>.monitor.csv`` each agent's own; a name that cannot be
        part of a path is quoted (see ``file_name``). Existing files are overwritten.

        :param folder: Folder of the files; it is created if it does not exist
        :param continue_from: What ``monitor_state`` returned, for a run that goes on from there: later rows of the files are
            dropped, and times count from their first start
        :raises ValueError: If a file is shorter than it was then
        """
        for writer in self._writers:
            writer.close()
        self.monitor_dir = os.fspath(folder)
        if continue_from is not None:
            self._t_start = float(continue_from["t_start"])
        header: dict[str, float | str] = {"t_start": self._t_start, "env_id": type(self).__name__}
        self._writers = open_monitor_files(self.monitor_dir, self.possible_agents, header, continue_from)

    def monitor_state(self) -> dict[str, Any]:
        """
        Return how far the monitor files are, for ``start_monitor`` of a run that goes on from here.

        :return: Plain numbers
        """
        return {"t_start": self._t_start, "sizes": monitor_sizes(self._writers)}

    def sync_monitor(self) -> None:
        """Have the system write to the disk what it holds of the monitor files."""
        for writer in self._writers:
            os.fsync(writer.file_handler.fileno())

    def _zero_episode_sums(self) -> None:
        self._team_returns = np.zeros(self.num_envs)
        self._agent_returns = np.zeros((self.num_envs, len(self.possible_agents)))
        self._lengths = np.zeros(self.num_envs, dtype=int)

    def _monitor_step(self, rewards: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]) -> None:
        """Add a step to the episodes' returns, and where an episode has ended, put them into its info and into the files."""
        agent_rewards = np.concatenate([info["agent_rewards"] for info in infos]).reshape(self._agent_returns.shape)
        # Copies, since wrappers may write into the arrays
        self.last_rewards, self.last_dones, self.last_agent_rewards = rewards.copy(), dones.copy(), agent_rewards
        self._team_returns += rewards
        self._agent_returns += agent_rewards
        self._lengths += 1
        for env_idx in np.flatnonzero(dones):
            info = infos[env_idx]
            if "is_success" in info:
                self.reports_success = True
            elif self.reports_success:
                # SB3's EvalCallback cannot save evaluations in which some episodes have it and some have not
                info["is_success"] = False
            seconds = round(time.time() - self._t_start, 6)
            team_return, length = float(self._team_returns[env_idx]), int(self._lengths[env_idx])
            info["episode"] = {"r": team_return, "l": length, "t": seconds}
            info["agent_episode_rewards"] = self._agent_returns[env_idx].copy()
            if self._writers:
                # The cell stays empty where the environment reports no successes
                row = {"l": length, "t": seconds, "is_success": info.get("is_success", "")}
                for writer, value in zip(self._writers, [team_return, *info["agent_episode_rewards"]], strict=True):
                    writer.write_row({"r": round(float(value), 6), **row})
            self._team_returns[env_idx] = 0.0
            self._agent_returns[env_idx] = 0.0
            self._lengths[env_idx] = 0

    # Exact state

    def exact_state(self) -> dict[str, Any]:
        """
        Return all that decides how the environment goes on, between two steps and after a reset (issue 17).

        :return: Plain data for :meth:`set_exact_state`
        :raises NotPlainError: If the environment holds what is not plain data; a team then begins new episodes instead
        """
        return {
            "copies": self._copies_state(),
            "returns": (self._team_returns.copy(), self._agent_returns.copy(), self._lengths.copy()),
            "last": (self.last_rewards.copy(), self.last_dones.copy(), self.last_agent_rewards.copy()),
            "reports_success": self.reports_success,
            # States may consist of them
            "observations": self._obs if self._asked_for_states else None,
        }

    def set_exact_state(self, state: dict[str, Any]) -> None:
        """
        Go on where another environment of the same kind was.

        :param state: As its :meth:`exact_state` returned it
        :raises ValueError: If it does not fit this environment
        """
        self._set_copies_state(state["copies"])
        self._team_returns, self._agent_returns, self._lengths = state["returns"]
        self.last_rewards, self.last_dones, self.last_agent_rewards = state["last"]
        self.reports_success = state["reports_success"]
        if state.get("observations") is not None:
            self._obs = state["observations"]
            # Copies tell their last states only after they have been asked, which the other environment's were
            self.states()

    def _copies_state(self) -> Any:
        """Return what decides how the copies go on, as plain data."""
        if not (hasattr(self, "get_state") and hasattr(self, "set_state")):
            raise NotPlainError(f"{type(self).__name__} has no get_state() and set_state().")
        return self.get_state()

    def _set_copies_state(self, state: Any) -> None:
        self.set_state(state)  # type: ignore[attr-defined]

    # Checks

    def _check_actions(self, actions: Any) -> TeamObs:
        """Return the actions as arrays in the order of ``possible_agents``."""
        if not isinstance(actions, Mapping):
            raise ValueError(
                f"A team's actions are a dict {{agent: array [{self.num_envs}, ...]}} with the agents"
                f" {self.possible_agents}, not {type(actions).__name__}."
            )
        if actions.keys() != self._action_shapes.keys():
            missing, unknown = difference(self.possible_agents, actions)
            raise ValueError(
                f"Each agent needs an action: missing {missing}, unknown {unknown}; the agents are {self.possible_agents}."
            )
        checked = {agent: np.asarray(actions[agent]) for agent in self.possible_agents}
        for agent, shape in self._action_shapes.items():
            if checked[agent].shape != shape:
                raise ValueError(
                    f"The actions of {agent!r} must have the shape {shape} (one per environment copy),"
                    f" got {checked[agent].shape}."
                )
        return checked
