"""What SB3's callbacks and other tools read of a model besides ``learn``, ``predict``, ``save`` and ``load``, for a team."""

import inspect
import io
import os
import pathlib
import pickle
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.save_util import load_from_pkl, save_to_pkl
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_belief.team.arguments import check_agent_keys, check_same_agents, check_team_vec_env, check_total_timesteps
from sb3_belief.team.checkpoint import read_team
from sb3_belief.team.lockstep.joint_loop import JointLoop
from sb3_belief.team.logs import TeamLog, record_statistics, record_time
from sb3_belief.team.model_parts import shown_space

# Arguments of algorithms that a team has itself
_OWN = {"policy", "env", "seed", "verbose", "tensorboard_log"}
# Attributes that follow from an algorithm's arguments, and are read like them
_DERIVED = {"n_envs", "policy_class"}


@cache
def algorithm_arguments(algo_class: type[BaseAlgorithm]) -> frozenset[str]:
    """
    Return the names of the arguments of an algorithm.

    :param algo_class: Class of the algorithm
    :return: The names, with those of its base classes that it passes on by ``**kwargs``
    """
    names: set[str] = set()
    for base in algo_class.__mro__:
        if "__init__" in vars(base):
            parameters = inspect.signature(base.__init__).parameters  # type: ignore[misc]
            kinds = {parameter.kind for parameter in parameters.values()}
            names.update(parameters)
            if inspect.Parameter.VAR_KEYWORD not in kinds:
                break
    return frozenset(name for name in names - {"self", "args", "kwargs"} if not name.startswith("_"))


class SB3Protocol:
    """
    Attributes and methods of an SB3 model that a ``Team`` has too.

    An argument of the algorithms (``learning_rate``, ``gamma``, ``n_steps``, ...) is read like a model's,
    ``team.learning_rate``, where all agents have the same value.
    """

    # What a team sets: ``AgentModels``, its loop, logs, counters and scripted others' action spaces
    _agents: Any
    _loop: JointLoop | None
    _exact: Any
    _log: TeamLog | None
    _log_dir: str | None
    _logger: Logger | None
    _learning: bool
    _scripted: dict[str, str]
    possible_agents: list[str]
    tensorboard_log: str | None
    verbose: int
    ep_info_buffer: deque[dict[str, Any]]
    ep_success_buffer: deque[bool]
    num_timesteps: int
    _iterations: int
    _start_timesteps: int
    _start_time: int

    @property
    def _models(self) -> dict[str, BaseAlgorithm]:
        return self._agents.models

    @property
    def agents(self) -> dict[str, BaseAlgorithm]:
        """The models by agent."""
        raise NotImplementedError

    def get_env(self) -> VecEnv | None:
        """Return the team's environment, if it has one."""
        return None if self._loop is None else self._loop.env

    def set_env(self, env: VecEnv) -> None:
        """
        Give the team another environment.

        :param env: Has the same agents, scripted others, spaces and number of copies
        :raises RuntimeError: If the team is learning
        :raises ValueError: If the environment does not fit
        """
        if self._learning:
            raise RuntimeError("The environment of a team cannot be changed while it learns.")
        loop = JointLoop(check_team_vec_env(env))
        check_same_agents(self.possible_agents, self._scripted, loop.possible_agents, loop.scripted)
        n_envs = self.n_envs
        if env.num_envs != n_envs:
            raise ValueError(
                f"The team's buffers are for {n_envs} copies, the environment has {env.num_envs}: save the team and use"
                " Team.load(path, env=env), which makes new ones."
            )
        self._agents.move(loop)
        self._loop = loop

    @property
    def logger(self) -> Logger:
        """The team's logger, available from the first ``learn`` on."""
        if self._logger is None:
            raise AttributeError("A Team has a logger from its first learn() on, or from set_logger().")
        return self._logger

    def set_logger(self, logger: Logger) -> None:
        """
        Replace the logger of the team's table, which ``verbose``, ``log_dir`` and ``tensorboard_log`` set up by default.

        :param logger: The new logger
        """
        self._logger = logger

    def dump_logs(self) -> None:
        """Write the team's table: what has been recorded, and statistics of episodes and time."""
        self._iterations += 1
        record_statistics(self.logger, self.ep_info_buffer, self.ep_success_buffer, self.get_env())
        record_time(self.logger, self._iterations, self.num_timesteps, self._start_timesteps, self._start_time)
        self.logger.dump(step=self.num_timesteps)

    def _make_log(self, run_name: str | None) -> TeamLog:
        if self._log is None:
            self._log = TeamLog(
                self.possible_agents,
                self.verbose,
                self._log_dir,
                self.tensorboard_log,
                run_name or "Team",
                continue_from=self._exact.log_state,
            )
            for agent, model in self.agents.items():
                self._log.connect(agent, model)
            if self._logger is None:
                self._logger = self._log.team_logger
        elif run_name not in (None, self._log.run_name):
            raise ValueError(
                f"tb_log_name is {run_name!r}, but this team's run is {self._log.run_name!r} since its first learn():"
                " leave it out, or load the team anew (Team.load) for a run of another name."
            )
        return self._log

    @property
    def observation_space(self) -> spaces.Dict:
        """The agents' observation spaces by agent."""
        return spaces.Dict({agent: shown_space(model, "observation") for agent, model in self._models.items()})

    @property
    def action_space(self) -> spaces.Dict:
        """The agents' action spaces by agent."""
        return spaces.Dict({agent: shown_space(model, "action") for agent, model in self._models.items()})

    def observed_by(self, agent: str, observation: Any) -> Any:
        """
        Return an agent's observations as its model gets them, for ``team.agents[agent].policy.predict_others`` and the like.

        :param agent: Name of the agent
        :param observation: As the team's environment returns them, ``[n_envs, ...]``
        :return: The same, normalised if the team is
        """
        return self._agents.predictor(agent).observed(observation)

    def rewarded_by(self, agent: str, rewards: np.ndarray) -> np.ndarray:
        """
        Return an agent's rewards as its model gets them in training.

        :param agent: Name of the agent
        :param rewards: Its own, as the team's environment returns them, ``[n_envs]``
        :return: The same, normalised if the team is
        """
        return self._agents.predictor(agent).rewarded(rewards)

    def get_vec_normalize_env(self) -> VecNormalize | None:
        """Return None: each agent is normalised by itself, not the environment."""
        return None

    @property
    def env(self) -> VecEnv | None:
        """The team's environment, if it has one."""
        return self.get_env()

    def __getattr__(self, name: str) -> Any:
        # Python asks here for what it has not found. Private names are left out: copy and pickle ask for some of them early
        if name.startswith("_"):
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        found = inspect.getattr_static(type(self), name, None)
        if isinstance(found, property) and found.fget is not None:
            # It has raised an AttributeError, whose message is better
            return found.fget(self)
        models = self._models
        if name in self._shared_names():
            values = {agent: getattr(model, name, None) for agent, model in models.items() if _has(model, name)}
            # By their text, since schedules do not compare equal
            if len(values) == len(models) and len({(type(value), repr(value)) for value in values.values()}) == 1:
                return next(iter(values.values()))
            raise AttributeError(
                f"The agents of this team have no {name} in common ({values}): read team.agents[name].{name} of each."
            )
        if name == "set_random_seed":
            raise AttributeError("A team is seeded by Team(..., seed=s), or by Team.load(path, seed=s).")
        having = [agent for agent, model in models.items() if hasattr(model, name)]
        if having:
            raise AttributeError(f"A Team has no {name!r}, but its models have: read team.agents[{having[0]!r}].{name}.")
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def _shared_names(self) -> set[str]:
        return _DERIVED.union(*(algorithm_arguments(type(model)) for model in self._models.values())) - _OWN

    @contextmanager
    def shown_arguments(self) -> Iterator[None]:
        """Have ``vars(team)`` show what all agents have in common within the block, for tools that record a model's dict."""
        common = {name: getattr(self, name) for name in self._shared_names() if hasattr(self, name)}
        vars(self).update(common)
        try:
            yield
        finally:
            for name in common:
                vars(self).pop(name, None)

    def check_learn(self, total_timesteps: Any) -> None:
        """
        Check what a ``learn`` of SB3 does not.

        :param total_timesteps: What the user gave to ``learn``
        :raises ValueError: If it is no finite number of at least 0, or an argument of the algorithms was set on the team,
            which only its models could use
        """
        check_total_timesteps(total_timesteps)
        for name in sorted(self._shared_names().intersection(vars(self))):
            raise ValueError(
                f"team.{name} was set, but the models are the agents' own: set it on each model of team.agents, or load them"
                f" with it, Team.load(path, env=env, {name}=...)."
            )

    # Parameters

    def get_parameters(self) -> dict[str, dict[str, Any]]:
        """
        Return the parameters of all models.

        :return: What each model's own ``get_parameters`` returns, by agent
        """
        return {agent: model.get_parameters() for agent, model in self.agents.items()}

    def set_parameters(
        self,
        load_path_or_dict: str | os.PathLike | io.BufferedIOBase | Mapping[str, Any],
        exact_match: bool = True,
        device: th.device | str = "auto",
    ) -> None:
        """
        Set the parameters of the models.

        :param load_path_or_dict: File of a saved team, or parameters by agent as returned by ``get_parameters``
        :param exact_match: As for a model: whether every agent and each of its parameters must be given
        :param device: As for a model
        :raises ValueError: If agents are unknown or missing, or what the models themselves raise
        """
        given = load_path_or_dict
        if not isinstance(given, Mapping):
            files: Mapping[str, Any] = read_team(given).parameter_files()
            given = files
        models = self.agents
        check_agent_keys("load_path_or_dict", given, list(models))
        missing = [agent for agent in models if agent not in given]
        if missing and exact_match:
            raise ValueError(f"There are no parameters for {missing}; exact_match=False sets those of the others.")
        for agent, parameters in given.items():
            models[agent].set_parameters(parameters, exact_match=exact_match, device=device)

    # Replay buffers

    @property
    def replay_buffer(self) -> dict[str, Any]:
        """
        The replay buffers of the agents that have one, by agent.

        :raises AttributeError: If none has, as for an on-policy model of SB3
        """
        buffers = {agent: getattr(model, "replay_buffer", None) for agent, model in self.agents.items()}
        buffers = {agent: buffer for agent, buffer in buffers.items() if buffer is not None}
        if not buffers:
            raise AttributeError("No agent of this team has a replay buffer.")
        return buffers

    def save_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """
        Save the replay buffers of all agents that have one, as one file.

        :param path: Path of the file, or an open binary file
        """
        save_to_pkl(path, self.replay_buffer)

    def load_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """
        Load replay buffers. The file is unpickled, as a model's own is: load only what you trust.

        :param path: Path of a file that ``save_replay_buffer`` of a team has written, or an open binary file
        :param truncate_last_traj: As for a model
        :raises ValueError: If the file holds something else, or buffers of agents that have none here
        """
        buffers = load_from_pkl(path)
        if not isinstance(buffers, dict):
            raise ValueError(f"{path} holds a {type(buffers).__name__}, not the replay buffers of a team by agent.")
        check_agent_keys("The file", buffers, list(self.replay_buffer))
        for agent, buffer in buffers.items():
            model: Any = self.agents[agent]
            model.load_replay_buffer(io.BytesIO(pickle.dumps(buffer)), truncate_last_traj)


def _has(model: BaseAlgorithm, name: str) -> bool:
    return name in algorithm_arguments(type(model)) | _DERIVED and hasattr(model, name)
