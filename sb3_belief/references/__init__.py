"""
What the paper compares with that trains centrally: with the global state, all agents' actions, or shared weights.

An environment of a team is shown to it by ``shared_weights`` or ``shared_with_state`` (to one model for all agents), by
``WithState`` (to a critic of each agent), or by ``JointVecEnv`` (to one model that acts for all).
"""

from typing import TYPE_CHECKING

from sb3_belief.common.lazy_imports import lazy_attributes

if TYPE_CHECKING:
    from sb3_belief.references.adapters import SharedVecEnv, shared_weights, shared_with_state
    from sb3_belief.references.coma import COMA
    from sb3_belief.references.factorisation import ValueFactorisation
    from sb3_belief.references.joint_vec_env import JointVecEnv, joint_team
    from sb3_belief.references.maddpg import MADDPG
    from sb3_belief.references.mappo import MAPPO, MaskableMAPPO
    from sb3_belief.references.rode import RODE
    from sb3_belief.references.shared import MaskableSharedMAPPO, MaskableSharedPPO, SharedMAPPO, SharedPPO
    from sb3_belief.references.with_state import WithState
else:
    # The maskable ones need sb3-contrib
    __getattr__, __dir__ = lazy_attributes(
        __name__,
        {
            "COMA": "sb3_belief.references.coma",
            "JointVecEnv": "sb3_belief.references.joint_vec_env",
            "MADDPG": "sb3_belief.references.maddpg",
            "MAPPO": "sb3_belief.references.mappo",
            "MaskableMAPPO": "sb3_belief.references.mappo",
            "MaskableSharedMAPPO": "sb3_belief.references.shared",
            "MaskableSharedPPO": "sb3_belief.references.shared",
            "RODE": "sb3_belief.references.rode",
            "SharedMAPPO": "sb3_belief.references.shared",
            "SharedPPO": "sb3_belief.references.shared",
            "SharedVecEnv": "sb3_belief.references.adapters",
            "ValueFactorisation": "sb3_belief.references.factorisation",
            "WithState": "sb3_belief.references.with_state",
            "joint_team": "sb3_belief.references.joint_vec_env",
            "shared_weights": "sb3_belief.references.adapters",
            "shared_with_state": "sb3_belief.references.adapters",
        },
    )

__all__ = [
    "COMA",
    "MADDPG",
    "MAPPO",
    "RODE",
    "JointVecEnv",
    "MaskableMAPPO",
    "MaskableSharedMAPPO",
    "MaskableSharedPPO",
    "SharedMAPPO",
    "SharedPPO",
    "SharedVecEnv",
    "ValueFactorisation",
    "WithState",
    "joint_team",
    "shared_weights",
    "shared_with_state",
]
