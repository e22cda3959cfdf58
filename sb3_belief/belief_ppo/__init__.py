"""PPO with a belief about the other agents: the Stable-Baselines3 side."""

from sb3_belief.belief_ppo.belief_ppo import BeliefPPO
from sb3_belief.belief_ppo.buffers import BeliefDictRolloutBuffer, BeliefMinibatch, BeliefRolloutBuffer
from sb3_belief.belief_ppo.maskable import (
    MaskableBeliefActorCriticPolicy,
    MaskableBeliefDictRolloutBuffer,
    MaskableBeliefPPO,
    MaskableBeliefRolloutBuffer,
)
from sb3_belief.belief_ppo.others import OthersPrediction
from sb3_belief.belief_ppo.policies import BeliefActorCriticPolicy

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
