"""What a team looks for in the callbacks that it is given."""

import warnings

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback

from sb3_belief.team.own_code import callbacks_within


def check_agent_callback(agent: str, model: BaseAlgorithm, callback: BaseCallback) -> None:
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


def warn_of_checkpoints(callback: BaseCallback, is_normalised: bool) -> None:
    """
    Say where the statistics of a normalised team are, if a ``CheckpointCallback`` is to save them.

    :param callback: Of the team
    :param is_normalised: Whether an agent is normalised
    """
    for each in callbacks_within(callback):
        if is_normalised and isinstance(each, CheckpointCallback) and each.save_vecnormalize:
            warnings.warn(
                "CheckpointCallback(save_vecnormalize=True) writes no file of its own for a Team: each agent's statistics are"
                " in the team's zip (agents/<agent>.vecnormalize.pkl), and Team.load() restores them."
            )
