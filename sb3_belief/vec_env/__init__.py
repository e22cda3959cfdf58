"""The vectorised environment of a whole team, and what each agent is given of its steps."""

from sb3_belief.vec_env.joint_env import JointEnv
from sb3_belief.vec_env.parallel_team_vec_env import ParallelTeamVecEnv
from sb3_belief.vec_env.team_vec_env import TeamObs, TeamStep, TeamVecEnv

__all__ = ["JointEnv", "ParallelTeamVecEnv", "TeamObs", "TeamStep", "TeamVecEnv"]
