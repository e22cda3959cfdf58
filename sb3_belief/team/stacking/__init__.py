"""Policies with equal networks act together: one pass for all, their weights stacked into one tensor for each layer."""

from sb3_belief.team.stacking.acting import ActsTogether, acting_together

__all__ = ["ActsTogether", "acting_together"]
