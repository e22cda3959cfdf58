"""A team of independent SB3 models that learns in one environment and follows SB3's own model protocol."""

import io
import os
import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from typing import Any, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_belief.common.rng import RngSwitch, global_rngs_of_this_thread
from sb3_belief.common.safe_files.trust import Trust
from sb3_belief.team.agent_models import AgentModels, AgentSpec, LoadOptions, env_seed, run_learn, team_rng
from sb3_belief.team.arguments import as_callback, check_agent_keys, check_learners, check_team_vec_env, per_agent
from sb3_belief.team.callbacks import check_callbacks
from sb3_belief.team.checkpoint import read_team, spaces_manifest, write_team
from sb3_belief.team.exact import ExactTraining, check_exact_load
from sb3_belief.team.finite import check_on_nan
from sb3_belief.team.lockstep.joint_loop import JointLoop, TeamProgress
from sb3_belief.team.logs import TeamLog
from sb3_belief.team.masks import MaskCheck
from sb3_belief.team.parallel import ParallelLearning, check_jobs
from sb3_belief.team.partners.vec_env import Partners, with_partners
from sb3_belief.team.predictor import PolicyState, TeamPredictor
from sb3_belief.team.sb3_protocol import SB3Protocol
from sb3_belief.vec_env.team_vec_env import TeamObs

SelfTeam = TypeVar("SelfTeam", bound="Team")


class Team(SB3Protocol):
    """
    One SB3 model for each agent of a team, all learning at once in one vectorised environment.

    The models are unmodified SB3 ones and share nothing: weights, buffers, normalisation, loggers and random number generators
    are each agent's own. With ``seed=s`` the environment is seeded with ``env_seed(s)``, so that runs with neighbouring seeds
    play different episodes, and agent k's model with ``agent_seed(s, k)``, so that equal networks start differently and no
    agent's learning depends on how many random numbers another draws. Policies of equal shape make their forward passes in
    one batch, with the same result to the bit. One timestep is one joint step of one copy of the environment.

    ``learn``, ``predict``, ``save``, ``load``, ``set_env``, ``get_env``, ``num_timesteps``, ``logger`` and more are those of
    an SB3 model, so ``evaluate_policy`` and SB3's callbacks take a team as it is. What all agents have in common is read like
    a model's (``team.learning_rate``); it is set on the agents' models.

    :param algo_class: Class of SB3, sb3-contrib or this package for all agents, or a dict of one for each agent
    :param policy: Policy of that class for all agents, or a dict of one for each agent
    :param env: A ``TeamVecEnv`` (see ``make_team_env``) or SB3 wrappers around one
    :param seed: Seed of the environment and all models; None to leave the environment unseeded and have the models' random
        numbers follow from the global generators, which ``set_random_seed(s)`` of SB3 seeds
    :param normalize: True or arguments of ``VecNormalize`` to normalise each agent's observations and rewards by running
        statistics of its own, in which steps out of play do not count; False not to
    :param verbose: 1 prints one table per iteration, 2 also what the models themselves print
    :param log_dir: Folder of the CSV logs ``progress.csv`` (the team) and ``agents/<agent>/progress.csv``; None for no CSV
        logs
    :param tensorboard_log: Folder of the TensorBoard logs ``Team_<k>`` and ``Team_<k>/agents/<agent>``; None for none
    :param device: Device of all models
    :param jobs: Number of processes, the main one included, among which the agents with on-policy algorithms (PPO, A2C, ...)
        are divided; each agent learns wholly in one of them. What is learned, drawn and logged is the same for any number, bit
        for bit. An agent whose model may be looked at meanwhile (it has a callback of its own, or some of its methods were
        replaced) learns in the main process, and so do all agents, with a warning, if the team has a callback that is not from
        SB3 or sb3-contrib. For models on the CPU, in a script that can be imported (``if __name__ == "__main__":``); with
        ``torch.set_num_threads(1)`` each process takes one core
    :param on_nan: What is done when an update makes loss or parameters of an agent non-finite: ``"raise"`` puts back the last
        finite ones and stops with a ``NonFiniteError``, ``"skip"`` takes the update back, warns and goes on
    :param partners: Partners (see ``PartnersVecEnv``) or pools of them (``PartnerPool``) by agent. These agents act and do not
        learn, all others are the team. They are not saved with it
    :param agent_kwargs: Arguments of single agents' algorithms by agent, which override ``kwargs``
    :param kwargs: Further arguments of the algorithm class for all agents
    :raises TypeError: If ``env`` is no ``TeamVecEnv`` or a class no SB3 algorithm
    :raises ValueError: If agents are unknown or missing, if ``jobs`` is not a number of processes, ``on_nan`` unknown, or if
        a model cannot learn in another process
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
        on_nan: str = "raise",
        partners: Partners | None = None,
        **kwargs: Any,
    ):
        check_jobs(jobs)
        check_on_nan(on_nan)
        env = with_partners(check_team_vec_env(env), partners)
        check_learners(partners or (), algo_class=algo_class, policy=policy, agent_kwargs=agent_kwargs)
        loop = JointLoop(env)
        names = loop.possible_agents
        classes, policies = per_agent("algo_class", algo_class, names), per_agent("policy", policy, names)
        own_kwargs = agent_kwargs or {}
        check_agent_keys("agent_kwargs", own_kwargs, names)
        specs = {name: AgentSpec(classes[name], policies[name], {**kwargs, **own_kwargs.get(name, {})}) for name in names}
        agents = AgentModels.build(specs, loop, seed, normalize, max(verbose - 1, 0), device)
        self._setup(loop, agents, loop.scripted, seed, normalize, verbose, log_dir, tensorboard_log, jobs, on_nan)
        if seed is not None:
            env.seed(env_seed(seed))

    def _setup(
        self,
        loop: JointLoop | None,
        agents: AgentModels,
        scripted: dict[str, str],
        seed: int | None,
        normalize: bool | dict[str, Any],
        verbose: int,
        log_dir: str | None,
        tensorboard_log: str | None,
        jobs: int,
        on_nan: str,
    ) -> None:
        self._loop = loop
        self._agents = agents
        self._predictor = TeamPredictor(agents.models, agents.statistics, scripted)
        self._scripted = scripted
        self.possible_agents = list(agents.models)
        self.seed = seed
        self.normalize = normalize
        self.verbose, self.on_nan = verbose, on_nan
        self.num_timesteps = 0
        windows = {model._stats_window_size for model in agents.models.values()}
        # Agents with windows of their own leave the team SB3's
        self._stats_window_size = windows.pop() if len(windows) == 1 else 100
        self.ep_info_buffer: deque[dict[str, Any]] = deque(maxlen=self._stats_window_size)
        self.ep_success_buffer: deque[bool] = deque(maxlen=self._stats_window_size)
        self._log_dir, self.tensorboard_log = log_dir, tensorboard_log
        self._log: TeamLog | None = None
        self._logger: Logger | None = None
        self._rng = team_rng(seed)
        self._exact = ExactTraining(self, agents, self._rng)
        self._parallel = ParallelLearning(agents.models, agents.rngs, jobs)
        self._learning = False
        # Whether all agents' last observations are those of the environment's present state
        self._can_continue = False
        self._start_time, self._start_timesteps, self._iterations = 0, 0, 0

    @property
    def agents(self) -> dict[str, BaseAlgorithm]:
        """
        The models by agent.

        While the team learns with several ``jobs``, asking for them brings those in other processes up to date. A reference
        that was kept from before is not updated.
        """
        self._parallel.sync_models()
        return self._agents.models

    def learn(
        self: SelfTeam,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 1,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
        agent_callbacks: Mapping[str, MaybeCallback] | None = None,
    ) -> SelfTeam:
        """
        Let all agents learn at once.

        Each model's own ``learn`` runs, unmodified, with these arguments. If any callback returns False, all agents stop after
        that step. An agent that reaches ``total_timesteps`` earlier than others (because of its rollout length) continues to
        act without learning.

        :param total_timesteps: Least number of joint steps, over all copies of the environment
        :param callback: Called once per joint step with the team as its model
        :param log_interval: As each agent's algorithm takes it: iterations of on-policy ones, episodes of off-policy ones
        :param tb_log_name: Name of the TensorBoard run, by default "Team"; it keeps the name of the first ``learn``
        :param reset_num_timesteps: True starts counting, and new episodes; False continues where the last ``learn`` ended
            (with new episodes only if it ended out of step: by a callback, an error, or with some agents finished before
            others)
        :param progress_bar: Whether to show SB3's progress bar
        :param agent_callbacks: Callbacks of single agents by agent, each with the agent's model as its model
        :return: The team
        :raises RuntimeError: If the team is learning already, or if another does in another thread
        :raises ValueError: If it has no environment, if agents are unknown, if the run has another name already, if something
            was set on the team that belongs to its models, if the ``EvalCallback`` of an agent has another's environment, or
            if a team that was loaded to go on exactly is to begin anew
        """
        if self._learning:
            raise RuntimeError("This team is learning already: learn() cannot be called by a callback or an agent of its own.")
        loop = self._loop
        if loop is None:
            raise ValueError("This team has no environment to learn in: use set_env(), or Team.load(path, env=env).")
        own_callbacks = agent_callbacks or {}
        team_callback = as_callback(callback, progress_bar)
        check_callbacks(self._agents.models, bool(self._agents.statistics), team_callback, own_callbacks)
        self.check_learn(total_timesteps)
        self._exact.check_learn(reset_num_timesteps)
        self._parallel.begin(reset_num_timesteps)
        with self._exclusively():
            log = self._make_log(tb_log_name)
            if reset_num_timesteps:
                self.num_timesteps = 0
                self._iterations = 0
                self.ep_info_buffer.clear()
                self.ep_success_buffer.clear()
            self._start_time, self._start_timesteps = time.time_ns(), self.num_timesteps
            learn = partial(
                run_learn,
                total_timesteps=total_timesteps,
                log_interval=log_interval,
                reset_num_timesteps=reset_num_timesteps,
                on_nan=self.on_nan,
            )
            tasks = self._agents.tasks(learn, own_callbacks)
            fresh = reset_num_timesteps or not self._can_continue or any(m._last_obs is None for m in self.agents.values())
            self._can_continue = False
            loop.at_first_rollout = partial(self._exact.at_first_rollout, loop, log)
            with self.shown_arguments():
                progress = TeamProgress(self, team_callback, log)
            with RngSwitch(self._rng) as rngs:
                if not self._exact.begin(loop, team_callback, rngs) and fresh:
                    for model in self.agents.values():
                        model._last_obs = None
                    loop.reset()
                total = total_timesteps + self.num_timesteps
                progress.on_training_start(
                    {"self": self, "total_timesteps": total, "tb_log_name": log.run_name, "env": loop.env}
                )
            loop.mask_check = MaskCheck(self._agents.models, loop.masks)
            with self._parallel.distribute(loop, tasks, learn, team_callback) as groups:
                in_step = loop.run(tasks, progress, self._rng, groups)
            with RngSwitch(self._rng):
                progress.on_training_end()
            self._can_continue = in_step
        return self

    @contextmanager
    def _exclusively(self) -> Iterator[None]:
        with global_rngs_of_this_thread():
            self._learning = True
            try:
                yield
            finally:
                self._learning = False

    def predict(
        self,
        observation: TeamObs,
        state: dict[str, PolicyState] | None = None,
        episode_start: np.ndarray | Mapping[str, np.ndarray] | None = None,
        deterministic: bool = False,
        action_masks: Mapping[str, np.ndarray] | Sequence[Mapping[str, np.ndarray]] | np.ndarray | None = None,
    ) -> tuple[TeamObs, dict[str, PolicyState] | None]:
        """
        Predict the actions of all agents, or of those that are still in play.

        So PettingZoo's own loop works: ``actions, state = team.predict(observations, state)`` for as long as ``env.agents``.

        :param observation: Observations by agent, ``[n_envs, ...]`` or a single one each, of all agents or some of them;
            normalised here if the team is
        :param state: Recurrent states as returned by the last call, None at first
        :param episode_start: Where recurrent states start anew, bool ``[n_envs]``, for all agents or by agent. For all, they
            also start anew where an agent's own life has ended, which observations of a ``TeamVecEnv`` say
        :param deterministic: Whether to take the most likely actions instead of samples
        :param action_masks: Masks by agent, bool ``[n_envs, k]``, for models that take masks (``env.action_masks()``); or a
            sequence of each copy's masks, as sb3-contrib's ``MaskableEvalCallback`` and ``evaluate_policy`` pass them on
        :return: Action(s) of the agents that were given, and the recurrent states of all agents, in which absent ones keep
            theirs (None if no agent has any)
        :raises ValueError: If an agent is unknown
        """
        self._parallel.sync_models()
        # While a team learns, its policies are in the hands of one thread
        with global_rngs_of_this_thread() if self._learning else nullcontext():
            return self._predictor.predict(observation, state, episode_start, deterministic, action_masks)

    @property
    def takes_masks(self) -> bool:
        """Whether a model takes action masks: then evaluate with sb3-contrib's ``MaskableEvalCallback``."""
        return self._predictor.takes_masks

    def save(self, path: str | os.PathLike | io.BufferedIOBase, exact: bool = False) -> None:
        """
        Save the team as one zip. Each ``agents/<agent>.zip`` in it is a normal SB3 zip that loads and predicts alone.

        An existing file is replaced only when the new one is complete.

        :param path: Path of the file (".zip" is added to a name without a suffix), or an open binary file
        :param exact: Whether to save all that decides how the training goes on, so that ``Team.load(path, env, exact=True)``
            resumes it bit for bit: in the ``_on_rollout_start()`` of a team's callback, or after ``learn()``
        :raises ValueError: If that is asked for elsewhere, if something of a model is not finite, or if a worker process
            (``jobs``) ended before its agents' models had come back, so that they are behind the others
        """
        # First, since an environment without a readable state begins new episodes
        state = self._exact.read(self._loop, self._learning, self._can_continue, self._log).parts() if exact else {}
        manifest = {
            "seed": self.seed,
            "num_timesteps": self.num_timesteps,
            "normalize": self.normalize,
            **spaces_manifest(self.observation_space, self.action_space, self.possible_agents, self._scripted),
        }
        write_team(path, self._parallel.models_to_save(), self._agents.statistics, manifest, state)

    @classmethod
    def load(
        cls: type[SelfTeam],
        path: str | os.PathLike | io.BufferedIOBase,
        env: VecEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        verbose: int = 0,
        log_dir: str | None = None,
        tensorboard_log: str | None = None,
        agent_kwargs: Mapping[str, Mapping[str, Any]] | None = None,
        jobs: int = 1,
        on_nan: str = "raise",
        exact: bool = False,
        trust_pickle: bool = False,
        allow_packages: Iterable[str] = (),
        partners: Partners | None = None,
        **kwargs: Any,
    ) -> SelfTeam:
        """
        Load a saved team, running nothing of whoever made it. Random numbers start anew from its seed, unless ``exact``.

        :param path: Path of a saved team, with or without ".zip", or an open binary file
        :param env: Environment to learn in, whose number of copies may differ; None for a team that can only predict
        :param device: As in the constructor
        :param custom_objects: As for each of the models: what replaces saved attributes
        :param print_system_info: Whether to print the versions with which the team was saved, and the present ones
        :param verbose: As in the constructor
        :param log_dir: As in the constructor
        :param tensorboard_log: As in the constructor
        :param agent_kwargs: Arguments of single agents' algorithms by agent, which override ``kwargs``
        :param jobs: As in the constructor
        :param on_nan: As in the constructor
        :param exact: Whether the next ``learn(..., reset_num_timesteps=False)`` goes on bit for bit where the team was saved
            with ``exact=True``: episodes, random numbers, buffers, logs, and callbacks if the same ones are given in the same
            order. Its ``total_timesteps`` are the remaining ones, and ``env`` is made by the same arguments
        :param trust_pickle: Whether to read pickles (older files, functions), which can run any code of whoever made the file
        :param allow_packages: Packages of your own of which the file may name classes and functions
        :param partners: As in the constructor; ``trust_pickle`` and ``allow_packages`` hold for their files, too
        :param kwargs: Arguments of the algorithms that replace the saved ones (``learning_rate=1e-5``), and ``seed``, which
            replaces that of the team
        :return: The team
        :raises FileNotFoundError: If there is no such file
        :raises TypeError: If an agent's algorithm has no argument of that name
        :raises ValueError: If it is damaged, no team or not trusted, or the environment or an argument does not fit
        """
        check_jobs(jobs)
        check_on_nan(on_nan)
        if exact:
            check_exact_load(env, {**kwargs, **(agent_kwargs or {})})
        trust = Trust.of(trust_pickle, allow_packages)
        saved = read_team(path, trust)
        env = None if env is None else with_partners(check_team_vec_env(env), partners, trust)
        loop = None if env is None else JointLoop(env)
        if loop is not None:
            saved.check_env(loop.env, loop.possible_agents, loop.scripted)
        manifest = saved.manifest
        options = LoadOptions(device, custom_objects, print_system_info, kwargs, agent_kwargs or {})
        seed = kwargs.pop("seed", manifest["seed"])
        team = cls.__new__(cls)
        agents = AgentModels.load(saved, loop, seed, options)
        team._setup(loop, agents, saved.scripted, seed, manifest["normalize"], verbose, log_dir, tensorboard_log, jobs, on_nan)
        team.num_timesteps = manifest["num_timesteps"]
        if exact:
            team._exact.load(saved, loop)
        elif env is not None and seed is not None:
            env.seed(env_seed(seed))
        return team

    @property
    def exact_needs_reset(self) -> bool:
        """Whether the environment's state cannot be saved, so that ``save(exact=True)`` begins new episodes."""
        return self._loop is not None and self._exact.needs_reset(self._loop)

    @property
    def monitor_state(self) -> dict[str, Any] | None:
        """How far the monitor files were when the team was saved, for ``start_monitor``; until the team learns."""
        return self._exact.monitor_state
