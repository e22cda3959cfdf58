"""The models of a team with what goes with each of them: how they are made, loaded and moved to another environment."""

import io
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_belief.common.exceptions import add_note
from sb3_belief.common.rng import RngState, RngSwitch
from sb3_belief.team.checkpoint import SavedTeam
from sb3_belief.team.lockstep.joint_loop import JointLoop
from sb3_belief.team.predictor import Predictor

# Class, policy and further arguments of an agent's model
AgentSpec = tuple[type[BaseAlgorithm], str | type[BasePolicy], dict[str, Any]]


def agent_seed(seed: int, index: int) -> int:
    """
    The seed of an agent's model: that of its weights, its actions and its minibatches.

    :param seed: the team's
    :param index: the agent's place in ``possible_agents``
    :return: its own, in [0, 2**32): different for each agent, and the same whatever the other agents are
    """
    return int(np.random.SeedSequence(seed, spawn_key=(index,)).generate_state(1)[0])


def team_rng(seed: int | None) -> RngState:
    """
    :param seed: the team's
    :return: what the environment in this process and the team's callbacks draw from while the team learns
    """
    return RngState(None if seed is None else int(np.random.SeedSequence(seed).generate_state(1)[0]))


@dataclass
class AgentModels:
    """
    All of it by agent, in the order of ``possible_agents``.

    :param models: the models
    :param statistics: the normalisation of those that have one
    :param streams: what each draws from
    """

    models: dict[str, BaseAlgorithm] = field(default_factory=dict)
    statistics: dict[str, VecNormalize] = field(default_factory=dict)
    streams: dict[str, RngState] = field(default_factory=dict)

    @staticmethod
    def build(
        specs: Mapping[str, AgentSpec],
        scheduler: JointLoop,
        seed: int | None,
        normalize: bool | Mapping[str, Any],
        verbose: int,
        device: th.device | str,
    ) -> "AgentModels":
        """
        :param recipes: {agent: what its model is made of}
        :param hub: has the agents' environments
        :param seed: the team's
        :param normalize: True or arguments of ``VecNormalize``: normalise; False: not
        :param verbose: of the models
        :param device: of the models
        :return: new models
        :raises TypeError: if a class is not an SB3 algorithm
        """
        models = AgentModels()
        for k, (agent, (algo_class, policy, kwargs)) in enumerate(specs.items()):
            if not (isinstance(algo_class, type) and issubclass(algo_class, BaseAlgorithm)):
                raise TypeError(f"The algorithm of {agent!r} must be a class of SB3 or derived from one, got {algo_class!r}.")
            own_seed = None if seed is None else agent_seed(seed, k)
            # A copy, so that nothing is shared: SB3 writes into policy_kwargs, and action noise has a state
            arguments: dict[str, Any] = {"seed": own_seed, "device": device, "verbose": verbose, **deepcopy(kwargs)}
            env: VecEnv = scheduler.agent_envs[agent]
            if normalize is not False:
                env = models.statistics[agent] = normalized(env, normalize, arguments.get("gamma"))
            models.streams[agent] = RngState(own_seed)
            with RngSwitch(models.streams[agent]):
                try:
                    models.models[agent] = algo_class(policy, env, **arguments)
                except Exception as error:
                    add_note(error, f"Raised while the model of agent {agent!r} was made ({algo_class.__name__}).")
                    raise
        return models

    @staticmethod
    def load(saved: SavedTeam, scheduler: JointLoop | None, seed: int | None, device: th.device | str) -> "AgentModels":
        """
        :param saved: a file's contents
        :param hub: has the agents' environments; None: the models can only predict
        :param seed: the team's; the random streams start anew from it
        :param device: of the models
        :return: the saved models
        """
        models = AgentModels(statistics=saved.statistics)
        for k, agent in enumerate(saved.manifest["agents"]):
            env: VecEnv | None = None if scheduler is None else scheduler.agent_envs[agent]
            if env is not None and agent in saved.statistics:
                saved.statistics[agent].set_venv(env)
                env = saved.statistics[agent]
            models.streams[agent] = RngState(None if seed is None else agent_seed(seed, k))
            with RngSwitch(models.streams[agent]):
                file = io.BytesIO(saved.models[agent])
                models.models[agent] = saved.algo_class(agent).load(file, env=env, device=device)
        return models

    def move(self, scheduler: JointLoop) -> None:
        """
        :param hub: has the agents' environments from now on
        """
        for agent, model in self.models.items():
            env: VecEnv = scheduler.agent_envs[agent]
            if agent in self.statistics:
                # set_venv() is meant for loaded statistics and refuses to replace an environment
                self.statistics[agent].venv = None  # type: ignore[assignment]
                self.statistics[agent].set_venv(env)
                env = self.statistics[agent]
            model.set_env(env)

    def actor(self, agent: str) -> Predictor:
        """
        :param agent: name of the agent
        :return: predicts with its model, on observations as the team's environment gives them
        """
        return Predictor(self.models[agent], self.statistics.get(agent))


def normalized(env: VecEnv, normalize: bool | Mapping[str, Any], gamma: float | None) -> VecNormalize:
    """
    :param env: an agent's environment
    :param normalize: True, or arguments of ``VecNormalize``
    :param gamma: discount of the agent's algorithm, used for the returns unless ``normalize`` has one
    :return: the environment with statistics of its own; observations that are not a ``Box`` stay as they are
    """
    arguments = {} if normalize is True else dict(normalize)  # type: ignore[arg-type]
    if gamma is not None:
        arguments.setdefault("gamma", gamma)
    if not isinstance(env.observation_space, spaces.Box):
        arguments["norm_obs"] = False
    return VecNormalize(env, **arguments)
