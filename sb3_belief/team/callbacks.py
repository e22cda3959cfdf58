"""What a team looks for in the callbacks that it is given."""

import warnings
from collections.abc import Mapping

from sb3_contrib.common.maskable.callbacks import MaskableEvalCallback
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback
from stable_baselines3.common.type_aliases import MaybeCallback

from sb3_belief.team.arguments import as_callback, check_agent_keys
from sb3_belief.team.own_code import callbacks_within
from sb3_belief.team.predictor import takes_masks


def check_callbacks(
    models: Mapping[str, BaseAlgorithm],
    is_normalised: bool,
    callback: BaseCallback,
    agent_callbacks: Mapping[str, MaybeCallback],
) -> None:
    """
    Check callbacks before a team learns, and warn of what they will not do.

    :param models: The models by agent
    :param is_normalised: Whether an agent is normalised
    :param callback: Of the team
    :param agent_callbacks: Of single agents
    :raises ValueError: If agents are unknown, or if the ``EvalCallback`` of an agent has the environment of another
    """
    check_agent_keys("agent_callbacks", agent_callbacks, list(models))
    for agent, own in agent_callbacks.items():
        _check_agent_callback(agent, models[agent], as_callback(own))
        _warn_of_unmasked_evaluation({agent: models[agent]}, as_callback(own))
    _warn_of_unmasked_evaluation(models, callback)
    _warn_of_checkpoints(callback, is_normalised)


def _check_agent_callback(agent: str, model: BaseAlgorithm, callback: BaseCallback) -> None:
    """
    Check that evaluations of a single agent have an environment for a single agent.

    :param agent: Name of the agent
    :param model: Its model
    :param callback: Its callback
    :raises ValueError: If the environment of an ``EvalCallback`` has other spaces than the agent
    """
    for each in callbacks_within(callback):
        if isinstance(each, EvalCallback) and each.eval_env.observation_space != model.observation_space:
            raise ValueError(
                f"The {type(each).__name__} of {agent!r} has an environment with the observation space"
                f" {each.eval_env.observation_space}, in which its model, of {model.observation_space}, cannot act: one agent"
                f" is evaluated in an AgentEnv(parallel_env, {agent!r}, partners), where for instance the others of"
                " team.agents are the partners; the whole team in the callback that learn() takes for the team."
            )


def _warn_of_checkpoints(callback: BaseCallback, is_normalised: bool) -> None:
    """
    Say where the statistics of a normalised team are, if a ``CheckpointCallback`` is to save them.

    :param callback: Of the team
    :param is_normalised: Whether an agent is normalised
    """
    for each in callbacks_within(callback):
        if is_normalised and isinstance(each, CheckpointCallback) and each.save_vecnormalize:
            warnings.warn(
                "CheckpointCallback(save_vecnormalize=True) writes no file of its own for a Team: each agent's statistics are"
                " in the team's zip (agents/<agent>.vecnormalize.json), and Team.load() restores them."
            )


def _warn_of_unmasked_evaluation(models: Mapping[str, BaseAlgorithm], callback: BaseCallback) -> None:
    """
    Warn of evaluations in which models act without the masks that they are trained with.

    :param models: The models that the callback evaluates, by agent
    :param callback: Of the team, or of a single agent
    """
    masked = [agent for agent, model in models.items() if takes_masks(model)]
    for each in callbacks_within(callback):
        if masked and isinstance(each, EvalCallback) and not isinstance(each, MaskableEvalCallback):
            warnings.warn(
                f"{type(each).__name__} evaluates without action masks, and so {masked} with other actions than in training:"
                " use MaskableEvalCallback (sb3_contrib.common.maskable.callbacks)."
            )
