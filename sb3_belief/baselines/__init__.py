"""
Decentralised methods to compare with: one SB3 model for each agent, which sees what an agent of a ``Team`` sees and no more.

Nothing here imports ``sb3_belief.references``, whose methods use the global state in training.
"""

from sb3_belief.baselines.amf import AMFPPO, MaskableAMFPPO
from sb3_belief.baselines.iac import IAC
from sb3_belief.baselines.iql import IQL

__all__ = ["AMFPPO", "IAC", "IQL", "MaskableAMFPPO"]
