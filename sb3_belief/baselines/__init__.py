"""
Decentralised methods to compare with: one SB3 model for each agent, which sees what an agent of a ``Team`` sees and no more.

Nothing here imports ``sb3_belief.references``, whose methods use the global state in training.
"""

from typing import TYPE_CHECKING

from sb3_belief.common.lazy_imports import lazy_attributes

if TYPE_CHECKING:
    from sb3_belief.baselines.amf import AMFPPO, MaskableAMFPPO
    from sb3_belief.baselines.dpiqn import DPIQN, DRPIQN
    from sb3_belief.baselines.iac import IAC
    from sb3_belief.baselines.iql import IQL
else:
    # Some need sb3-contrib, or what an environment of many agents needs; a deployed agent of another method does without
    __getattr__, __dir__ = lazy_attributes(
        __name__,
        {
            "AMFPPO": "sb3_belief.baselines.amf",
            "DPIQN": "sb3_belief.baselines.dpiqn",
            "DRPIQN": "sb3_belief.baselines.dpiqn",
            "IAC": "sb3_belief.baselines.iac",
            "IQL": "sb3_belief.baselines.iql",
            "MaskableAMFPPO": "sb3_belief.baselines.amf",
        },
    )

__all__ = ["AMFPPO", "DPIQN", "DRPIQN", "IAC", "IQL", "MaskableAMFPPO"]
