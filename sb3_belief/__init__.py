"""Stable-Baselines3 for many agents: one model each, and for them a dynamic belief about the others."""

import os
from typing import TYPE_CHECKING

from sb3_belief.common.lazy_imports import lazy_attributes
from sb3_belief.common.versions import __version__

# PyTorch's products on x86 are MKL's, whose last bits may depend on where in memory a matrix happens to lie: one seed could
# then learn two things, and a resumed run differ from another. MKL reads this at its first product; it costs nothing
os.environ.setdefault("MKL_CBWR", "AUTO,STRICT")

if TYPE_CHECKING:
    from sb3_belief import belief as belief
    from sb3_belief import belief_ppo as belief_ppo
    from sb3_belief import envs
    from sb3_belief import team as team
    from sb3_belief import vec_env as vec_env
    from sb3_belief.belief_ppo import BeliefActorCriticPolicy, BeliefPPO, MaskableBeliefPPO
    from sb3_belief.team import AgentEnv, Team, TeamVecEnv, make_team_env
else:
    # A deployed agent needs neither PettingZoo nor what trains a team, and BeliefPPO not sb3-contrib
    __getattr__, __dir__ = lazy_attributes(
        __name__,
        {
            "AgentEnv": "sb3_belief.team",
            "BeliefActorCriticPolicy": "sb3_belief.belief_ppo",
            "BeliefPPO": "sb3_belief.belief_ppo",
            "MaskableBeliefPPO": "sb3_belief.belief_ppo",
            "Team": "sb3_belief.team",
            "TeamVecEnv": "sb3_belief.team",
            "make_team_env": "sb3_belief.team",
            **{package: f"sb3_belief.{package}" for package in ("belief", "belief_ppo", "envs", "team", "vec_env")},
        },
    )

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
