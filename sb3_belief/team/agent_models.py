"""The models of a team with what belongs to each of them: how they are built, loaded and moved to another environment."""

from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_belief.common.exceptions import add_note
from sb3_belief.common.rng import RngState, RngSwitch
from sb3_belief.team.arguments import as_callback, check_agent_keys
from sb3_belief.team.checkpoint import SavedTeam
from sb3_belief.team.finite import UpdateGuard
from sb3_belief.team.lockstep.joint_loop import JointLoop
from sb3_belief.team.lockstep.scheduler import AgentTask, SyncCallback
from sb3_belief.team.normalization import AgentNormalize
from sb3_belief.team.predictor import Predictor
from sb3_belief.team.sb3_protocol import algorithm_arguments


class AgentSpec(NamedTuple):
    """
    What an agent's model is built from.

    :param algo_class: Class of the algorithm
    :param policy: Its policy, a name or a class
    :param kwargs: Further arguments of the algorithm
    """

    algo_class: type[BaseAlgorithm]
    policy: str | type[BasePolicy]
    kwargs: dict[str, Any]


class LoadOptions(NamedTuple):
    """
    How saved models are loaded, as for SB3's ``load``.

    :param device: Of the models
    :param custom_objects: What replaces saved attributes
    :param print_system_info: Whether to print versions
    :param kwargs: Arguments that replace the saved ones
    :param agent_kwargs: Those of single agents, which override ``kwargs``
    """

    device: th.device | str = "auto"
    custom_objects: dict[str, Any] | None = None
    print_system_info: bool = False
    kwargs: Mapping[str, Any] = MappingProxyType({})
    agent_kwargs: Mapping[str, Mapping[str, Any]] = MappingProxyType({})

    def arguments(self, agent: str, algo_class: type[BaseAlgorithm]) -> dict[str, Any]:
        """
        Return the arguments of an agent's algorithm that replace the saved ones.

        :param agent: Name of the agent
        :param algo_class: Class of its model
        :return: The arguments
        :raises TypeError: If the class has no such argument, which SB3 would not notice
        """
        own = {**self.kwargs, **self.agent_kwargs.get(agent, {})}
        known = algorithm_arguments(algo_class) - {"policy", "env"}
        unknown = [name for name in own if name not in known]
        if unknown:
            raise TypeError(
                f"{algo_class.__name__}, the algorithm of {agent!r}, has no arguments {unknown} that load() could replace; it"
                f" has {sorted(known)}. Arguments of single agents are given in agent_kwargs."
            )
        return own


def agent_seed(seed: int, index: int) -> int:
    """
    Return the seed of an agent's model: of its weights, its actions and its minibatches.

    :param seed: The team's seed
    :param index: The agent's place in ``possible_agents``
    :return: Its own seed, in [0, 2**32): different for each agent, and the same whatever the other agents are
    """
    return int(np.random.SeedSequence(seed, spawn_key=(index,)).generate_state(1)[0])


def env_seed(seed: int, purpose: int = 0, step: int | None = None) -> int:
    """
    Return the seed of a team's environment, whose copy i then has this seed + i, as in SB3.

    SB3 itself gives copy i the seed s + i, so that runs with neighbouring seeds s play nearly the same episodes. These are far
    apart.

    :param seed: The team's seed
    :param purpose: 0 for training, 1 for an environment of evaluations that is to have other episodes, 2 for episodes that
        begin with a checkpoint, 3 for the final evaluations of a study, 4 for episodes that agents observe to adapt, 5 for
        those that are evaluated then
    :param step: The joint step at which the environment is seeded, for one that is seeded again; None before the first
    :return: The environment's seed, in [0, 2**30)
    """
    # Spawn keys of two numbers or three, since those of the agents have one
    key = (0, purpose) if step is None else (0, purpose, step)
    return int(np.random.SeedSequence(seed, spawn_key=key).generate_state(1)[0] >> 2)


def team_rng(seed: int | None) -> RngState:
    """
    Return the random number generators of the environment in this process and of the team's callbacks.

    :param seed: The team's seed, or None
    """
    return rng_state(None if seed is None else int(np.random.SeedSequence(seed).generate_state(1)[0]))


def rng_state(seed: int | None) -> RngState:
    """
    Return random number generators.

    :param seed: Their seed. None to derive them from the global ones, which the caller may have seeded
    """
    return RngState.from_global() if seed is None else RngState(seed)


@dataclass
class AgentModels:
    """
    What a team holds of its agents, each dict in the order of ``possible_agents``.

    :param models: The models
    :param statistics: The normalisation of the agents that have one
    :param rngs: The random number generators
    """

    models: dict[str, BaseAlgorithm] = field(default_factory=dict)
    statistics: dict[str, VecNormalize] = field(default_factory=dict)
    rngs: dict[str, RngState] = field(default_factory=dict)

    @staticmethod
    def build(
        specs: Mapping[str, AgentSpec],
        loop: JointLoop,
        seed: int | None,
        normalize: bool | Mapping[str, Any],
        verbose: int,
        device: th.device | str,
    ) -> "AgentModels":
        """
        Build new models.

        :param specs: What each agent's model is built from
        :param loop: Has the agents' environments
        :param seed: The team's seed
        :param normalize: True or arguments of ``VecNormalize`` to normalise, False not to
        :param verbose: Of the models
        :param device: Of the models
        :return: The models
        :raises TypeError: If a class is not an SB3 algorithm
        """
        agents = AgentModels()
        for k, (agent, spec) in enumerate(specs.items()):
            algo_class = spec.algo_class
            if not (isinstance(algo_class, type) and issubclass(algo_class, BaseAlgorithm)):
                raise TypeError(f"The algorithm of {agent!r} must be a class of SB3 or derived from one, got {algo_class!r}.")
            own_seed = None if seed is None else agent_seed(seed, k)
            # A copy, so that nothing is shared: SB3 writes into policy_kwargs, and action noise has a state
            arguments: dict[str, Any] = {"seed": own_seed, "device": device, "verbose": verbose, **deepcopy(spec.kwargs)}
            env: VecEnv = loop.agent_envs[agent]
            if normalize is not False:
                env = agents.statistics[agent] = normalized(env, normalize, arguments.get("gamma"))
            agents.rngs[agent] = rng_state(own_seed)
            with RngSwitch(agents.rngs[agent]):
                try:
                    agents.models[agent] = algo_class(spec.policy, env, **arguments)
                except Exception as error:
                    add_note(error, f"Raised while the model of agent {agent!r} was made ({algo_class.__name__}).")
                    raise
        return agents

    @staticmethod
    def load(saved: SavedTeam, loop: JointLoop | None, seed: int | None, options: LoadOptions) -> "AgentModels":
        """
        Load saved models. Their random number generators start anew from the seed.

        :param saved: The contents of a file
        :param loop: Has the agents' environments; None for models that only predict
        :param seed: The team's seed
        :param options: How the models are loaded
        :return: The models
        :raises TypeError: If an algorithm has no argument of a name that is given
        :raises ValueError: If agents are unknown
        """
        statistics = saved.statistics
        agents = AgentModels(statistics=statistics)
        names = saved.manifest["agents"]
        check_agent_keys("agent_kwargs", options.agent_kwargs, names)
        classes = {agent: saved.algo_class(agent) for agent in names}
        arguments = {agent: options.arguments(agent, algo_class) for agent, algo_class in classes.items()}
        for k, agent in enumerate(names):
            env: VecEnv | None = None if loop is None else loop.agent_envs[agent]
            if env is not None and agent in statistics:
                statistics[agent].set_venv(env)
                env = statistics[agent]
            own_seed = None if seed is None else agent_seed(seed, k)
            if seed != saved.manifest["seed"]:
                arguments[agent].setdefault("seed", own_seed)
            agents.rngs[agent] = rng_state(own_seed)
            with RngSwitch(agents.rngs[agent]):
                agents.models[agent] = saved.load_model(
                    agent,
                    env=env,
                    device=options.device,
                    custom_objects=options.custom_objects,
                    # Of one model: that of the others is the same
                    print_system_info=options.print_system_info and k == 0,
                    **arguments[agent],
                )
        return agents

    def move(self, loop: JointLoop) -> None:
        """
        Give all models another environment.

        :param loop: Has the agents' environments from now on
        """
        for agent, model in self.models.items():
            env: VecEnv = loop.agent_envs[agent]
            if agent in self.statistics:
                # set_venv() is meant for loaded statistics and refuses to replace an environment
                self.statistics[agent].venv = None  # type: ignore[assignment]
                self.statistics[agent].set_venv(env)
                env = self.statistics[agent]
            model.set_env(env)

    def tasks(self, learn: Callable[..., None], callbacks: Mapping[str, MaybeCallback]) -> dict[str, AgentTask]:
        """
        Return the tasks that a scheduler runs.

        :param learn: Runs a model's ``learn()``, called with the model and a callback
        :param callbacks: Callbacks of single agents
        :return: One task for each agent
        """
        return {
            agent: AgentTask(
                learn=partial(learn, model),
                act=self.predictor(agent).act,
                rng=self.rngs[agent],
                callback=as_callback(callbacks[agent]) if callbacks.get(agent) is not None else None,
            )
            for agent, model in self.models.items()
        }

    def predictor(self, agent: str) -> Predictor:
        """
        Return a predictor of the agent's model.

        :param agent: Name of the agent
        """
        return Predictor(self.models[agent], self.statistics.get(agent))


def run_learn(
    model: BaseAlgorithm,
    callback: SyncCallback,
    total_timesteps: int,
    log_interval: int | None,
    reset_num_timesteps: bool,
    on_nan: str,
) -> None:
    """
    Run a model's own ``learn``, in this process or in a worker.

    :param model: Of an agent
    :param callback: Waits for the other agents
    :param total_timesteps: As in ``Team.learn``
    :param log_interval: As in ``Team.learn``
    :param reset_num_timesteps: As in ``Team.learn``
    :param on_nan: As in ``Team``
    """
    guard = callback.update_check = UpdateGuard(callback.agent, model, on_nan)
    try:
        model.learn(
            total_timesteps,
            callback=callback,
            # SB3's loops take None for "never", although their signatures do not say so
            log_interval=log_interval,  # type: ignore[arg-type]
            reset_num_timesteps=reset_num_timesteps,
        )
    except Exception as error:
        guard.explain(error)
        raise
    finally:
        guard.disarm()


def normalized(env: VecEnv, normalize: bool | Mapping[str, Any], gamma: float | None) -> VecNormalize:
    """
    Wrap an agent's environment in a ``VecNormalize`` with statistics of its own.

    :param env: The agent's environment
    :param normalize: True, or arguments of ``VecNormalize``
    :param gamma: Discount of the agent's algorithm, used for the returns unless ``normalize`` has one
    :return: The wrapped environment; observations that are not a ``Box`` stay as they are, and so do such entries of a
        ``Dict``, images and entries that ``norm_obs_keys`` leaves out
    """
    arguments = dict(normalize) if isinstance(normalize, Mapping) else {}
    if gamma is not None:
        arguments.setdefault("gamma", gamma)
    chosen, space = arguments.pop("norm_obs_keys", None), env.observation_space
    if isinstance(space, spaces.Dict):
        arguments["norm_obs_keys"] = [
            key
            for key, part in space.spaces.items()
            if isinstance(part, spaces.Box) and not is_image_space(part) and (chosen is None or key in chosen)
        ]
    if not (isinstance(space, spaces.Box) or arguments.get("norm_obs_keys")):
        arguments["norm_obs"] = False
        arguments.pop("norm_obs_keys", None)
    return AgentNormalize(env, **arguments)
