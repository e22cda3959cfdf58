"""What a team looks for in the callbacks that it is given."""

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback

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
