"""Non-finite losses and parameters: found in each update, taken back, and never saved."""

from sb3_belief.team.finite.guard import ON_NAN, SKIPPED, NonFiniteError, UpdateGuard, check_on_nan
from sb3_belief.team.finite.saving import check_finite

__all__ = ["ON_NAN", "SKIPPED", "NonFiniteError", "UpdateGuard", "check_finite", "check_on_nan"]
