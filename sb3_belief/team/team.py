"""A team of independent SB3 models that learns in one environment and follows SB3's own model protocol."""

import io
import os
import sys
import time
from collections import deque
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.utils import safe_mean
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_belief.common.rng import RngSwitch
from sb3_belief.team.agent_models import AgentModels, team_rng
from sb3_belief.team.arguments import check_env, check_names, per_agent
from sb3_belief.team.checkpoint import read_team, spaces_manifest, write_team
from sb3_belief.team.lockstep.agent_task import AgentTask
from sb3_belief.team.lockstep.joint_loop import JointLoop
from sb3_belief.team.lockstep.progress import TeamProgress, as_callback
from sb3_belief.team.logs import TeamLog
from sb3_belief.team.parallel import Jobs, check_jobs
from sb3_belief.team.predictor import PolicyState
from sb3_belief.vec_env.team_vec_env import TeamObs

SelfTeam = TypeVar("SelfTeam", bound="Team")


class Team:
    """
    One SB3 model for each agent of a team, all learning at once in one vectorised environment.

    The models are unmodified SB3 ones and share nothing: weights, buffers, normalisation, loggers and random streams are
    each agent's own. With ``seed=s`` the environment is seeded with ``s`` as SB3 models do it, and agent k's model with
    ``agent_seed(s, k)``, so that equal networks start differently and no agent's learning depends on how many random numbers
    another draws. Policies of equal shape act together, in one pass with their weights stacked, to the same bits. One timestep
    is one joint step of one copy of the environment.

    ``learn``, ``predict``, ``save``, ``load``, ``set_env``, ``get_env``, ``num_timesteps`` and ``logger`` are those of an SB3
    model, so that ``evaluate_policy`` and SB3's callbacks take a team as it is.

    :param algo_class: class of SB3, sb3-contrib or this package for all agents, or {agent: class}
    :param policy: policy of that class for all agents, or {agent: policy}
    :param env: a ``TeamVecEnv`` (see ``make_team_env``) or SB3 wrappers around one
    :param seed: of the environment and all models; None: not seeded
    :param normalize: True or arguments of ``VecNormalize``: each agent's observations and rewards are normalised by running
        statistics of its own (an inactive agent's zero observations count too); False: not
    :param verbose: 1: one table per iteration; 2: also what the models themselves print
    :param log_dir: folder of CSV logs: ``progress.csv`` (the team) and ``agents/<agent>/progress.csv``; None: none
    :param tensorboard_log: folder of TensorBoard logs: ``Team_<k>`` and ``Team_<k>/agents/<agent>``; None: none
    :param device: of all models
    :param jobs: how many processes share the agents whose algorithms are on-policy (PPO, A2C, ...), this one among them. Each
        agent learns in one of them, or is only updated there if it has a callback of its own, if the team has one that is not
        SB3's or sb3-contrib's, or if methods of its model were replaced: then somebody looks at it meanwhile. With any number
        the same is learned, drawn and logged, bit for bit. For models on the CPU, in a script that can be imported
        (``if __name__ == "__main__":``); with ``torch.set_num_threads(1)`` each takes one core. An algorithm of one's own may
        read and change all of its model; what else it leaves in memory stays in its process
    :param agent_kwargs: {agent: {argument: value}} for single agents, overriding ``kwargs``
    :param kwargs: further arguments of the algorithm class for all agents
    :raises TypeError: if ``env`` is no ``TeamVecEnv`` or a class no SB3 algorithm
    :raises ValueError: for unknown or missing agents, or if ``jobs`` is not a number of processes, or a model cannot use them
    """

    def __init__(
        self,
        algo_class: type[BaseAlgorithm] | Mapping[str, type[BaseAlgorithm]],
        policy: str | type[BasePolicy] | Mapping[str, str | type[BasePolicy]],
        env: VecEnv,
        seed: int | None = None,
        normalize: bool | dict[str, Any] = False,
        verbose: int = 0,
        log_dir: str | None = None,
        tensorboard_log: str | None = None,
        device: th.device | str = "auto",
        agent_kwargs: Mapping[str, Mapping[str, Any]] | None = None,
        jobs: int = 1,
        **kwargs: Any,
    ):
        check_jobs(jobs)
        scheduler = JointLoop(check_env(env))
        agents = scheduler.possible_agents
        classes, policies = per_agent("algo_class", algo_class, agents), per_agent("policy", policy, agents)
        own_kwargs = agent_kwargs or {}
        check_names("agent_kwargs", own_kwargs, agents)
        specs = {agent: (classes[agent], policies[agent], {**kwargs, **own_kwargs.get(agent, {})}) for agent in agents}
        models = AgentModels.build(specs, scheduler, seed, normalize, max(verbose - 1, 0), device)
        self._setup(scheduler, models, scheduler.scripted, seed, normalize, verbose, log_dir, tensorboard_log, jobs)
        if seed is not None:
            env.seed(seed)

    def _setup(
        self,
        scheduler: JointLoop | None,
        models: AgentModels,
        scripted: dict[str, str],
        seed: int | None,
        normalize: bool | dict[str, Any],
        verbose: int,
        log_dir: str | None,
        tensorboard_log: str | None,
        jobs: int,
    ) -> None:
        self._scheduler = scheduler
        self._models = models
        self._scripted = scripted
        self.possible_agents = list(models.models)
        self.seed = seed
        self.normalize = normalize
        self.verbose = verbose
        self.num_timesteps = 0
        self.ep_info_buffer: deque[dict[str, Any]] = deque(maxlen=100)
        self.ep_success_buffer: deque[bool] = deque(maxlen=100)
        self._log_dir, self._tensorboard_log = log_dir, tensorboard_log
        self._log: TeamLog | None = None
        self._logger: Logger | None = None
        self._stream = team_rng(seed)
        self._jobs = Jobs(models.models, models.streams, jobs)
        self._learning = False
        # False when the agents' last observations are not all those of where the environment is now
        self._can_continue = False
        self._start_time, self._start_timesteps, self._iterations = 0, 0, 0

    @property
    def agents(self) -> dict[str, BaseAlgorithm]:
        """
        :return: {agent: its model}. While the team learns with several ``jobs``, models in other processes are up to date for
            who asks here, not for who has kept them
        """
        self._jobs.look()
        return self._models.models

    @property
    def observation_space(self) -> spaces.Dict:
        """
        :return: the agents' observation spaces by agent
        """
        if self._scheduler is not None:
            return spaces.Dict(self._scheduler.observation_spaces)
        return spaces.Dict({agent: model.observation_space for agent, model in self._models.models.items()})

    @property
    def action_space(self) -> spaces.Dict:
        """
        :return: the agents' action spaces by agent
        """
        return spaces.Dict({agent: model.action_space for agent, model in self._models.models.items()})

    @property
    def logger(self) -> Logger:
        """
        :return: the team's logger, there from the first ``learn`` on
        """
        if self._logger is None:
            raise AttributeError("A Team has a logger from its first learn() on, or from set_logger().")
        return self._logger

    def set_logger(self, logger: Logger) -> None:
        """
        :param logger: for the team's table, instead of the one that ``verbose``, ``log_dir`` and ``tensorboard_log`` ask for
        """
        self._logger = logger

    def learn(
        self: SelfTeam,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 1,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
        agent_callbacks: Mapping[str, MaybeCallback] | None = None,
    ) -> SelfTeam:
        """
        Let all agents learn at once.

        Each model's own ``learn`` runs, unmodified, with these arguments. Whoever's callback returns False, all end after that
        step. An agent that reaches ``total_timesteps`` earlier than others (because of its rollout length) goes on acting
        without learning.

        :param total_timesteps: at least so many joint steps (over all copies of the environment)
        :param callback: called once per joint step with the team as its model
        :param log_interval: as each agent's algorithm takes it: iterations of on-policy ones, episodes of off-policy ones
        :param reset_num_timesteps: start counting, and new episodes; False: go on where the last ``learn`` ended (with new
            episodes only if it ended out of step: by a callback, an error, or with some agents finished before others)
        :param progress_bar: show SB3's progress bar
        :param agent_callbacks: {agent: callback} with the agent's model as its model
        :return: the team
        :raises RuntimeError: if the team is learning already
        :raises ValueError: if it has no environment, or for unknown agents
        """
        if self._learning:
            raise RuntimeError("This team is learning already: learn() cannot be called by a callback or an agent of its own.")
        scheduler = self._scheduler
        if scheduler is None:
            raise ValueError("This team has no environment to learn in: use set_env(), or Team.load(path, env=env).")
        own_callbacks = agent_callbacks or {}
        check_names("agent_callbacks", own_callbacks, self.possible_agents)
        self._learning = True
        try:
            if reset_num_timesteps:
                self.num_timesteps = 0
                self._iterations = 0
                self.ep_info_buffer.clear()
                self.ep_success_buffer.clear()
            self._start_time, self._start_timesteps = time.time_ns(), self.num_timesteps
            log = self._make_log()
            learn = partial(
                _learn,
                total_timesteps=total_timesteps,
                log_interval=log_interval,
                reset_num_timesteps=reset_num_timesteps,
            )
            tasks = {
                agent: AgentTask(
                    learn=partial(learn, model),
                    act=self._models.actor(agent).go_on,
                    stream=self._models.streams[agent],
                    callback=as_callback(own_callbacks[agent]) if own_callbacks.get(agent) is not None else None,
                )
                for agent, model in self.agents.items()
            }
            fresh = reset_num_timesteps or not self._can_continue or any(m._last_obs is None for m in self.agents.values())
            self._can_continue = False
            team_callback = as_callback(callback, progress_bar)
            progress = TeamProgress(self, team_callback, log)
            with RngSwitch(self._stream):
                if fresh:
                    for model in self.agents.values():
                        model._last_obs = None
                    scheduler.reset()
                total = total_timesteps + self.num_timesteps
                progress.on_training_start(
                    {"self": self, "total_timesteps": total, "tb_log_name": "Team", "env": scheduler.env}
                )
            with self._jobs.shared_out(scheduler, tasks, learn, team_callback) as remote_groups:
                in_step = scheduler.run(tasks, progress, self._stream, remote_groups)
            with RngSwitch(self._stream):
                progress.on_training_end()
            self._can_continue = in_step
        finally:
            self._learning = False
        return self

    def predict(
        self,
        observation: TeamObs,
        state: dict[str, PolicyState] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
        action_masks: Mapping[str, np.ndarray] | Sequence[Mapping[str, np.ndarray]] | np.ndarray | None = None,
    ) -> tuple[TeamObs, dict[str, PolicyState] | None]:
        """
        :param observation: {agent: array [n_envs, ...]}, or {agent: one observation}; normalised here if the team normalises
        :param state: recurrent states as returned by the last call, None at first
        :param episode_start: bool [n_envs]: where recurrent states start anew
        :param deterministic: the most likely actions instead of samples
        :param action_masks: {agent: bool [n_envs, k]} for models that take masks (``env.action_masks()``); or a dict of each
            copy's masks, as sb3-contrib's ``MaskableEvalCallback`` and ``evaluate_policy`` get them from the environment
        :return: {agent: action(s)} and the recurrent states (None if no agent has any)
        :raises ValueError: if an agent's observation is missing
        """
        missing = [agent for agent in self.possible_agents if agent not in observation]
        if missing:
            raise ValueError(f"No observation for {missing}; a team predicts from {{agent: observation}} of all its agents.")
        if action_masks is not None and not isinstance(action_masks, Mapping):
            action_masks = {agent: np.stack([copy[agent] for copy in action_masks]) for agent in action_masks[0]}
        self._jobs.look()
        actions: TeamObs = {}
        states: dict[str, PolicyState] = {}
        for agent in self.possible_agents:
            actions[agent], states[agent] = self._models.actor(agent).predict(
                observation[agent],
                None if state is None else state[agent],
                episode_start,
                deterministic,
                None if action_masks is None else action_masks.get(agent),
            )
        return actions, states if any(s is not None for s in states.values()) else None

    @property
    def takes_masks(self) -> bool:
        """Whether an agent's model takes action masks: then evaluate with sb3-contrib's ``MaskableEvalCallback``."""
        return any(self._models.actor(agent).takes_masks for agent in self.possible_agents)

    def save(self, path: str | os.PathLike | io.BufferedIOBase) -> None:
        """
        Save the team as one zip; ``agents/<agent>.zip`` in it are normal SB3 zips that load and predict alone.

        A file already there is replaced only when the new one is complete.

        :param path: where to (".zip" is added to a name without a suffix), or an open binary file
        """
        manifest = {
            "seed": self.seed,
            "num_timesteps": self.num_timesteps,
            "normalize": self.normalize,
            **spaces_manifest(self.observation_space, self.action_space, self.possible_agents, self._scripted),
        }
        write_team(path, self.agents, self._models.statistics, manifest)

    @classmethod
    def load(
        cls: type[SelfTeam],
        path: str | os.PathLike | io.BufferedIOBase,
        env: VecEnv | None = None,
        device: th.device | str = "auto",
        verbose: int = 0,
        log_dir: str | None = None,
        tensorboard_log: str | None = None,
        jobs: int = 1,
    ) -> SelfTeam:
        """
        :param path: of a saved team, with or without ".zip", or an open binary file
        :param env: to learn in; its number of copies may differ. None: the team can only predict
        :param device: of all models
        :param verbose: as for the constructor
        :param log_dir: as for the constructor
        :param tensorboard_log: as for the constructor
        :param jobs: as for the constructor
        :return: the team; as with SB3 the random streams start anew from its seed
        :raises FileNotFoundError: if there is no such file
        :raises ValueError: if it is damaged or no saved team, if the environment does not fit it, or for wrong ``jobs``
        """
        check_jobs(jobs)
        saved = read_team(path)
        scheduler = None if env is None else JointLoop(check_env(env))
        if scheduler is not None:
            saved.check_env(scheduler.env, scheduler.possible_agents, scheduler.scripted)
        seed = saved.manifest["seed"]
        team = cls.__new__(cls)
        models = AgentModels.load(saved, scheduler, seed=seed, device=device)
        team._setup(
            scheduler, models, saved.scripted, seed, saved.manifest["normalize"], verbose, log_dir, tensorboard_log, jobs
        )
        team.num_timesteps = saved.manifest["num_timesteps"]
        if env is not None and seed is not None:
            env.seed(seed)
        return team

    def get_env(self) -> VecEnv | None:
        """
        :return: the team's environment, if it has one
        """
        return None if self._scheduler is None else self._scheduler.env

    def set_env(self, env: VecEnv) -> None:
        """
        :param env: to learn in from now on, with the same agents, scripted others, spaces and number of copies
        :raises RuntimeError: while the team is learning
        :raises ValueError: if it does not fit
        """
        if self._learning:
            raise RuntimeError("The environment of a team cannot be changed while it learns.")
        scheduler = JointLoop(check_env(env))
        if scheduler.possible_agents != self.possible_agents:
            raise ValueError(f"The team has the agents {self.possible_agents}, the environment {scheduler.possible_agents}.")
        if list(scheduler.scripted.items()) != list(self._scripted.items()):
            raise ValueError(
                f"The team has learned with the scripted others {self._scripted}, the environment has {scheduler.scripted}."
            )
        n_envs = next(iter(self.agents.values())).n_envs
        if env.num_envs != n_envs:
            raise ValueError(
                f"The team's buffers are for {n_envs} copies, the environment has {env.num_envs}: save the team and use"
                " Team.load(path, env=env), which makes new ones."
            )
        self._models.move(scheduler)
        self._scheduler = scheduler

    def get_vec_normalize_env(self) -> VecNormalize | None:
        """
        :return: None: each agent is normalised by itself, not the environment
        """
        return None

    def dump_logs(self) -> None:
        """Write the team's table: what has been recorded, and how the episodes and the time went."""
        self._iterations += 1
        elapsed = max((time.time_ns() - self._start_time) / 1e9, sys.float_info.epsilon)
        if self.ep_info_buffer:
            self.logger.record("rollout/ep_rew_mean", safe_mean([episode["r"] for episode in self.ep_info_buffer]))
            self.logger.record("rollout/ep_len_mean", safe_mean([episode["l"] for episode in self.ep_info_buffer]))
        if self.ep_success_buffer:
            self.logger.record("rollout/success_rate", safe_mean(list(self.ep_success_buffer)))
        self.logger.record("time/iterations", self._iterations, exclude="tensorboard")
        self.logger.record("time/fps", int((self.num_timesteps - self._start_timesteps) / elapsed))
        self.logger.record("time/time_elapsed", int(elapsed), exclude="tensorboard")
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(step=self.num_timesteps)

    def _make_log(self) -> TeamLog:
        if self._log is None:
            self._log = TeamLog(self.possible_agents, self.verbose, self._log_dir, self._tensorboard_log)
            for agent, model in self.agents.items():
                self._log.connect(agent, model)
            if self._logger is None:
                self._logger = self._log.team_logger
        return self._log


def _learn(
    model: BaseAlgorithm, callback: BaseCallback, total_timesteps: int, log_interval: int | None, reset_num_timesteps: bool
) -> None:
    # None is what SB3's loops take for "never", although they do not say so
    model.learn(
        total_timesteps,
        callback=callback,
        log_interval=log_interval,  # type: ignore[arg-type]
        reset_num_timesteps=reset_num_timesteps,
    )
