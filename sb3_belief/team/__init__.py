"""Many agents: the Team of models that learn in lockstep, and one learner among fixed partners."""

from sb3_belief.envs.env_util import make_team_env
from sb3_belief.team.checkpoints import Checkpoints
from sb3_belief.team.finite import NonFiniteError
from sb3_belief.team.fixed_partners import AgentEnv, ObserveLast
from sb3_belief.team.observing import observing
from sb3_belief.team.partners import PartnerPool, PartnersVecEnv, batched
from sb3_belief.team.recurrent import PartnerRecurrentPPO
from sb3_belief.team.team import Team
from sb3_belief.vec_env import JointEnv, ParallelTeamVecEnv, TeamVecEnv

__all__ = [
    "AgentEnv",
    "Checkpoints",
    "JointEnv",
    "NonFiniteError",
    "ObserveLast",
    "ParallelTeamVecEnv",
    "PartnerPool",
    "PartnerRecurrentPPO",
    "PartnersVecEnv",
    "Team",
    "TeamVecEnv",
    "batched",
    "make_team_env",
    "observing",
]
