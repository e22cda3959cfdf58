"""A check that SB3 wrappers around a team's environment change nothing that would not reach the agents."""

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from sb3_belief.vec_env.team_vec_env import TeamStep, TeamVecEnv


class WrapperCheck:
    """
    Compares what wrappers return with what the environment within has returned.

    Agents learn from their own rewards and ends, which are in the infos. A wrapper that changes the team's rewards or dones
    and leaves the infos as they are would change what is shown, but not what is learned.

    :param env: The environment of a team, with or without wrappers
    """

    def __init__(self, env: VecEnv):
        team_env = env.unwrapped
        assert isinstance(team_env, TeamVecEnv)
        self._team_env = team_env
        #: Classes of the wrappers that may change rewards or dones; without any there is nothing to check
        self.wrappers: list[str] = []
        while isinstance(env, VecEnvWrapper):
            # Those of SB3 that a team may have change no rewards
            if type(env).__module__.partition(".")[0] != "stable_baselines3":
                self.wrappers.append(type(env).__name__)
            env = env.venv

    def check(self, step: TeamStep) -> None:
        """
        Check a step.

        :param step: What the outermost wrapper has returned
        :raises ValueError: If rewards or dones differ from those of the environment itself
        """
        _, rewards, dones, infos = step
        team_env = self._team_env
        if np.asarray(dones).tolist() != team_env.last_dones.tolist():
            raise ValueError(
                f"{self._names()} changes when episodes end, which does not reach the agents: they end with the team's own"
                " environment, which also resets itself. End episodes in a wrapper of the ParallelEnv:"
                " make_team_env(..., wrapper=...)."
            )
        if np.asarray(rewards).tolist() != team_env.last_rewards.tolist():
            agent_rewards = np.concatenate([info["agent_rewards"] for info in infos])
            if np.array_equal(agent_rewards, team_env.last_agent_rewards.ravel()):
                raise ValueError(
                    f"{self._names()} changes the team's rewards, from which no agent learns: each learns from its own, which"
                    " are still what they were in infos[e]['agent_rewards']. Change them in a wrapper of the ParallelEnv"
                    " (make_team_env(..., wrapper=...), for instance SuperSuit's reward_lambda_v0), or let the wrapper change"
                    " infos[e]['agent_rewards'] too; for normalisation there is Team(..., normalize=True)."
                )

    def _names(self) -> str:
        return "The wrapper " + " or ".join(self.wrappers)
