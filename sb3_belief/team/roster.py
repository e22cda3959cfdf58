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

from sb3_belief.team.acting import Actor
from sb3_belief.team.lockstep import Lockstep
from sb3_belief.team.notes import add_note
from sb3_belief.team.saving import SavedTeam
from sb3_belief.team.streams import RandomStream, StreamSwitch

# Class, policy and further arguments of an agent's model
Recipe = tuple[type[BaseAlgorithm], str | type[BasePolicy], dict[str, Any]]


def agent_seed(seed: int, index: int) -> int:
    """
    The seed of an agent's model: that of its weights, its actions and its minibatches.

    :param seed: the team's
    :param index: the agent's place in ``possible_agents``
    :return: its own, in [0, 2**32): different for each agent, and the same whatever the other agents are
    """
    return int(np.random.SeedSequence(seed, spawn_key=(index,)).generate_state(1)[0])


def team_stream(seed: int | None) -> RandomStream:
    """
    :param seed: the team's
    :return: what the environment in this process and the team's callbacks draw from while the team learns
    """
    return RandomStream(None if seed is None else int(np.random.SeedSequence(seed).generate_state(1)[0]))


@dataclass
class Roster:
    """
    All of it by agent, in the order of ``possible_agents``.

    :param models: the models
    :param statistics: the normalisation of those that have one
    :param streams: what each draws from
    """

    models: dict[str, BaseAlgorithm] = field(default_factory=dict)
    statistics: dict[str, VecNormalize] = field(default_factory=dict)
    streams: dict[str, RandomStream] = field(default_factory=dict)

    @staticmethod
    def build(
        recipes: Mapping[str, Recipe],
        hub: Lockstep,
        seed: int | None,
        normalize: bool | Mapping[str, Any],
        verbose: int,
        device: th.device | str,
    ) -> "Roster":
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
        roster = Roster()
        for k, (agent, (algo_class, policy, kwargs)) in enumerate(recipes.items()):
            if not (isinstance(algo_class, type) and issubclass(algo_class, BaseAlgorithm)):
                raise TypeError(f"The algorithm of {agent!r} must be a class of SB3 or derived from one, got {algo_class!r}.")
            own_seed = None if seed is None else agent_seed(seed, k)
            # A copy, so that nothing is shared: SB3 writes into policy_kwargs, and action noise has a state
            arguments: dict[str, Any] = {"seed": own_seed, "device": device, "verbose": verbose, **deepcopy(kwargs)}
            env: VecEnv = hub.agent_envs[agent]
            if normalize is not False:
                env = roster.statistics[agent] = normalized(env, normalize, arguments.get("gamma"))
            roster.streams[agent] = RandomStream(own_seed)
            with StreamSwitch(roster.streams[agent]):
                try:
                    roster.models[agent] = algo_class(policy, env, **arguments)
                except Exception as error:
                    add_note(error, f"Raised while the model of agent {agent!r} was made ({algo_class.__name__}).")
                    raise
        return roster

    @staticmethod
    def load(saved: SavedTeam, hub: Lockstep | None, seed: int | None, device: th.device | str) -> "Roster":
        """
        :param saved: a file's contents
        :param hub: has the agents' environments; None: the models can only predict
        :param seed: the team's; the random streams start anew from it
        :param device: of the models
        :return: the saved models
        """
        roster = Roster(statistics=saved.statistics)
        for k, agent in enumerate(saved.manifest["agents"]):
            env: VecEnv | None = None if hub is None else hub.agent_envs[agent]
            if env is not None and agent in saved.statistics:
                saved.statistics[agent].set_venv(env)
                env = saved.statistics[agent]
            roster.streams[agent] = RandomStream(None if seed is None else agent_seed(seed, k))
            with StreamSwitch(roster.streams[agent]):
                file = io.BytesIO(saved.models[agent])
                roster.models[agent] = saved.algo_class(agent).load(file, env=env, device=device)
        return roster

    def move(self, hub: Lockstep) -> None:
        """
        :param hub: has the agents' environments from now on
        """
        for agent, model in self.models.items():
            env: VecEnv = hub.agent_envs[agent]
            if agent in self.statistics:
                # set_venv() is meant for loaded statistics and refuses to replace an environment
                self.statistics[agent].venv = None  # type: ignore[assignment]
                self.statistics[agent].set_venv(env)
                env = self.statistics[agent]
            model.set_env(env)

    def actor(self, agent: str) -> Actor:
        """
        :param agent: name of the agent
        :return: predicts with its model, on observations as the team's environment gives them
        """
        return Actor(self.models[agent], self.statistics.get(agent))


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
