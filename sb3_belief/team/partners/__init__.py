"""Partners in a team: agents that act and do not learn, fixed ones or drawn from a pool."""

from sb3_belief.team.fixed_partners.functions import batched
from sb3_belief.team.partners.pool import PartnerPool
from sb3_belief.team.partners.vec_env import PartnersVecEnv

__all__ = ["PartnerPool", "PartnersVecEnv", "batched"]
