"""Many agents: the vectorised environment of a team, lockstep, the Team of models, and one learner among fixed partners."""

from sb3_belief.team.agent_env import AgentEnv
from sb3_belief.team.joint_env import JointEnv
from sb3_belief.team.make import make_team_env
from sb3_belief.team.parallel_vec_env import ParallelTeamVecEnv
from sb3_belief.team.team import Team
from sb3_belief.team.vec_env import TeamVecEnv

__all__ = ["AgentEnv", "JointEnv", "ParallelTeamVecEnv", "Team", "TeamVecEnv", "make_team_env"]
