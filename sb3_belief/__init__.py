"""Stable-Baselines3 for many agents: one model each, and for them a dynamic belief about the others."""

from sb3_belief import envs
from sb3_belief.belief_ppo import BeliefActorCriticPolicy, BeliefPPO, MaskableBeliefPPO
from sb3_belief.common.versions import __version__
from sb3_belief.team import AgentEnv, Team, TeamVecEnv, make_team_env

__all__ = [
    "AgentEnv",
    "BeliefActorCriticPolicy",
    "BeliefPPO",
    "MaskableBeliefPPO",
    "Team",
    "TeamVecEnv",
    "__version__",
    "envs",
    "make_team_env",
]
