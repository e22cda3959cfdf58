"""Stable-Baselines3 for many agents: one model each, and for them a dynamic belief about the others."""

from pathlib import Path

from sb3_belief import envs
from sb3_belief.belief_ppo import BeliefActorCriticPolicy, BeliefPPO
from sb3_belief.team import Team, TeamVecEnv, make_team_env

__version__ = (Path(__file__).parent / "version.txt").read_text().strip()

__all__ = [
    "BeliefActorCriticPolicy",
    "BeliefPPO",
    "Team",
    "TeamVecEnv",
    "envs",
    "make_team_env",
]
