"""PPO with a belief about the other agents: the Stable-Baselines3 side."""

from typing import TYPE_CHECKING

from sb3_belief.belief_ppo.belief_ppo import BeliefPPO
from sb3_belief.belief_ppo.buffers import BeliefDictRolloutBuffer, BeliefMinibatch, BeliefRolloutBuffer
from sb3_belief.belief_ppo.others import OthersPrediction
from sb3_belief.belief_ppo.policies import BeliefActorCriticPolicy
from sb3_belief.common.lazy_imports import lazy_attributes

if TYPE_CHECKING:
    from sb3_belief.belief_ppo.maskable import (
        MaskableBeliefActorCriticPolicy,
        MaskableBeliefDictRolloutBuffer,
        MaskableBeliefPPO,
        MaskableBeliefRolloutBuffer,
    )
else:
    # Only these need sb3-contrib
    __getattr__, __dir__ = lazy_attributes(
        __name__,
        dict.fromkeys(
            (
                "MaskableBeliefActorCriticPolicy",
                "MaskableBeliefDictRolloutBuffer",
                "MaskableBeliefPPO",
                "MaskableBeliefRolloutBuffer",
            ),
            "sb3_belief.belief_ppo.maskable",
        ),
    )

__all__ = [
    "BeliefActorCriticPolicy",
    "BeliefDictRolloutBuffer",
    "BeliefMinibatch",
    "BeliefPPO",
    "BeliefRolloutBuffer",
    "MaskableBeliefActorCriticPolicy",
    "MaskableBeliefDictRolloutBuffer",
    "MaskableBeliefPPO",
    "MaskableBeliefRolloutBuffer",
    "OthersPrediction",
]
